"""``en4dvar init``: from data alone to a configuration that validates and runs; units are never guessed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from jsonschema import Draft202012Validator
from scipy.integrate import solve_ivp
from scipy.io import loadmat, savemat

from en4dvar.cli import main
from en4dvar.config import Config, load_config, resolve
from en4dvar.config.build import build
from en4dvar.config.document import parse_document, read_document
from en4dvar.errors import DataError
from en4dvar.inputs.readers import Column, read_series
from en4dvar.report.result import load_result
from en4dvar_bubble import commands_init
from en4dvar_bubble.collapse import RAYLEIGH, lobe
from en4dvar_bubble.laws import REGISTRY
from en4dvar_bubble.starter.look import look, noise
from en4dvar_bubble.starter.page import Source, quoted, yaml_text
from en4dvar_bubble.starter.proposal import starter

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
MEASURED = ROOT.parent / "shared" / "data"
UNITS = ("--time-unit", "us", "--radius-unit", "um")
TRUTH = {
    "acoustic": {"G": 420.0, "alpha": 0.029, "mu": 0.086, "R0": 0.43e-6, "t_s": 0.25e-6},
    "laser": {"G": 2500.0, "mu": 0.09, "R_eq": 22e-6, "R_max": 195e-6, "t_s": 0.0},
}


@pytest.fixture(autouse=True)
def _in_its_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def call(*arguments: str | Path, **options: str) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments], **options)  # type: ignore[arg-type]


def simulate(start: str, times: str, noise_std: str, path: Path, seed: int = 1) -> Path:
    """Synthetic data at TRUTH, by ``en4dvar simulate`` from a configuration without data."""
    units = {"G": "Pa", "alpha": "", "mu": "Pa s", "R0": "m", "R_eq": "m", "R_max": "m", "t_s": "s"}
    values = [f"  {name}: {value} {units[name]}".rstrip() for name, value in TRUTH[start].items()]
    law = {"acoustic": "quadratic-kelvin-voigt", "laser": "neo-hookean-kelvin-voigt"}[start]
    gas = {"acoustic": "heat", "laser": "polytropic, vapour_pressure: saturated"}[start]
    model = f"model: {{name: bubble, law: {law}, start: {start}, gas: {gas}}}"
    config = path.with_suffix(".truth.yaml")
    config.write_text("\n".join(["name: truth", model, "parameters:", *values, ""]), encoding="utf-8")
    done = call(
        "simulate", config, "--times", times, "--noise", noise_std, "--seed", str(seed), "--out", path, "--force"
    )
    assert done.exit_code == 0, done.output
    return path


def proposed(path: Path) -> Config:
    config = load_config(path)
    build(config)  # and its data can be read
    return config


@pytest.mark.parametrize(
    ("start", "times", "noise_std"),
    [
        ("acoustic", "5.6 us:30.1 us:1.4 us", "1.4 um"),  # multi-flash imaging: some 18 frames
        ("acoustic", "0 us:60 us:0.5 us", "1.4 um"),  # from the nucleus through rebounds
        # A high-speed film from R_max on, the bubble not yet at rest.
        pytest.param("laser", "0 us:70 us:0.63 us", "2 um", marks=pytest.mark.slow),
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
        truth = TRUTH[start][term.parameter.name]
        transformed = np.log(truth) if term.transform == "lognormal" else truth
        assert abs(transformed - term.mean) < 3 * term.std, term.parameter.name
    assert text.startswith("# yaml-language-server: $schema=en4dvar.schema.json\n")
    schema = json.loads(Path("en4dvar.schema.json").read_text(encoding="utf-8"))
    assert list(Draft202012Validator(schema).iter_errors(read_document(Path("bubble.yaml")).data)) == []
    assert call("validate", "bubble.yaml").exit_code == 0
    run = call("run", "bubble.yaml", "--no-report")
    assert run.exit_code == 0, run.output
    result = load_result(Path("runs") / "bubble" / "posterior.nc")
    assert result.sample_stats.attrs["converged"] == 1
    assert result.sample_stats.attrs["nrmse"] > 0.9
    rows = {row.name: row for row in result.summary()}
    assert rows["mu"].unit == "Pa s"
    assert abs(rows["mu"].mean - TRUTH[start]["mu"]) < 4 * rows["mu"].std


def test_the_lines_to_be_uncommented_are_right(tmp_path: Path) -> None:
    data = simulate("laser", "0 us:70 us:0.63 us", "2 um", tmp_path / "bubble.csv")
    call("init", "--data", data, "--time-unit", "us", "--radius-unit", "um")
    text = Path("bubble.yaml").read_text(encoding="utf-8")
    for line in ("discrepancy: estimated", "sigma: {prior"):
        assert text.count(f"# {line}") == 1
        text = text.replace(f"# {line}", line)
    Path("bubble.yaml").write_text(text, encoding="utf-8")
    (problem,) = build(load_config(Path("bubble.yaml")))
    assert {"sigma", "discrepancy_amplitude", "discrepancy_length"} < set(problem.prior.names)


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
    found = [noise(times, exact + 1e-6 * stream.standard_normal(25)) for _ in range(200)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(1e-6, rel=0.05)
    assert np.isnan(noise(times[::8], exact[::8]))


def test_what_is_no_bubble_is_told() -> None:
    with pytest.raises(DataError, match="fewer than four samples"):
        look(np.arange(10.0), np.arange(10.0))


def write(path: Path, header: str = "t_us,R_um", scale: float = 1.0) -> Path:
    """A film of a released bubble: Rayleigh's collapse, rebound, rest."""
    times = np.arange(60) * 0.7
    rebound = 60 * np.sqrt(np.clip(1 - ((times - 27) / 8) ** 2, 0, 1))
    radius = np.where(times < 18.2, 195 * np.clip(1 - (times / 18.5) ** 2, 0, 1) ** 0.4, np.maximum(rebound, 22))
    path.write_text("\n".join([header, *(f"{t:g},{scale * r:g}" for t, r in zip(times, radius, strict=True)), ""]))
    return path


