"""Times that do not increase: what the message advises is what the rows need, and leads to one series a bubble."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from en4dvar.inputs.formats import Disorder
from en4dvar.inputs.parts import Column, Layout
from en4dvar.inputs.readers import read_series
from en4dvar.plumbing.errors import DataError

TIME, RADIUS = Column("t", "us", "s"), Column("R", "um", "m")
T = np.arange(20.0)
A, B = (size * np.sqrt(1.01 - ((T - 9.5) / 9.5) ** 2) for size in (100, 120))
ONE, OTHER = (list(zip(T, R, strict=True)) for R in (A, B))
SHUFFLED = [ONE[i] for i in np.random.default_rng(3).permutation(20)]
NAMED = [("x", *row) for row in ONE] + [("y 1", *row) for row in OTHER]
SORT, BY = "correct it, or sort the rows (data.unsorted: sort)", "(data.by: 'film no')"
STACK = "t.csv:22: times must increase, but 0 us follows 19 us; these look like 2 series one after another: give each"
MEAN = "keep one of the two readings, or their mean (data.repeated: average)"


def advice(path: Path, head: str, rows: list[tuple[object, ...]], unsorted: Disorder) -> str:
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows), ""]))
    with pytest.raises(DataError) as told:
        read_series(path, TIME, RADIUS, Layout(unsorted=unsorted))
    return str(told.value)


def test_a_clock_that_begins_anew_is_one_way_to_look_like_several_series(tmp_path: Path) -> None:
    """As where a camera counts the frames of each burst from 0: the second half is no other bubble."""
    rows = [(t if t < 10 else t - 10, r) for t, r in ONE]
    told = advice(tmp_path / "t.csv", "t,R", rows, "refuse")
    assert "of one series whose clock began anew, add the time that had passed to the later times" in told


@pytest.mark.parametrize("unsorted", ["refuse", "sort"])
@pytest.mark.parametrize(
    ("head", "rows", "told"),
    [
        ("film no,t,R", NAMED, BY),
        ("film no,t,R", [row for pair in zip(NAMED[:20], NAMED[20:], strict=True) for row in pair], BY),
        ("t,R", ONE + OTHER, STACK),
        ("t,R", [row for pair in zip(ONE, OTHER, strict=True) for row in pair], "differ by far more than they scatter"),
        ("t,R", [*ONE[:5], (4.0, A[4] + 0.01), *ONE[5:]], MEAN),
    ],
    ids=["stacked, named", "frame by frame, named", "stacked", "frame by frame", "one twice"],
)
def test_several_series_are_never_sorted_or_averaged_into_one(
    tmp_path: Path, head: str, rows: list[tuple[object, ...]], told: str, unsorted: Disorder
) -> None:
    message = advice(tmp_path / "t.csv", head, rows, unsorted)
    assert told in message
    assert "data.unsorted" not in message
    assert ("data.repeated" in message) == (told == MEAN)


@pytest.mark.parametrize(
    "rows", [SHUFFLED, ONE[::-1], ONE[10:] + ONE[:10], [*ONE[:7], ONE[8], ONE[7], *ONE[9:]]],
    ids=["shuffled", "reversed", "halves", "exchanged"],
)  # fmt: skip
def test_one_series_is_sorted(tmp_path: Path, rows: list[tuple[object, ...]]) -> None:
    """A column that alternates, or is another in the second half, makes no series of it."""
    named = [(i % 2, i // 10, *row) for i, row in enumerate(rows)]
    assert advice(tmp_path / "t.csv", "flag,half,t,R", named, "refuse").endswith(SORT)
    read = read_series(tmp_path / "t.csv", TIME, RADIUS, Layout(unsorted="sort"))
    np.testing.assert_allclose(read.values, 1e-6 * A)


def test_times_in_the_column_of_readings_are_not_sorted(tmp_path: Path) -> None:
    """Sorted by their radii and averaged, exchanged columns were "a thick gel"."""
    told = advice(tmp_path / "t.csv", "t,R", [(r, 1 + t) for t, r in ONE], "refuse")
    assert told.endswith("are the columns of times and readings exchanged?")


def test_series_whose_readings_grow_from_each_to_the_next_are_not_exchanged_columns(tmp_path: Path) -> None:
    """As of a count that goes on while the clock begins anew; a column that tells them apart was not named."""
    rows = [("abcdef"[k // 6], k % 6, 1 + k) for k in range(36)]
    assert "(data.by: run)" in advice(tmp_path / "t.csv", "run,t,R", rows, "refuse")
    told = advice(tmp_path / "t.csv", "t,R", [row[1:] for row in rows], "refuse")
    assert "these look like 6 series one after another" in told


def test_of_vectors_no_column_is_asked_for(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"t": np.tile(T, 2), "R": np.concatenate([A, B])})
    with pytest.raises(DataError, match=r"sample 21: .*: give each a file of its own; of one series [a-z ,]*$"):
        read_series(tmp_path / "a.mat", TIME, RADIUS)


def test_a_bound_is_not_averaged_with_a_reading(tmp_path: Path) -> None:
    """The mean of 3 and of at most 5 would be at most 4."""
    path, mark = tmp_path / "t.csv", Column("below", "1", "1", kind="mark")
    layout, rows = Layout(repeated="average"), ["0,1,0", "0,3,0", "1,3,0", "2,5,1"]
    path.write_text("\n".join(["t,R,below", *rows]))
    read = read_series(path, TIME, RADIUS, layout, [mark])
    assert read.errors["below"].tolist() == [0, 0, 1]
    path.write_text("\n".join(["t,R,below", *rows, "2,3,0"]))
    with pytest.raises(DataError, match=r"t\.csv: a bound is not averaged .*series of their own"):
        read_series(path, TIME, RADIUS, layout, [mark])
