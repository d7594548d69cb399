"""The window: extrema that noise does not move, times, and what is refused."""

import numpy as np
import pytest

from en4dvar.data.extrema import maxima, minima, with_unseen
from en4dvar.inputs.window import Instant, parse_instant, select
from en4dvar.plumbing.errors import DataError
from en4dvar.plumbing.units import UnitError

T = np.linspace(0.0, 4.0, 161)
BOUNCES = 1.0 + np.exp(-0.4 * T) * np.abs(np.cos(np.pi * (T - 0.5)))  # cusps at 1, 2, 3, 4


def cut(values: np.ndarray, start: str, end: str, prominence: float = 0.1) -> tuple[float, float]:
    window = select(T, values, parse_instant(start, "s", ("R",)), parse_instant(end, "s"), prominence)
    return float(T[window][0]), float(T[window][-1])


def test_extrema() -> None:
    peak = float(T[np.argmax(BOUNCES)])
    assert cut(BOUNCES, "maximum", "minimum 2") == (peak, 2.0)
    assert cut(BOUNCES, "R_max", "minimum") == (peak, 1.0)
    assert cut(BOUNCES, "minimum 1", "minimum 2") == (1.0, 3.0)  # counted after the window's start
    assert cut(BOUNCES, "start", "end") == (0.0, 4.0)


def test_what_ends_a_series_without_such_a_minimum() -> None:
    assert cut(BOUNCES, "start", "minimum 2 or end") == (0.0, 2.0)
    assert cut(BOUNCES, "start", "trough 4 or end") == (0.0, 4.0)
    assert cut(BOUNCES, "start", "trough 5 or  trough 4 or minimum 3") == (0.0, 3.0)
    with pytest.raises(DataError, match=r"asks for minimum 4, but only 3 .*'to: trough 4 or end'"):
        cut(BOUNCES, "start", "trough 5 or trough 4")
    assert parse_instant("minimum 2 or 3 ms", "s") == Instant("minimum", 2, otherwise=Instant("time", time=0.003))
    for text in ("end or trough 2", "trough 2 or", "trough 2 or R_max", "trough 0 or end", "trough 2 orend"):
        with pytest.raises(UnitError, match="'trough 2 or end'"):
            parse_instant(text, "s")


def test_a_fall_to_a_share_of_the_maximum() -> None:
    above, below = (float(T[i]) for i in (31, 32))
    assert BOUNCES[31] > 0.8 * BOUNCES.max() > BOUNCES[32]
    assert cut(BOUNCES, "maximum", "80 % of maximum")[1] == above
    assert cut(BOUNCES, "80 % of R_max", "end")[0] == below
    assert cut(3 * BOUNCES, "start", "80 % of the maximum or end") == (0.0, above)
    assert cut(BOUNCES, "start", "20 % of maximum or minimum 2") == (0.0, 2.0)
    assert cut(np.sort(BOUNCES), "start", "80% of maximum or end") == (0.0, 4.0)
    with pytest.raises(DataError, match=r"asks for 20 % of maximum, but no reading .* write '20 % of maximum or end'"):
        cut(BOUNCES, "start", "20 % of maximum")
    for text in ("0 % of maximum", "100 % of maximum", "20 kPa% of maximum", "20 % of minimum", "20 % of R_max"):
        with pytest.raises(UnitError, match=r"share must lie between|is not an instant|unit"):
            parse_instant(text, "s")


def test_top_and_trough() -> None:
    triangles = np.abs((T - 0.52) % 1.0 - 0.5)  # minima at 1.02, 2.02, 3.02: between two samples
    assert cut(triangles, "minimum 2", "trough 1") == pytest.approx((2.025, 3.0))
    assert cut(triangles, "start", "trough 2")[1] == pytest.approx(2.0)
    parabola = 2.0 - (T - 1.51) ** 2
    assert cut(parabola, "top", "end")[0] == pytest.approx(1.525)
    assert cut(parabola[::-1], "top", "end")[0] == pytest.approx(2.5)
    few = np.where(T == 2.0, 3.0, 1.0 + 0.1 * T)
    assert cut(few, "top", "end")[0] == 2.0  # no five samples about it: the largest
    assert parse_instant("top", "s") == Instant("top")
    assert parse_instant("trough 2", "s") == Instant("trough", 2)


