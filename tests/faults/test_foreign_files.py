"""Files from outside that are damaged, or far too large, or written to take a reader down."""

import struct
import time
import zlib

import pytest
from click.testing import CliRunner
from mat_damage import seeds, survive
from rows import row
from toy_config import write_toy

from en4dvar.cli import main
from en4dvar.config.document import read_document
from en4dvar.inputs.members import read_covariance
from en4dvar.inputs.parts import Column, Matrix, read_contents
from en4dvar.inputs.readers import read_series
from en4dvar.plumbing.errors import ConfigError, DataError

TIME, RADIUS = Column("t", "us", "s"), Column("R", "um", "m")


@pytest.mark.parametrize(
    ("first", "count"), [(425, 6), pytest.param(0, 5000, marks=[pytest.mark.slow, pytest.mark.long])]
)
@pytest.mark.fault("mat-damaged")
def test_damaged_mat_files(tmp_path, first, count):
    """Number 429 ends the process of scipy 1.17's reader (SIGSEGV), as do some fifteen in 4000, and nothing else."""
    found = survive(tmp_path, count, seed=1, first=first)
    assert found["crashes"] == 0
    assert found["read"] + found["refused"] == count


@pytest.mark.fault("mat-damaged")
def test_a_damaged_mat_file_is_told(tmp_path):
    path = write_toy(tmp_path, ("path: toy.csv", "path: toy.mat"))
    (tmp_path / "toy.mat").write_bytes(seeds()[0][:-8])
    done = CliRunner().invoke(main, ["validate", str(path)])
    assert done.exit_code == 2
    assert row("mat-damaged").told(done.stderr), done.stderr


@pytest.mark.fault("bomb")
def test_a_mat_file_that_unpacks_to_a_terabyte(tmp_path):
    packed = zlib.compress(
        struct.pack("<IIIIIIIIiiHHI", 14, 0xFFFFFFF0, 6, 8, 6, 0, 5, 8, 1, 1 << 29, 1, 1, 82) + bytes(10**8)
    )
    path = tmp_path / "a.mat"
    path.write_bytes(seeds()[0][:128] + struct.pack("<II", 15, len(packed)) + packed)
    with pytest.raises(DataError, match="more than 33554432 numbers"):
        read_contents(path)


@pytest.mark.fault("bomb")
def test_a_yaml_file_of_100_mb(tmp_path):
    path = write_toy(tmp_path)
    with path.open("ab") as file:
        file.truncate(10**8)
    begin = time.process_time()
    with pytest.raises(ConfigError) as told:
        read_document(path)
    assert time.process_time() - begin < 1
    assert row("bomb").told(str(told.value))


@pytest.mark.fault("alias-bomb")
def test_an_alias_bomb(tmp_path):
    path = write_toy(tmp_path)
    levels = "".join(f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]\n" for i in range(1, 10))
    path.write_text(f"l0: &l0 [lol]\n{levels}{path.read_text()}")
    with pytest.raises(ConfigError) as told:
        read_document(path)
    assert row("alias-bomb").told(str(told.value))


@pytest.mark.parametrize(
    "columns", [20_000, pytest.param(10**7, marks=[pytest.mark.slow, pytest.mark.long])], ids=["many", "10 million"]
)
@pytest.mark.fault("wide")
def test_a_table_of_very_many_columns(tmp_path, columns):
    path = tmp_path / "wide.csv"
    path.write_text(",".join(f"c{i}" for i in range(columns)) + "\n" + ",".join(["1"] * columns) + "\n")
    for read in (
        lambda: read_series(path, TIME, RADIUS),
        lambda: read_contents(path),
        lambda: read_covariance(Matrix(path, "um^2", "m^2")),
    ):
        with pytest.raises(DataError) as told:
            read()
        assert row("wide").told(str(told.value)), told.value
        assert len(str(told.value)) < 1000


@pytest.mark.fault("wide")
def test_a_cell_and_a_list_of_columns_are_quoted_in_short(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text("t,R\n" + "".join(f"{i},{'x' * 100_000}\n" for i in range(4)))
    with pytest.raises(DataError, match=r"wide\.csv:2: 'x+…' in column 'R' is not a number") as told:
        read_series(path, TIME, RADIUS)
    assert len(str(told.value)) < 500
    path.write_text(f"t,R\n1,{'2' * 200_000}\n")
    with pytest.raises(DataError, match=r"wide\.csv: field larger than field limit"):
        read_contents(path)
    path.write_text(",".join(f"c{i}" for i in range(5000)) + "\n" + "1," * 4999 + "1\n")
    with pytest.raises(DataError, match=r"no column 'R'; the columns are: c0, .* and 4970 more$"):
        read_series(path, TIME, RADIUS)
