"""``en4dvar init``: from data alone to a configuration that validates, runs and expects the truth."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from init_files import TRUTH, UNITS, call, proposed, simulate, write
from jsonschema import Draft202012Validator
from scipy.integrate import solve_ivp
from scipy.io import loadmat, savemat

from en4dvar.assembly.build import build
from en4dvar.config import load_config, resolve
from en4dvar.config.document import parse_document, read_document
from en4dvar.inputs.implausible import scatter_of
from en4dvar.inputs.parts import Column
from en4dvar.inputs.readers import read_series
from en4dvar.plumbing.errors import ConfigError, DataError
from en4dvar.report.result import load_result
from en4dvar_bubble import simulate as bubble_path
from en4dvar_bubble.collapse import RAYLEIGH, lobe
from en4dvar_bubble.driving import sine_burst
from en4dvar_bubble.laws import REGISTRY
from en4dvar_bubble.medium import known_medium
from en4dvar_bubble.starter.config import Source, yaml_text
from en4dvar_bubble.starter.look import before, look
from en4dvar_bubble.starter.proposal import starter

ROOT = Path(__file__).resolve().parents[2]
MEASURED = ROOT.parent / "shared" / "data"

ELSEWHERE = {"rho": 998.0, "c": 1484.0, "p_inf": 101325.0, "reading_scale": 1.0, "sigma": 1.0}  # of the simulations

pytestmark = pytest.mark.usefixtures("own_folder")


def test_films_of_two_rates_have_each_its_own_error_of_the_times() -> None:
    Path("films").mkdir()
    header, *lines = write(Path("films", "fast.csv")).read_text(encoding="utf-8").splitlines()
    Path("films", "slow.csv").write_text("\n".join([header, *lines[::3], ""]), encoding="utf-8")
    done = call("init", "--data", "films")
    assert done.exit_code == 0, done.output
    steps = [float(p.observations.noise.time_std[0]) for p in build(load_config("films.yaml"))]
    np.testing.assert_allclose(steps, [0.035e-6, 0.105e-6])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start", "times", "noise_std"),
    [
        ("acoustic", "5.6 us:30.1 us:1.4 us", "1.4 um"),  # multi-flash imaging: some 18 frames
        ("acoustic", "0 us:60 us:0.5 us", "1.4 um"),  # from the nucleus through rebounds
        ("laser", "0 us:70 us:0.63 us", "2 um"),  # a high-speed film from R_max on, the bubble not yet at rest
    ],
)
def test_synthetic_data_to_a_run(tmp_path: Path, start: str, times: str, noise_std: str) -> None:
    data = simulate(start, times, noise_std, tmp_path / "bubble.csv")
    done = call("init", "--data", data, "--time-unit", "us", "--radius-unit", "um")
    assert done.exit_code == 0, done.output
    text = Path("bubble.yaml").read_text(encoding="utf-8")
    config = proposed(Path("bubble.yaml"))
    assert config.document.data["model"]["start"] == start
    (problem,) = build(config)
    std = float(np.median(problem.observations.std))
    assert std == pytest.approx(float(noise_std.split()[0]) * 1e-6, rel=0.35)
    for term in problem.prior.terms:  # the truth is no surprise to the prior
        if term.parameter.name.startswith("discrepancy"):  # the data have none
            continue
        truth = {**TRUTH[start], **ELSEWHERE}[term.parameter.name]
        transformed = np.log(truth) if term.transform == "lognormal" else truth
        assert abs(transformed - term.mean) < 3 * term.std, term.parameter.name
    for term in problem.prior.terms:  # a prior wider than the documentation advises says how wide it is, and why
        if term.transform == "lognormal" and term.std > 0.7 and not term.parameter.name.startswith("discrepancy"):
            (line,) = (line for line in text.splitlines() if line.startswith(f"  {term.parameter.name}: "))
            assert f"may be off by a factor of {np.exp(1.645 * term.std):.2g}; narrow it" in line
    assert text.startswith("# yaml-language-server: $schema=en4dvar.schema.json\n")
    schema = json.loads(Path("en4dvar.schema.json").read_text(encoding="utf-8"))
    assert list(Draft202012Validator(schema).iter_errors(read_document(Path("bubble.yaml")).data)) == []
    assert call("validate", "bubble.yaml").exit_code == 0
    run = call("run", "bubble.yaml", "--no-report")
    assert run.exit_code == 0, run.output
    result = load_result(Path("runs") / "bubble" / "posterior.nc")
    assert result.sample_stats.attrs["converged"] == 1
    assert result.sample_stats.attrs["nrmse"] > 0.9
    rows = {row.name: row for row in result.rows}
    assert rows["mu"].unit == "Pa s"
    assert abs(rows["mu"].mean - TRUTH[start]["mu"]) < 4 * rows["mu"].std


def test_what_is_not_known_exactly_is_estimated(tmp_path: Path) -> None:
    """One error model: scatter, a discrepancy from the start, no white std beside it; density, pressure, scale."""
    data = simulate("laser", "0 us:70 us:0.63 us", "2 um", tmp_path / "bubble.csv")
    done = call("init", "--data", data, *UNITS, "--medium", "agarose")
    assert done.exit_code == 0, done.output
    config = load_config(Path("bubble.yaml"))
    (problem,) = build(config)
    known = {"sigma", "discrepancy_amplitude", "discrepancy_length", "rho", "c", "p_inf", "reading_scale"}
    assert known < set(problem.prior.names)
    assert problem.observations.noise.kernel.smoothness == 1.5
    assert config.data.series[0].data.error.model_std is None
    of = {term.parameter.name: term for term in problem.prior.terms}
    assert np.exp(of["rho"].mean) == pytest.approx(1001, abs=5)
    assert of["rho"].std < 0.01
    done = call("init", "--data", data, *UNITS, "--medium", "agarrose", "--force")
    assert done.exit_code == 2
    assert "unknown medium 'agarrose'; did you mean 'agarose'?" in done.output
    done = call("init", "--data", data, *UNITS, "--medium", "glycerol", "--force")
    assert "unknown medium 'glycerol'; known: gel, water, " in done.output
    assert done.output.count("known: ") == 1
    done = call("init", "--data", data, *UNITS, "--medium", "polyacrylamide 8 %", "--force")
    assert done.exit_code == 0, done.output
    (rho,) = (term for term in build(load_config(Path("bubble.yaml")))[0].prior.terms if term.parameter.name == "rho")
    usual = known_medium("polyacrylamide")
    assert np.exp(rho.mean) == pytest.approx(1 / (0.92 / 997.05 + 0.08 * 0.70e-3), abs=1)  # volumes add
    assert 1002 < np.exp(rho.mean) < usual.rho
    assert rho.std < usual.rho_log_std / 2


@pytest.mark.parametrize(
    "said", ["gel 3 %", "water 3 %", "peg 70 %", "peg 0 %", "peg 8", "peg -3 %", "peg 8 m", "peg x"]
)
def test_a_concentration_is_of_a_polymer(said: str, tmp_path: Path) -> None:
    data = simulate("laser", "0 us:70 us:0.63 us", "2 um", tmp_path / "bubble.csv")
    done = call("init", "--data", data, *UNITS, "--medium", said)
    assert done.exit_code == 2
    assert f"medium '{said}': " in done.output


def test_a_laser_bubble_gets_the_whole_physics_and_what_to_compare_it_with() -> None:
    """The options in the file's comment give the polytropic model, and both commands take what they are given."""
    laser_film()
    assert call("init", "--data", "film.mat", "--time-step", "0.63 us", "--radius-unit", "um").exit_code == 0
    text = Path("film.yaml").read_text(encoding="utf-8")
    model = load_config(Path("film.yaml")).model
    assert (model.gas, model.vapour, model.medium_heat) == ("heat", "transport", "conducting")
    line, *_ = (line for line in text.splitlines() if line.startswith("  #   en4dvar run THIS_FILE --set model"))
    words = shlex.split(line.replace("THIS_FILE", "film.yaml").removeprefix("  #   en4dvar run "))
    assert words[-2:] == ["--out", "runs/film_polytropic"]
    assert call("validate", *words[:-2]).exit_code == 0
    changes = dict(word.split("=", 1) for word in words if "=" in word)
    simpler = load_config(Path("film.yaml"), changes).model
    assert (simpler.gas, simpler.vapour, simpler.medium_heat) == ("polytropic", "none", "cold")
    assert simpler.medium.p_v == pytest.approx(3.1e3, rel=0.05)
    assert "  #   en4dvar compare runs/film runs/film_polytropic\n" in text