def test_a_minimum_in_a_hole_counts() -> None:
    """It lies between the last sample before, in the fall, and the first behind, which falls from a top in the hole."""
    kept = (T < 0.8) | (T > 1.6)
    times, values = T[kept], BOUNCES[kept]
    for kind in ("minimum", "trough"):
        for number, end in ((1, 0.775), (2, 2.0), (3, 3.0)):
            window = select(times, values, Instant("start"), Instant(kind, number))
            assert times[window][-1] == pytest.approx(end), (kind, number)
        window = select(times, values, Instant(kind), Instant("end"))
        assert times[window][0] == pytest.approx(1.625), kind


@pytest.mark.parametrize("begin", np.arange(0.4, 3.0, 0.2))
def test_a_hole_in_one_fall_hides_no_minimum(begin: float) -> None:
    kept = np.abs(T - begin - 0.4) > 0.4
    falls = (np.cos(T * np.pi / 4), np.exp(-T), 5 - T, np.sqrt(17 - T**2), np.tanh(2 - T))
    for values in falls:
        for series in (values, values + 0.005 * np.random.default_rng(3).standard_normal(len(T))):
            assert len(minima(with_unseen(T[kept], series[kept])[1])) == len(minima(series[kept]))


def test_maxima_lie_behind_the_first_minimum() -> None:
    tops = T[maxima(BOUNCES)]
    assert tops == pytest.approx([1.5, 2.5, 3.5], abs=0.06)  # a little earlier, since they decay; not that at 0.5
    assert len(maxima(BOUNCES[: np.argmax(T >= 1.0)])) == 0


def test_errors_of_samples_do_not_choose_the_ends() -> None:
    """The first and the last error of a window have the mean zero; those of the extreme samples do not."""
    rng = np.random.default_rng(4)
    means = {}
    for ends in (("top", "trough 2"), ("R_max", "minimum 2")):
        chosen = []
        for _ in range(400):
            errors = 0.03 * rng.standard_normal(len(T))
            smooth = 2.0 + np.cos(2 * np.pi * T / 2.0 - 1.0) * np.exp(-0.3 * T)
            window = select(T, smooth + errors, *(parse_instant(end, "s", ("R",)) for end in ends))
            chosen.append((errors[window][0], errors[window][-1]))
        means[ends[0]] = np.mean(chosen, axis=0) / 0.03
    assert np.all(np.abs(means["top"]) < 0.25), means  # five standard errors of a mean of 400
    assert means["R_max"][0] > 1.0, means
    assert means["R_max"][1] < -1.0, means


def test_noise_makes_no_minimum() -> None:
    rng = np.random.default_rng(1)
    noisy = BOUNCES + 0.02 * rng.standard_normal(len(T))
    assert len(minima(noisy, 1e-6)) > 20
    assert np.allclose(T[minima(noisy)], [1.0, 2.0, 3.0], atol=0.05)


def test_times_include_both_ends() -> None:
    assert cut(BOUNCES, "500 ms", "1 s") == (0.5, 1.0)
    assert cut(BOUNCES, "0.51 s", "0.99 s") == pytest.approx((0.525, 0.975))
    assert cut(BOUNCES, "0.975 s", "0.975 s") == pytest.approx((0.975, 0.975))  # stored as 0.9750000000000001


def test_refused() -> None:
    with pytest.raises(DataError, match="asks for minimum 4, but only 3 minima with a prominence of 10 %"):
        cut(BOUNCES, "start", "minimum 4")
    with pytest.raises(DataError, match="empty"):
        cut(BOUNCES, "3 s", "2 s")
    with pytest.raises(DataError, match="the window holds no reading"):
        cut(BOUNCES, "5 s", "6 s")
    assert parse_instant("minimum 3", "s") == Instant("minimum", 3)
    for text in ("R_max", "minimum 0", "minimum two", "trough 0", "3", "3 m", 3.0):
        with pytest.raises(UnitError):
            parse_instant(text, "s")