def test_without_units_and_terminal_one_error_says_what_to_add(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv"))
    assert done.exit_code == 2
    fault = done.stderr.splitlines()[-1]
    assert "columns with numbers: t_us, R_um; units are never guessed" in fault
    assert "add --time-unit UNIT (e.g. us), --radius-unit UNIT (e.g. um)" in fault
    done = call("init", "--data", write(tmp_path / "b.csv", "a,b"), "--time-unit", "us")
    needed = "add --time-column NAME, --radius-column NAME, --radius-unit UNIT (e.g. um)"
    assert needed in done.stderr
    assert not list(tmp_path.glob("*.yaml"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--time-unit", "us", "--radius-unit", "Pa"), "unit 'Pa' cannot be converted to 'm'"),
        (("--time-unit", "usec", "--radius-unit", "um"), "did you mean 'us'"),
        ((*UNITS, "--radius-column", "x"), "no column 'x'; the columns are: t_us, R_um"),
        ((*UNITS, "--law", "newtonain"), "did you mean 'newtonian'"),
        ((*UNITS, "--out", "nowhere/b.yaml"), "nowhere/b.yaml: the folder nowhere does not exist"),
    ],
)
def test_wrong_options(tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv"), *options)
    assert done.exit_code == 2, done.output
    assert message in done.stderr
    assert not list(tmp_path.glob("*.yaml"))


def test_on_a_terminal_it_asks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands_init, "_interactive", lambda: True)
    done = call("init", "--data", write(tmp_path / "b.csv", "when,size"), input="size\nwhen\nus\nPa\num\n")
    assert done.exit_code == 0, done.output
    assert "unit 'Pa' cannot be converted to 'm'" in done.stderr  # asked again
    columns = proposed(Path("b.yaml")).document.data["data"]["columns"]
    assert columns == {"time": {"name": "when", "unit": "us"}, "radius": {"name": "size", "unit": "um"}}


def test_nothing_is_replaced_without_force(tmp_path: Path) -> None:
    write(tmp_path / "b.csv")
    assert call("init", "--data", "b.csv", *UNITS).exit_code == 0
    Path("b.yaml").write_text("mine")
    done = call("init", "--data", "b.csv", *UNITS)
    assert (done.exit_code, done.stderr) == (2, "b.yaml: exists; give --force to replace it, or another --out\n")
    assert Path("b.yaml").read_text() == "mine"
    assert call("init", "--data", "b.csv", *UNITS, "--force").exit_code == 0
    assert proposed(Path("b.yaml")).document.data["data"]["path"] == "b.csv"


def test_one_column_tells_what_the_other_is(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv", "Zeit;radius".replace(";", ",")), *UNITS)
    assert done.exit_code == 0, done.output
    assert proposed(Path("b.yaml")).document.data["data"]["columns"]["time"]["name"] == "Zeit"


def test_a_shallow_rebound_is_in_the_window(tmp_path: Path) -> None:
    """Two minima between which the radius rises by 7 % of its range."""
    times = np.arange(90) * 0.5
    radius = np.where(times < 18, 195 * np.clip(1 - (times / 18.5) ** 2, 0, 1) ** 0.4, 0)
    after = times >= 18
    radius[after] = 40 + 7 * (1 - np.cos(2 * np.pi * (times[after] - 18) / 12))
    (tmp_path / "b.csv").write_text("t,R\n" + "".join(f"{t:g},{r:g}\n" for t, r in zip(times, radius, strict=True)))
    assert call("init", "--data", "b.csv", *UNITS).exit_code == 0
    config = proposed(Path("b.yaml"))
    assert config.document.data["data"]["window"] == {"from": "R_max", "to": "minimum 2", "prominence": "5 %"}
    (problem,) = build(config)
    assert problem.observations.times[-1] == pytest.approx(30e-6, abs=1e-6)


def test_the_run_is_called_like_the_file(tmp_path: Path) -> None:
    write(tmp_path / "film 1.csv")
    assert call("init", "--data", "film 1.csv", *UNITS).exit_code == 0
    assert proposed(Path("film_1.yaml")).name == "film_1"
    assert call("init", "--data", "film 1.csv", *UNITS, "--out", "my_gel.yaml").exit_code == 0
    assert proposed(Path("my_gel.yaml")).name == "my_gel"
    assert call("init", "--out", "other.yaml").exit_code == 0
    assert load_config("other.yaml").name == "other"


def test_a_constant_step_instead_of_times(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv"), "--time-step", "0.7 us", "--radius-unit", "um")
    assert done.exit_code == 0, done.output
    assert proposed(Path("b.yaml")).document.data["data"]["columns"]["time"] == {"step": "0.7 us"}


def test_a_folder_is_a_campaign_and_its_odd_file_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "gel one"
    folder.mkdir()
    for n in (1, 2):
        write(folder / f"b{n}.csv", scale=1 + n / 20)
    done = call("init", "--data", folder, *UNITS)
    assert done.exit_code == 0, done.output
    assert len(build(proposed(Path("gel_one.yaml")))) == 2
    simulate("acoustic", "0 us:40 us:0.5 us", "1 um", folder / "other.csv")
    text = (folder / "other.csv").read_text().replace("t_us,radius_um", "t_us,R_um")
    (folder / "other.csv").write_text(text)
    (folder / "other.truth.yaml").unlink()
    done = call("init", "--data", folder, *UNITS, "--force")
    assert done.exit_code == 2
    assert "suggest different starts (acoustic: other; laser: b1, b2); say --start" in done.stderr
    (folder / "another.csv").write_text("")  # first of the folder, and empty
    (folder / "other.csv").write_text("a,b\n1,2\n")
    done = call("init", "--data", folder, *UNITS, "--force")
    assert done.exit_code == 0, done.output  # as in a campaign: what cannot be used is named and ends nothing
    assert "other.csv: no column" in done.stderr
    assert "another.csv: the file holds no data" in done.stderr
    assert Path("gel_one.yaml").read_text().count("# MIND: ") == 2
    for n in (1, 2):
        (folder / f"b{n}.csv").unlink()
    done = call("init", "--data", folder, *UNITS, "--force")
    assert done.exit_code == 2
    assert done.stderr.count("other.csv: ") == 2


def test_units_that_cannot_be_right_are_noticed(tmp_path: Path) -> None:
    done = call("init", "--data", write(tmp_path / "b.csv"), "--time-unit", "ms", "--radius-unit", "um")
    assert done.exit_code == 0, done.output
    assert "are the units of both columns right?" in done.stderr
    assert "# MIND: the collapse takes" in Path("b.yaml").read_text()
    done = call("init", "--data", "b.csv", "--time-unit", "s", "--radius-unit", "m", "--force")  # both, by as much
    assert "no bubble has such a radius; are the units of both columns right?" in done.stderr


@pytest.mark.parametrize(
    ("header", "options", "told"),
    [
        ("t_us,R [mm]", UNITS, ["the name of column 'R [mm]' says mm, but its unit is given as um"]),
        ("time (ms),R_um", UNITS, ["the name of column 'time (ms)' says ms, but its unit is given as us"]),
        ("frame,R_um", UNITS, ["'frame' seems to count frames; then give --time-step"]),
        ("t_us,D_um", UNITS, ["'D_um' seems to hold diameters"]),
        ("t_us,radius_px", UNITS, ["'radius_px' seems to hold pixels"]),
        ("t_us,R_um", UNITS, []),
        ("Time (µs),R [µm]", UNITS, []),
        ("t,radius at equator", UNITS, []),
    ],
)
def test_a_name_that_says_something_else_is_noticed(
    tmp_path: Path, header: str, options: tuple[str, ...], told: list[str]
) -> None:
    text = write(tmp_path / "b.csv").read_text()
    Path("b.csv").write_text(text.replace("t_us,R_um", header), encoding="utf-8")
    time, radius = header.split(",")
    done = call("init", "--data", "b.csv", *options, "--time-column", time, "--radius-column", radius)
    assert done.exit_code == 0, done.output
    doubts = [line for line in done.stderr.splitlines() if "seems to" in line or "the name of column" in line]
    assert len(doubts) == len(told)
    assert all(words in doubts[0] for words in told)


def test_decimal_commas_are_noticed(tmp_path: Path) -> None:
    text = write(tmp_path / "b.csv").read_text().replace(",", ";").replace(".", ",")
    Path("b.csv").write_text(text)
    done = call("init", "--data", "b.csv", *UNITS)
    assert done.exit_code == 0, done.output
    assert "b.csv, decimal commas: t_us (60 values, 0 to 41.3)" in done.stderr
    config = proposed(Path("b.yaml"))
    assert config.document.data["data"]["decimal"] == ","
    assert build(config)[0].observations.values.max() == pytest.approx(195e-6)


def test_vectors_that_a_mat_file_hides_are_told(tmp_path: Path) -> None:
    savemat("b.mat", {"film": {"note": "by hand"}})
    done = call("init", "--data", "b.mat", *UNITS)
    assert (done.exit_code, done.stderr) == (2, f"{tmp_path}/b.mat: film is a struct; save what is in it as vectors\n")
    savemat("b.mat", {"t": np.arange(9.0), "R": np.ones((3, 9))})
    done = call("init", "--data", "b.mat", *UNITS)
    assert "b.mat: R is an array of 3 x 9; its columns are R(:,1), R(:,2), …, its rows R(1,:), …\n" in done.stderr
    assert "R(:,9); units are never guessed: add --radius-column NAME" in done.stderr


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,R\nus,um\n", "b.csv:2: 'us' in column 't' is not a number"),
        ("t,R\n", "b.csv: no line follows the header"),
    ],
)
def test_without_a_column_of_numbers_the_reason_is_told(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "b.csv").write_text(text)
    done = call("init", "--data", "b.csv", *UNITS)
    assert done.exit_code == 2
    assert message in done.stderr
    assert "columns with numbers" not in done.stderr


@pytest.mark.parametrize("start", ["acoustic", "laser"])
@pytest.mark.parametrize("law", sorted(REGISTRY))
def test_every_law_has_a_starter_that_validates(tmp_path: Path, start: str, law: str) -> None:
    source = Source("b.csv", ("t", "us"), None, ("R", "um"))
    text = yaml_text("a", source, starter(start, law), "test")  # type: ignore[arg-type]
    config = resolve(parse_document(text, "a.yaml"), tmp_path)
    assert {e.parameter.name for e in config.parameters} == {*(p.name for p in config.model.parameters), "t_s"}


def test_without_data_a_starter_is_written() -> None:
    done = call("init", "--start", "laser")
    assert done.exit_code == 0, done.output
    assert load_config("bubble.yaml").document.data["model"]["start"] == "laser"
    assert "bubble.csv: no such file" in call("validate", "bubble.yaml").stderr


def test_names_are_quoted_where_yaml_needs_it() -> None:
    for text in ("R (um)", "1", "no", "a: b", "#", "t,s", "Größe", "R_um", "a b"):
        assert parse_document(f"x: {{name: {quoted(text)}, unit: m}}").data == {"x": {"name": text, "unit": "m"}}


def rescaled(path: Path, factor: float) -> Path:
    data = loadmat(path)
    savemat(path.name, {"t": data["t"], "Rnew": factor * data["Rnew"]})
    return Path(path.name)


def test_a_scale_that_cannot_be_is_told_and_no_prior_is_taken_from_it(tmp_path: Path) -> None:
    """At 0.7 of its collapse time a laser bubble is one in a very stiff gel: G is not guessed from it."""
    data = simulate("laser", "0 us:70 us:0.63 us", "1 um", tmp_path / "bubble.csv")
    done = call("init", "--data", data, *UNITS)
    assert "Rayleigh time 0.915" not in done.stderr
    assert "first guess from collapse time" in Path("bubble.yaml").read_text()
    series = read_series(data, Column("t_us", "us", "us"), Column("radius_um", "um", "um"))
    t, R = series.times, series.values
    rows = "".join(f"{a},{b}\n" for a, b in zip(0.68 * t, R, strict=True))
    Path("fast.csv").write_text(f"t_us,radius_um\n{rows}")
    done = call("init", "--data", "fast.csv", *UNITS)
    assert "or the time step 1.38" in done.stderr
    written = Path("fast.yaml").read_text()
    assert "first guess from collapse time" not in written
    assert "# MIND: the collapse takes 0.7" in written
    done = call("validate", "fast.yaml")
    assert "warning: fast: the collapse takes 0.7" in done.stderr


def test_zeros_before_the_bubble_are_no_readings(tmp_path: Path) -> None:
    data = simulate("laser", "0 us:70 us:0.63 us", "1 um", tmp_path / "bubble.csv")
    series = read_series(data, Column("t_us", "us", "us"), Column("radius_um", "um", "um"))
    t, R = series.times, series.values
    t, R = np.append(np.arange(-3, 0) * 0.63, t), np.append(np.zeros(3), R)
    Path("film.csv").write_text("t_us,R_um\n" + "".join(f"{a},{b}\n" for a, b in zip(t, R, strict=True)))
    done = call("init", "--data", "film.csv", *UNITS)
    assert "start: laser (the history begins at" in done.stdout
    (problem,) = build(load_config("film.yaml", {"data.window": {"from": "start", "to": "end"}}))
    assert problem.observations.values.min() > 0


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
    assert "Req 2.179e-05 of the file is not used: it is no radius at rest in um" in done.stderr
    (problem,) = build(load_config("film.yaml"))
    assert "R_eq" in problem.prior.names


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


def test_one_table_of_many_bubbles(tmp_path: Path) -> None:
    text = write(tmp_path / "b.csv").read_text().splitlines()[1:]
    rows = [f"{name},{line}" for name in ("one", "two") for line in (text if name == "one" else text[::-1])]
    Path("b.csv").write_text("\n".join(["gel,t_us,R_um", *rows, rows[-1], ""]))
    done = call("init", "--data", "b.csv", *UNITS, "--by", "gel")
    assert "times must increase" in done.stderr  # of the second, which is named among the warnings
    done = call(
        "init", "--data", "b.csv", *UNITS, "--by", "gel", "--unsorted", "sort", "--repeated", "average", "--force"
    )
    assert done.exit_code == 0, done.output
    problems = build(proposed(Path("b.yaml")))
    assert [p.observations.name for p in problems] == ["b_one", "b_two"]
    assert np.array_equal(problems[0].observations.values, problems[1].observations.values)


def test_a_rate_that_the_times_contradict_is_told(tmp_path: Path) -> None:
    write(tmp_path / "b.csv")
    done = call("init", "--data", "b.csv", *UNITS, "--frame-rate", "270 kHz")
    told = "the times are 0.7 us apart, which is no whole number of frames: at the rate given one takes 3.704 us"
    assert told in done.stderr
    assert f"# MIND: {told}" in Path("b.yaml").read_text()
    assert f"warning: b: {told}" in call("validate", "b.yaml").stderr
    (problem,) = build(load_config("b.yaml"))
    assert [c.code for c in problem.observations.doubts] == ["implausible-data"]
    assert call("init", "--data", "b.csv", *UNITS, "--frame-rate", f"{1 / 0.7} MHz", "--force").exit_code == 0
    assert build(load_config("b.yaml"))[0].observations.doubts == ()
    Path("b.yaml").write_text(Path("b.yaml").read_text().replace("MHz", "parsec"))
    assert "b.yaml:" in call("validate", "b.yaml").stderr
    assert "data.columns.time.rate: " in call("validate", "b.yaml").stderr


def test_rows_of_summaries_are_explained(tmp_path: Path) -> None:
    radius = np.array([365e-6, 399e-6, 298e-6])
    rows = np.column_stack([radius, [6.1, 5.9, 6.3], 0.9 * RAYLEIGH * radius / 10])
    savemat("b.mat", {"pIMR_array": rows})
    done = call("init", "--data", "b.mat")
    assert done.exit_code == 2
    assert "pIMR_array(:,3) are 3 rows of R_max, R_max/R_eq and collapse time in SI units" in done.stderr
    savemat("b.mat", {"a": rows * [1e6, 1, 1]})  # in micrometres, which nobody said
    assert "--radius-column NAME" in call("init", "--data", "b.mat").stderr


def test_a_pixel_that_the_file_holds_is_told(tmp_path: Path) -> None:
    savemat("b.mat", {"R": np.arange(9.0), "deltat": 3.7e-6, "deltax": 2.76e-6})
    done = call("init", "--data", "b.mat", "--time-unit", "s")
    assert "deltax is the size of one in m, '2.76e-06*m')" in done.stderr
