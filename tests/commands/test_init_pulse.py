"""``en4dvar init`` of bubbles that a pulse made: what is known before the readings, and where the clock lies."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from init_files import call, proposed, rebounding

from en4dvar.assembly.build import build
from en4dvar.config import load_config
from en4dvar.priors.prior import PriorTerm
from en4dvar_bubble import simulate as bubble_path
from en4dvar_bubble.driving import sine_burst
from en4dvar_bubble.starter.look import TOP_WIDTH, look

SOFT = {"G": 420.0, "alpha": 0.025, "mu": 0.086, "R0": 0.43e-6}  # agarose of 0.3 and of 1 %: Mancia et al. (2021)
STIFF = {"G": 6900.0, "alpha": 0.025, "mu": 0.15, "R0": 1.3e-6}

pytestmark = pytest.mark.usefixtures("own_folder")


def of_file(gel: dict[str, float], zero: float) -> tuple[float, dict[str, PriorTerm]]:
    """The proposed ``time_zero`` (s) and priors of a bubble read every µs on a clock that is ``zero`` (µs) late."""
    times = np.arange(5.6, 34.0, 1.0)
    radius = 1e6 * bubble_path("quadratic-kelvin-voigt", gel, 1e-6 * times).R[0].values
    top = int(np.argmax(radius))
    kept = (np.arange(len(times)) <= top) | (radius > 0.25 * radius[top])
    readings = radius + np.random.default_rng(2).standard_normal(len(times))
    rows = [f"{t + zero:.2f},{r:.3f}" for t, r in zip(times[kept], readings[kept], strict=True)]
    Path("pulse.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))
    done = call("init", "--data", "pulse.csv", "--start", "acoustic", "--force")
    assert done.exit_code == 0, done.output
    config = proposed(Path("pulse.yaml"))
    (problem,) = build(config)
    said = config.document.data["data"]["time_zero"]
    terms = {term.parameter.name: term for term in problem.prior.terms}
    return (0.0 if said == "file" else 1e-6 * float(said.removesuffix(" us"))), terms


def test_of_a_gel_that_a_pulse_stretches_no_prior_is_what_the_readings_say() -> None:
    """They tell G α/R0: a G that fits with α and R0 at their medians counts what is known of these twice."""
    soft, stiff = (of_file(gel, 0.0)[1] for gel in (SOFT, STIFF))
    for name in ("G", "alpha", "mu", "R0"):
        assert (soft[name].mean, soft[name].std) == (stiff[name].mean, stiff[name].std)
        for gel in (SOFT, STIFF):
            assert abs(np.log(gel[name]) - soft[name].mean) < 2 * soft[name].std, name


def test_a_gel_that_does_not_stiffen_is_within_what_is_proposed() -> None:
    """At a stretch of hundreds a small α is nearly none; a prior that excludes it gives α a part of the gel's G."""
    alpha = of_file(SOFT, 0.0)[1]["alpha"]
    least, times = float(np.exp(alpha.mean - 1.645 * alpha.std)), np.arange(5.6e-6, 45e-6, 1e-7)
    gel = {"G": 2e3, "mu": 0.086, "R0": 0.6e-6}
    stiffens = bubble_path("quadratic-kelvin-voigt", {**gel, "alpha": least}, times).R[0].values
    does_not = bubble_path("neo-hookean-kelvin-voigt", gel, times).R[0].values
    assert np.max(np.abs(stiffens / does_not - 1)[times < times[int(np.argmax(does_not))]]) < 0.01
    (line,) = (it for it in Path("pulse.yaml").read_text().splitlines() if "alpha=0" in it)
    said = shlex.split(line.lstrip("# "))
    (problem,) = build(load_config(Path("pulse.yaml"), dict([said[said.index("--set") + 1].split("=")])))
    assert problem.fixed["alpha"] == 0.0


@pytest.mark.parametrize("gel", [SOFT, STIFF], ids=["soft", "stiff"])
def test_a_guessed_clock_is_as_exact_late_as_early(gel: dict[str, float]) -> None:
    early, late = (of_file(gel, zero) for zero in (134.26, 12345.26))
    assert late[0] - early[0] == pytest.approx(12211e-6, abs=0.11e-6)
    for (proposed_zero, terms), zero in ((early, 134.26e-6), (late, 12345.26e-6)):
        assert abs(proposed_zero - zero) < 2 * terms["t_s"].std