def bouncing(path: Path, lobes: int) -> Path:
    """Half a lobe of Rayleigh's shape about, and so many more, each 0.7 times as high and as long."""
    rows, begin, half = [], -22.8, 22.8
    for k in range(1 + lobes):
        R, times = 250 * 0.7**k, np.arange(0.0 if k == 0 else begin, begin + 2 * half, 0.63)
        rows += [f"{t:.3f},{R * (1 - ((t - begin) / half - 1) ** 2) ** 0.4 + 12:.3f}" for t in times]
        begin, half = begin + 2 * half, 0.7 * half
    path.write_text("\n".join(["t_us,R_um", *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("law", "lobes", "said"),
    [("neo-hookean-kelvin-voigt", 3, 1), ("neo-hookean-kelvin-voigt", 2, 0), ("newtonian", 3, 0)],
)
def test_a_third_oscillation_in_a_gel_gets_its_command(tmp_path: Path, law: str, lobes: int, said: int) -> None:
    """Its options end the window a minimum later, and let the gas change at the maxima."""
    data = bouncing(tmp_path / "bubble.csv", lobes)
    done = call("init", "--data", data, *UNITS, "--law", law, "--out", "b.yaml")
    assert done.exit_code == 0, done.output
    lines = [line for line in Path("b.yaml").read_text(encoding="utf-8").splitlines() if "model_error.gas" in line]
    assert len(lines) == said
    for line in lines:
        words = shlex.split(line.replace("THIS_FILE", "b.yaml").removeprefix("  #   en4dvar run "))
        changes = dict(word.split("=", 1) for word in words if "=" in word)
        (problem,), (shorter,) = (build(load_config(Path("b.yaml"), given)) for given in (changes, {}))
        assert [name for name in problem.prior.names if "change" in name][:1] == ["gas_change_1"]
        assert len(problem.observations) > len(shorter.observations)


def test_an_acoustic_bubble_gets_no_comparison() -> None:
    source = Source("b.csv", ("t", "us"), None, ("R", "um"))
    text = yaml_text("a", source, starter("acoustic", None), "test")
    assert "gas: heat" in text
    assert "polytropic" not in text
    assert "vapour" not in text


def driven(path: Path, rest: int, std: float = 0.1) -> None:
    """A gas bubble of 8 um that ultrasound drives to 16 um, and ``rest`` readings before the sound."""
    sound = sine_burst(-0.3e6, 0.3e6, 3, delay=rest * 0.2e-6, envelope="hann")
    gel, times = {"G": 20e3, "mu": 0.03, "R0": 8e-6}, 0.2e-6 * np.arange(rest + 100)
    path_of_wall = bubble_path("neo-hookean-kelvin-voigt", gel, times, driving=sound, gas="polytropic").R[0].values
    radius = 1e6 * path_of_wall + np.random.default_rng(3).normal(0, std, len(times))
    rows = [f"{1e6 * t:.1f},{r:.4f}" for t, r in zip(times, radius, strict=True)]
    path.write_text("\n".join(["t_us,R_um", *rows, ""]))


@pytest.mark.parametrize(("rest", "std"), [(0, 0.1), (12, 0.1), (12, 0.3), (60, 0.2)])
def test_the_gas_of_a_driven_bubble_is_what_is_seen_before_it_grows(tmp_path: Path, rest: int, std: float) -> None:
    driven(tmp_path / "burst.csv", rest, std)
    done = call("init", "--data", "burst.csv", "--start", "acoustic")
    assert done.exit_code == 0, done.output
    assert "of the Rayleigh time 0.915" not in done.stderr  # which is that of an empty bubble
    (problem,) = build(proposed(Path("burst.yaml")))
    gas, G = (next(term for term in problem.prior.terms if term.parameter.name == name) for name in ("R0", "G"))
    assert abs(G.mean - np.log(20e3)) < 1.645 * G.std  # the pulse that the guess was made with is not theirs
    assert gas.std == pytest.approx(3 * np.hypot(std / 8, 0.005), rel=0.5)  # of the logarithm
    assert abs(gas.mean - np.log(8e-6)) < 2 * gas.std / 3


def test_readings_at_rest_do_not_tell_the_level_of_their_edge(tmp_path: Path) -> None:
    """They tell the sum of R0 and what moves all readings: a prior of R0 as narrow as they are would tell both."""
    driven(tmp_path / "burst.csv", 12)
    head, *rows = Path("burst.csv").read_text().splitlines()
    table = ["# R_common_um = 0.3", f"{head},R_std_um,t_std_us", *(f"{row},0.1,0.01" for row in rows), ""]
    Path("burst.csv").write_text("\n".join(table))
    assert call("init", "--data", "burst.csv", "--start", "acoustic").exit_code == 0
    (problem,) = build(proposed(Path("burst.yaml")))
    terms = {term.parameter.name: term for term in problem.prior.terms}
    gas, edge = 8e-6 * terms["R0"].std, terms["reading_offset"].std
    assert edge == pytest.approx(0.3e-6)
    assert gas * edge / np.hypot(gas, edge) > 0.9 * edge  # the offset's std once the sum is known
    assert gas < 4 * edge


def test_two_of_the_first_readings_that_are_a_little_high_end_no_rest() -> None:
    """By 3.2 standard deviations from the median of four, which errs by 0.6 of them."""
    rest = np.append([-0.04, 0.04, -0.04, -0.09, 0.22, 0.15], 0.06 * np.random.default_rng(1).standard_normal(20))
    radius = 1e-6 * np.append(11 + rest, 11 + np.linspace(0, 3, 60) * np.sin(np.arange(60)))
    assert before(1e-7 * np.arange(len(radius)), radius, 0.06e-6)[0] == pytest.approx(11e-6, abs=0.05e-6)


@pytest.mark.parametrize("begun", [3e-6, 60e-6, 120e-6])
def test_a_history_that_begins_in_growth_shows_no_bubble_at_rest(begun: float) -> None:
    times = np.arange(0, 1, 0.005)
    growth = 250e-6 * np.clip(1 - (1 - times) ** 2, 0, 1) ** 0.4
    radius = np.concatenate([growth, growth[::-1][1:]])[int(np.searchsorted(growth, begun)) :]
    radius = radius + np.random.default_rng(1).normal(0, 1e-6, len(radius))
    assert not np.isfinite(before(1e-7 * np.arange(len(radius)), radius, 1e-6)[0])


def test_a_pulse_that_is_not_known_exactly_gets_its_line(tmp_path: Path) -> None:
    driven(tmp_path / "burst.csv", 12)
    done = call("init", "--data", "burst.csv", "--start", "acoustic")
    assert "the amplitude of the pulse is taken as exact" in done.stderr
    text = Path("burst.yaml").read_text()
    Path("burst.yaml").write_text(text.replace("# p_A:", "p_A:"))
    (problem,) = build(proposed(Path("burst.yaml")))
    (term,) = (term for term in problem.prior.terms if term.parameter.name == "p_A")
    assert (term.mean, term.std) == pytest.approx((-24e6, 1.2e6))
    assert "# p_A:" in yaml_text(
        "a", Source("b.csv", ("t", "us"), None, ("R", "um")), starter("acoustic", None), "test"
    )


def test_what_a_lasting_shape_hides_is_in_the_height_of_the_top_as_in_the_scale(tmp_path: Path) -> None:
    head, *rows = write(tmp_path / "plain.csv").read_text().splitlines()
    errors = [f"{head},R_std_um,t_std_us", *(f"{row},0.1,0.02" for row in rows), ""]
    variance = {"R_max": [], "reading_scale": []}
    for name, comment in (("plain", []), ("shaped", ["# R_shape_common = 0.05"])):
        (tmp_path / f"{name}.csv").write_text("\n".join(comment + errors))
        assert call("init", "--data", f"{name}.csv", "--start", "laser").exit_code == 0
        (problem,) = build(proposed(Path(f"{name}.yaml")))
        terms = {term.parameter.name: term for term in problem.prior.terms}
        assert terms["reading_scale"].parameter.common == (name == "plain")  # a shape is each bubble's own
        variance["reading_scale"].append(terms["reading_scale"].std ** 2)
        variance["R_max"].append((terms["R_max"].std / terms["R_max"].mean) ** 2)
    for plain, shaped in variance.values():
        assert shaped - plain == pytest.approx(0.05**2, rel=0.1)


def test_the_collapse_time_is_rayleigh_s() -> None:
    """In a liquid without viscosity, gas and surface tension the lobe is Rayleigh's, integrated here."""
    rho, p, radius = 998.0, 101325.0, 200e-6

    def rhs(_: float, y: np.ndarray) -> list[float]:
        return [y[1], (-p / rho - 1.5 * y[1] ** 2) / y[0]]

    times = np.linspace(0, 0.9 * RAYLEIGH * radius * np.sqrt(rho / p), 12)
    path = solve_ivp(rhs, (0, times[-1]), [radius, 0.0], t_eval=times, rtol=1e-10, atol=1e-14)
    found = lobe(times, path.y[0])
    assert found.R_max == pytest.approx(radius, rel=0.01)
    assert found.t_c == pytest.approx(RAYLEIGH * radius * np.sqrt(rho / p), rel=0.02)


def test_the_noise_is_what_was_added() -> None:
    times = np.linspace(-0.9, 0.9, 25)
    exact = 100e-6 * (1 - times**2) ** 0.4
    stream = np.random.default_rng(0)
    found = [scatter_of(times, exact + 1e-6 * stream.standard_normal(25)) for _ in range(200)]
    assert np.median(found) == pytest.approx(1e-6, rel=0.05)
    low, high = np.quantile(found, [0.05, 0.95])  # which the prior of sigma spans
    assert 0.5e-6 < low < high < 1.7e-6
    assert np.isnan(scatter_of(times[::8], exact[::8]))


def test_what_is_no_bubble_is_told() -> None:
    with pytest.raises(DataError, match=r"maximum at 9e\+06 us, .* if it is wild, or write a .*--start laser"):
        look(np.arange(10.0), np.arange(10.0))
    t = np.arange(80) * 0.6
    with pytest.raises(DataError, match=r"reading 1 of 80, but creeps .* wild, give the readings before it .*laser"):
        look(t, 10.0 + 67.0 * np.exp(-t / 12.0))  # as in a gel of 40 kPa and 0.8 Pa s that was filmed from the top on


def test_a_shallow_rebound_is_in_the_window(tmp_path: Path) -> None:
    """Two minima between which the radius rises by 7 % of its range."""
    times = np.arange(90) * 0.5
    radius = np.where(times < 18, 195 * np.clip(1 - (times / 18.5) ** 2, 0, 1) ** 0.4, 0)
    after = times >= 18
    radius[after] = 40 + 7 * (1 - np.cos(2 * np.pi * (times[after] - 18) / 12))
    (tmp_path / "b.csv").write_text("t,R\n" + "".join(f"{t:g},{r:g}\n" for t, r in zip(times, radius, strict=True)))
    assert call("init", "--data", "b.csv", *UNITS).exit_code == 0
    config = proposed(Path("b.yaml"))
    assert config.document.data["data"]["window"] == {"from": "top", "to": "trough 2", "prominence": "5 %"}
    (problem,) = build(config)
    assert problem.observations.file_times[-1] == pytest.approx(29.5e-6, abs=1e-9)


@pytest.mark.parametrize("dirt", [False, True])
def test_a_cloud_of_fragments_is_not_predicted(tmp_path: Path, dirt: bool) -> None:
    """The top at 25 µs, collapses at 51, 76 and 99 µs, and growth from 40 to 90 µm after the last."""
    times = np.arange(250) * 1.0
    lobe = 240 * np.clip(1 - (times / 25 - 1) ** 2, 0, 1) ** 0.4
    rebounds = 130 * np.abs(np.sin((times - 51) / 8)) * np.exp(-(times - 50) / 40)
    radius = np.maximum(np.maximum(lobe, np.where((times > 51) & (times < 102), rebounds, 0)), 20)
    radius[102:] = np.linspace(40, 90, 148)
    if dirt:
        radius[200] += 30
    (tmp_path / "b.csv").write_text(
        "t,R\n" + "".join(f"{t:g},{r:g}\n" for t, r in zip(times[15:], radius[15:], strict=True))
    )
    assert call("init", "--data", "b.csv", *UNITS).exit_code == 0
    config = proposed(Path("b.yaml"))
    window = config.document.data["data"]["window"]
    assert window["to"] == "trough 2"
    assert config.document.data["data"].get("outliers") == ("leave out" if dirt else None)
    (problem,) = build(config)
    assert problem.observations.times[-1] == pytest.approx(51e-6, abs=1.1e-6)
    assert problem.observations.continued.times[-1] == pytest.approx(73e-6, abs=2e-6)


def test_a_misread_frame_is_no_trough_and_no_top(tmp_path: Path) -> None:
    """Collapses at 20 and 44 µs, a frame misread at 9 µs: behind the first trough the bubble is seen from 20 µs on."""
    stream, times = np.random.default_rng(11), np.arange(4, 80, 0.5)
    lobes = [np.maximum(1 - ((times - at) / half) ** 2, 0) ** 0.4 for at, half in ((0, 20), (32, 12), (52, 8), (66, 6))]
    radius = np.sum(np.array([200, 110, 80, 70])[:, None] * lobes, axis=0) + 15
    radius += 0.5 * stream.standard_normal(len(times))
    spoilt = np.where(times == 9, 0.6 * radius, np.where(times == 32.0, 1.9 * radius, radius))
    texts = []
    for values in (radius, spoilt):
        (tmp_path / "b.csv").write_text("t,R\n" + "".join(map("{:g},{:.3f}\n".format, times, values)))
        assert call("init", "--data", "b.csv", *UNITS, "--since", "trough 1", "--force").exit_code == 0
        texts.append(Path("b.yaml").read_text(encoding="utf-8"))
    clean, of_spoilt = (resolve(parse_document(text), tmp_path).document.data for text in texts)
    assert "outliers" not in clean["data"]  # the readings at 44 and 60 µs are collapses, not slips
    assert of_spoilt["data"].pop("outliers") == "leave out"
    assert "# WARNING: b: the 2 readings at 9, 32 us are too far from the neighbours" in texts[1]
    tops = [float(it["parameters"]["R_max"]["mean"].split()[0]) for it in (clean, of_spoilt)]
    assert tops[1] == pytest.approx(tops[0], rel=0.02)
    assert [it["data"]["window"] for it in (clean, of_spoilt)] == [clean["data"]["window"]] * 2


@pytest.mark.parametrize("start", ["acoustic", "laser"])
@pytest.mark.parametrize("law", sorted(REGISTRY))
def test_every_law_has_a_starter_that_validates(tmp_path: Path, start: str, law: str) -> None:
    source = Source("b.csv", ("t", "us"), None, ("R", "um"))
    if REGISTRY[law].released and start == "acoustic":
        with pytest.raises(ConfigError, match=f"--law {law} --start acoustic: {law} needs start: laser"):
            starter(start, law)
        return
    text = yaml_text("a", source, starter(start, law), "test")  # type: ignore[arg-type]
    config = resolve(parse_document(text, "a.yaml"), tmp_path)
    assert {e.parameter.name for e in config.parameters} == {*(p.name for p in config.model.parameters), "t_s"}


@pytest.mark.parametrize("resting", [3, 1])
def test_the_radius_at_rest_of_bubbles_that_differ_in_size_is_that_of_each(tmp_path: Path, resting: int) -> None:
    """In all proportions of the largest reading, which tells it as well of those that are not seen at rest."""
    (tmp_path / "gel").mkdir()
    sizes = {"large": 2.0, "middle": 1.0, "small": 0.5}
    for n, (name, size) in enumerate(sizes.items()):
        film = np.loadtxt(write(tmp_path / "film.csv"), delimiter=",", skiprows=1)[: None if n < resting else 46] * size
        np.savetxt(tmp_path / "gel" / f"{name}.csv", film, delimiter=",", header="t_us,R_um", comments="")
    assert call("init", "--data", write(tmp_path / "film.csv"), *UNITS, "--out", "alone.yaml").exit_code == 0
    done = call("init", "--data", "gel", *UNITS)
    assert done.exit_code == 0, done.output
    (alone,) = build(proposed(Path("alone.yaml")))
    for size, problem in zip(sizes.values(), build(proposed(Path("gel.yaml"))), strict=True):
        for term, other in zip(problem.prior.terms, alone.prior.terms, strict=True):
            if term.parameter.name in ("G", "mu", "R_eq"):
                moved = np.log(size) if term.parameter.name == "R_eq" else 0
                assert term.mean == pytest.approx(other.mean + moved, abs=0.05), term.parameter.name
                assert term.std == pytest.approx(other.std, rel=0.1)


def laser_film(**scalars: float) -> None:
    t = np.arange(0, 90, 0.63)
    R = 194 * np.maximum(0.14, np.abs(np.cos(np.pi * t / 37)) ** 0.6 * np.exp(-t / 90))
    savemat("film.mat", {"R": R, **scalars})


def test_the_radius_at_rest_is_that_of_the_file(tmp_path: Path) -> None:
    laser_film(Req=21.79, deltat=0.63)
    done = call("init", "--data", "film.mat", *UNITS)
    assert done.exit_code == 0, done.output
    assert "others in the file: Req 21.79, deltat 0.63" in done.stderr
    (problem,) = build(load_config("film.yaml"))
    assert problem.fixed["R_eq"] == pytest.approx(21.79e-6)
    assert np.diff(problem.observations.times) == pytest.approx(0.63e-6)  # no column of times: the file's step
    laser_film(Req=21.79e-6, deltat=0.63)  # in another unit than the radii, which is not guessed
    done = call("init", "--data", "film.mat", *UNITS, "--force")
    assert "Req 2.179e-05 of the file is not used: in um, like its radii, it is no plausible R_eq" in done.stderr
    (problem,) = build(load_config("film.yaml"))
    assert "R_eq" in problem.prior.names


def test_the_radius_at_rest_is_that_of_each_element(tmp_path: Path) -> None:
    laser_film()
    R = loadmat("film.mat")["R"]
    elements = [(0.63e-6 * np.arange(R.size), 1e-6 * R, 1e-6 * rest) for rest in (20, 22)]
    fields = [("t", "O"), ("Roft", "O"), ("Req", "O")]
    savemat("gel.mat", {"expts": np.array([elements], dtype=fields)})
    words = ["--data", "gel.mat", "--time-unit", "s", "--radius-unit", "m"]
    done = call("init", *words, "--time-column", "expts.t", "--radius-column", "expts.Roft")
    assert done.exit_code == 0, done.output
    problems = build(load_config("gel.yaml"))
    assert [problem.fixed["R_eq"] for problem in problems] == pytest.approx([20e-6, 22e-6])


def rescaled(path: Path, factor: float) -> Path:
    data = loadmat(path)
    savemat(path.name, {"t": data["t"], "Rnew": factor * data["Rnew"]})
    return Path(path.name)


@pytest.mark.parametrize(
    ("file", "unit", "G", "rest"),
    [
        ("A_E2_002.mat", "um", 1.9e3, 21.8e-6),
        ("PA1_exp2_RofTdata_0.mat", "0.7452 m", 5.1e3, 47e-6),  # 2.76 µm a pixel, not 3.7037 µs
    ],
)
def test_measured_films(file: str, unit: str, G: float, rest: float) -> None:
    """G of a least-squares fit, R_eq of the file: within what the proposed prior expects."""
    path = MEASURED / file
    if not path.exists():
        pytest.skip(f"measured data not present: {path}")
    if unit.startswith("0"):
        path, unit = rescaled(path, float(unit.split()[0])), "m"
    done = call("init", "--data", path, "--time-unit", "s", "--radius-unit", unit)
    assert done.exit_code == 0, done.output
    assert "Rayleigh time 0.915" not in done.stderr
    config = proposed(Path(f"{path.stem}.yaml"))
    assert config.document.data["model"]["start"] == "laser"
    (problem,) = build(config)
    terms = {term.parameter.name: term for term in problem.prior.terms}
    if "R_eq" in problem.fixed:  # that of the file
        assert problem.fixed["R_eq"] == pytest.approx(rest, rel=1e-3)
    for name, value in {"G": G, "R_eq": rest}.items():
        if name in problem.fixed:
            continue
        assert abs(np.log(value) - terms[name].mean) < 2 * terms[name].std, name


def test_zeros_before_the_bubble_are_no_readings(tmp_path: Path) -> None:
    data = simulate("laser", "0 us:70 us:0.63 us", "1 um", tmp_path / "bubble.csv")
    series = read_series(data, Column("t_us", "us", "us"), Column("radius_um", "um", "um"))
    t, R = series.times, series.values
    t, R = np.append(np.arange(-3, 0) * 0.63, t), np.append(np.zeros(3), R)
    Path("film.csv").write_text("t_us,R_um\n" + "".join(f"{a},{b}\n" for a, b in zip(t, R, strict=True)))
    done = call("init", "--data", "film.csv", *UNITS)
    assert "start: laser (the history begins at" in done.stdout
    whole = {"data.window": {"from": "start", "to": "end"}, "data.time_zero": "window"}
    (problem,) = build(load_config("film.yaml", whole))
    assert problem.observations.values.min() > 0


@pytest.mark.skipif(not (MEASURED / "bubbles" / "water").exists(), reason="../shared/data/bubbles/water is not there")
def test_a_bubble_in_water_is_not_taken_for_one_in_a_thick_liquid(tmp_path: Path) -> None:
    """The priors of viscosity and gas hold what is known of it: 0.9 mPa s, and 51 to 55 µm by its rebounds."""
    data = str(MEASURED / "bubbles" / "water" / "water_1200um.csv")
    done = call("init", "--data", data, "--medium", "water", "--law", "newtonian", "--out", "w.yaml")
    assert done.exit_code == 0, done.output
    (problem,) = build(load_config(Path("w.yaml")))
    of = {term.parameter.name: term for term in problem.prior.terms}
    for name, value in {"mu": 0.89e-3, "R_eq": 53e-6}.items():
        assert abs(np.log(value) - of[name].mean) < of[name].std
        assert of[name].std >= 1


def test_what_is_expected_after_the_window_allows_for_less_damping_in_a_liquid_alone(tmp_path: Path) -> None:
    data = simulate("laser", "0 us:70 us:0.63 us", "1 um", tmp_path / "bubble.csv")
    for law, changing in (("newtonian", {"gas", "viscosity"}), ("neo-hookean-kelvin-voigt", {"gas"})):
        done = call("init", "--data", data, *UNITS, "--law", law, "--out", f"{law}.yaml")
        assert done.exit_code == 0, done.output
        (problem,) = build(load_config(Path(f"{law}.yaml")))
        assert set(problem.model.unforeseen) == changing