@pytest.mark.parametrize("late", [0.0, 20.0])
def test_bubbles_whose_clocks_begin_at_other_instants_of_the_pulse_are_named(late: float) -> None:
    """Of one gel and different nuclei; all have one ``time_zero``."""
    Path("d").mkdir()
    times = np.arange(5.6, 34.0, 1.0)
    for number, size in enumerate((0.3e-6, 0.43e-6, 0.6e-6)):
        radius = 1e6 * bubble_path("quadratic-kelvin-voigt", {**SOFT, "R0": size}, 1e-6 * times).R[0].values
        rows = [f"{t + late * (number == 1):.2f},{r:.3f}" for t, r in zip(times, radius, strict=True)]
        Path(f"d/b{number}.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))
    done = call("init", "--data", "d", "--start", "acoustic")
    assert done.exit_code == 0, done.output
    named = [line for line in done.stderr.splitlines() if "one time_zero is for all files" in line]
    assert bool(named) == bool(late)
    assert all(
        re.match(r"warning: b1: the bubble grows up to (19|20|21)\S* us before or after most", it) for it in named
    )


def test_a_delay_that_each_file_states_begins_its_clock() -> None:
    Path("d").mkdir()
    times, delays = np.arange(5.6, 34.0, 1.0), (0.0, 2.0, 7.0, 21.0)
    for number, (late, size) in enumerate(zip(delays, (0.3e-6, 0.43e-6, 0.6e-6, 0.5e-6), strict=True)):
        radius = 1e6 * bubble_path("quadratic-kelvin-voigt", {**SOFT, "R0": size}, 1e-6 * times).R[0].values
        rows = [f"{t + late:.2f},{r:.3f}" for t, r in zip(times, radius, strict=True)]
        Path(f"d/b{number}.csv").write_text("\n".join([f"# delay_us = {late}", "t_us,R_um", *rows, ""]))
    done = call("init", "--data", "d", "--start", "acoustic")
    assert done.exit_code == 0, done.output
    assert "one time_zero is for all files" not in done.stderr
    zeros = [1e6 * problem.observations.zero for problem in build(proposed(Path("d.yaml")))]
    np.testing.assert_allclose(np.diff(zeros), np.diff(delays), atol=1e-6)


def test_a_window_to_the_end_says_why_it_does_not_end_before() -> None:
    of_file(STIFF, 0.0)
    (line,) = (line for line in Path("pulse.yaml").read_text().splitlines() if line.startswith("  window:"))
    assert "to: end}" in line
    assert line.endswith("# all readings: none after the maximum is below 20 % of it")


def test_the_window_of_each_bubble_of_a_folder_ends_with_its_own_collapse() -> None:
    Path("gel").mkdir()
    times, ends = np.arange(0.0, 40.0, 1.0), {"a": 12.0, "b": 19.0, "c": 31.0}
    for name, end in ends.items():
        top = 0.6 * end
        way = np.where(times < top, (times - top) / (top + 0.1), (times - top) / (end - top))
        radius = np.where(times < end, 150 * np.clip(1 - way**2, 1e-4, 1) ** 0.4, 6.0)
        rows = [f"{t:.1f},{r:.3f}" for t, r in zip(times, radius, strict=True)]
        Path(f"gel/{name}.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))
    rows = [f"{t:.1f},{60 - (t - 18) ** 2 / 20:.3f}" for t in times[:30]]
    Path("gel/slow.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))
    assert call("init", "--data", "gel", "--start", "acoustic").exit_code == 0
    assert "window: {from: start, to: 20 % of maximum or end}" in Path("gel.yaml").read_text()
    last = {p.observations.name: 1e6 * p.observations.file_times[-1] for p in build(proposed(Path("gel.yaml")))}
    assert last == pytest.approx({"a": 11.0, "b": 18.0, "c": 30.0, "slow": 29.0})


def test_bubbles_of_one_gel_grow_from_alike_nuclei() -> None:
    """Six bubbles do not tell the nuclei of a gel six times as well as what is known: R0 varies, unless it is seen."""
    Path("gel").mkdir()
    for k in range(3):
        of_file(STIFF, 0.01 * k)
        Path("pulse.csv").rename(f"gel/b{k}.csv")
    assert call("init", "--data", "gel", "--start", "acoustic").exit_code == 0
    assert proposed(Path("gel.yaml")).document.data["population"]["of"] == ["G", "alpha", "mu", "R0"]
    for k in range(3):  # gas at rest before the pulse
        head, *rows = Path(f"gel/b{k}.csv").read_text().splitlines()
        rest = [f"{t:.2f},{20 + 0.1 * (-1) ** t:.2f}" for t in range(-12, 5)]
        Path(f"gel/b{k}.csv").write_text("\n".join([head, *rest, *rows, ""]))
    assert call("init", "--data", "gel", "--start", "acoustic", "--force").exit_code == 0
    assert proposed(Path("gel.yaml")).document.data["population"]["of"] == ["G", "alpha", "mu"]


@pytest.mark.parametrize(("a_cycle", "decimals"), [(5, 4), (6, 4), (10, 4), (10, 0)])
@pytest.mark.parametrize("said", [(), ("--start", "acoustic")], ids=["unsaid", "said"])
def test_a_bubble_that_rests_and_then_swings_needs_no_collapse(
    a_cycle: int, said: tuple[str, ...], decimals: int
) -> None:
    sound = sine_burst(-90e3, 60e3, 6, delay=10e-6, envelope="hann")
    gel, times = {"G": 12e3, "mu": 0.06, "R0": 39e-6}, np.arange(0.5e-6, 150e-6, 1 / 60e3 / a_cycle)
    swing = bubble_path("neo-hookean-kelvin-voigt", gel, times, driving=sound, gas="polytropic").R[0].values
    radius = 1e6 * swing + 0.06 * np.random.default_rng(1).standard_normal(len(times))
    rows = [f"{1e6 * t:.3f},{r:.{decimals}f}" for t, r in zip(times, radius, strict=True)]
    Path("burst.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))
    done = call("init", "--data", "burst.csv", *said)
    assert done.exit_code == 0, done.output
    assert "it rests at 39 um before it grows" in done.output
    assert ("acoustic is only a proposal" in done.output) == (not said)
    assert "where it should rest" not in done.output
    (problem,) = build(proposed(Path("burst.yaml")))
    assert problem.model.start == "acoustic"  # type: ignore[attr-defined]
    error = np.hypot(0.06e-6, 10**-decimals * 1e-6 / 12**0.5)  # of noise and rounding
    assert 0.4 * error < np.median(problem.observations.std) < 3 * error


def test_a_pulse_that_is_an_example_is_told_as_one_and_no_bubble_is_held_against_it() -> None:
    """It made none of the user's bubbles, so that a gel which gives their R_max with it says nothing."""
    sound = sine_burst(-90e3, 60e3, 6, delay=10e-6, envelope="hann")
    gel, times = {"G": 12e3, "mu": 0.06, "R0": 39e-6}, np.arange(0.5e-6, 150e-6, 2e-6)
    swing = bubble_path("neo-hookean-kelvin-voigt", gel, times, driving=sound, gas="polytropic").R[0].values
    Path("b.csv").write_text(
        "t_us,R_um\n" + "".join(f"{1e6 * t:.3f},{1e6 * r:.4f}\n" for t, r in zip(times, swing, strict=True))
    )
    done = call("init", "--data", "b.csv", "--start", "acoustic")
    (told,) = (line for line in done.stderr.splitlines() if "pulse is" in line)
    assert "the pulse is an example: enter that of your experiment in the line 'driving' of the model" in told
    assert "will give this" not in done.stderr


@pytest.mark.parametrize("last", [0.9, 0.3])
def test_growth_without_a_rebound_is_not_said_to_show_a_collapse(last: float) -> None:
    """A bubble of ultrasound and one of a laser grow alike from 40 % on, and this one ends before it has collapsed."""
    times = np.arange(0.0, 40e-6, 1e-6)
    radius = 1e-4 * np.clip(1 - (times / 18e-6 - 1) ** 2 * 0.9, 0, 1) ** 0.4
    ends = int(np.argmax((radius < last * 1e-4) & (times > 18e-6)))
    seen = look(times[:ends], radius[:ends])
    assert (seen.start, seen.clear) == ("acoustic", False)
    assert seen.reason == "the history begins at 40 % of R_max, grows and shows no rebound"


@pytest.mark.parametrize("seed_of", [0.15, 0.3])
def test_a_seed_of_which_a_laser_makes_a_far_larger_bubble_is_no_rest_of_a_driven_one(seed_of: float) -> None:
    """Dirt or an old bubble where the laser is focused, seen in six frames before it."""
    t, R = rebounding(0.05)
    radius = np.append(np.full(6, seed_of), R) + 0.003 * np.random.default_rng(5).standard_normal(len(t) + 6)
    times = 20e-6 * (np.append(t[0] + 0.05 * np.arange(-6, 0), t) + 1)
    assert look(times, 200e-6 * radius).start == "laser"


def driven(folder: str, rests: dict[str, float], odd: float = 0.0) -> tuple[str, dict[str, PriorTerm]]:
    """The proposed line of R0 and its priors of bubbles that swing about their ``rests`` (um); one of 0 shows none."""
    Path(folder).mkdir()
    t, stream = np.arange(0.0, 60.0, 1.0), np.random.default_rng(3)
    for name, rest in rests.items():
        swing = np.where(t > 20, 0.4 * np.sin((t - 20) / 5) * np.exp(-((t - 40) ** 2) / 200), 0.0)
        radius = (rest or 30.0) * (1 + swing) + 0.1 * stream.standard_normal(len(t))
        radius[0] += odd
        kept = t >= (0 if rest else 25)
        rows = [f"{a:.1f},{r:.3f}" for a, r in zip(t[kept], radius[kept], strict=True)]
        Path(folder, f"{name}.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))
    done = call("init", "--data", folder, "--start", "acoustic")
    assert done.exit_code == 0, done.output
    (line,) = (it for it in Path(f"{folder}.yaml").read_text().splitlines() if it.startswith("  R0:"))
    problems = build(proposed(Path(f"{folder}.yaml")))
    return line, {p.observations.name: next(x for x in p.prior.terms if x.parameter.name == "R0") for p in problems}


@pytest.mark.parametrize("odd", [0.0, 0.5])
def test_each_driven_bubble_of_a_folder_rests_where_its_own_readings_say(odd: float) -> None:
    rests = {"a": 12.0, "b": 30.0, "c": 75.0}
    line, terms = driven("gel", rests, odd)
    assert "median: first" in line
    for name, rest in rests.items():
        assert abs(terms[name].mean - np.log(1e-6 * rest)) < 1.2 * terms[name].std
        assert TOP_WIDTH * 0.05 / 12 < terms[name].std < 0.07


def test_where_a_bubble_shows_no_rest_all_have_one_prior_as_wide_as_they_differ() -> None:
    line, terms = driven("gel", {"a": 25.0, "b": 35.0, "c": 60.0, "d": 0.0})
    assert re.search(r"median: (34\.9|35)", line)
    assert terms["d"].std == pytest.approx(np.std([25, 35, 60]) / 35, rel=0.02)
    assert len({term.mean for term in terms.values()}) == 1


def test_files_that_begin_in_the_growth_started_as_those_of_their_folder_that_show_a_nucleus() -> None:
    Path("gel").mkdir()
    for name, first in {"a": 0.5, "b": 17.0, "c": 0.8, "d": 1.0, "e": 0.6}.items():
        times = np.arange(0.0, 40.0, 1.0)
        swings = [(5.0, 5.5, 90.0), (13.0, 3.0, 40.0), (18.0, 2.5, 25.0)]
        radius = np.max([h * np.clip(1 - ((times - at) / w) ** 2, 1e-3, 1) ** 0.4 for at, w, h in swings], axis=0)
        radius[0] = first
        rows = [f"{t:.2f},{r:.3f}" for t, r in zip(times, radius, strict=True)]
        Path(f"gel/{name}.csv").write_text("\n".join(["t_us,R_um", *rows, ""]))
    done = call("init", "--data", "gel")
    assert done.exit_code == 0, done.output
    assert "start: acoustic is only a proposal (so begin 4 of 5 histories; b in the growth)" in done.stderr
    assert "start: acoustic" in Path("gel.yaml").read_text()


def test_a_driven_bubble_of_a_gel_that_stiffens_may_collapse_in_half_of_the_rayleigh_time() -> None:
    t = np.arange(0.0, 30.0, 1.0)
    radius = 130 * np.clip(1 - ((t - 12) / np.where(t < 12, 12.02, 6.2)) ** 2, 1e-4, 1) ** 0.4
    Path("b.csv").write_text("t_us,R_um\n" + "".join(f"{a:.1f},{r:.3f}\n" for a, r in zip(t, radius, strict=True)))
    done = call("init", "--data", "b.csv", "--start", "acoustic")
    assert done.exit_code == 0, done.output
    assert "Rayleigh time 0.915" not in done.stderr
    done = call("init", "--data", "b.csv", "--start", "laser", "--force")
    assert "Rayleigh time 0.915" in done.stderr
