"""Loading: what a good file gives, and one clear, located message for each bad one."""

from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
from toy_config import YAML, write_toy

from en4dvar.config import load_config
from en4dvar.config.context import Context
from en4dvar.config.parameters import Fixed, Uncertain
from en4dvar.config.quantities import quantity, time_unit
from en4dvar.config.schema import Section
from en4dvar.plumbing.errors import ConfigError
from en4dvar.plumbing.units import Quantity
from en4dvar.schemes.settings import AssimilationSettings


def faults(tmp_path: Path, *replacements: tuple[str, str]) -> list[str]:
    with pytest.raises(ConfigError) as error:
        load_config(write_toy(tmp_path, *replacements))
    return [str(f).removeprefix(f"{tmp_path}/") for f in error.value.problems]


def test_good_file(tmp_path: Path) -> None:
    config = load_config(write_toy(tmp_path))
    assert (config.name, config.seed, config.weights) == ("toy", 3, "sum")
    assert config.text == YAML
    assert config.assimilation == AssimilationSettings(members=8, max_iterations=8)
    assert config.directory == Path("runs/toy")
    assert config.data is not None
    assert config.data.series[0].data.error.std is not None
    assert config.data.series[0].data.error.std.value == 2e-6
    assert [type(p) for p in config.parameters] == [Uncertain, Uncertain, Fixed]
    assert config.model.mass == 2e-3  # type: ignore[attr-defined]
    with pytest.raises(FrozenInstanceError):
        config.seed = 4  # type: ignore[misc]


def test_defaults_of_the_model_and_the_time_shift(tmp_path: Path) -> None:
    config = load_config(write_toy(tmp_path, ("  c: 0.02 N s/m\n", "  t_s: {prior: normal, mean: 0 s, std: 0.1 ms}\n")))
    assert config.parameters[2] == Fixed(config.model.parameters[2], 0.0)
    shift = config.parameters[3]
    assert isinstance(shift, Uncertain)
    assert shift.term().std == pytest.approx(1e-4)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("seed: 3", "sede: 3", "toy.yaml:2:1: sede: unknown key 'sede'; did you mean 'seed'?"),
        ("members: 8", "member: 8", "toy.yaml:17:3: assimilation.member: unknown key 'member'; did you mean 'mem"),
        ("mass: 2 g", "mas: 2 g", "toy.yaml:11:3: model.mas: unknown key 'mas'; did you mean 'mass'?"),
        ("name: t_ms", "nam: t_ms", "toy.yaml:6:12: data.columns.time.nam: unknown key 'nam'; did you mean 'name'?"),
        ("mass: 2 g", "law: cubik", "toy.yaml:11:8: model.law: 'cubik' is not one of linear, cubic; did you mean 'cub"),
        ("mass: 2 g", "mass: 2", "toy.yaml:11:9: model.mass: 2 has no unit; write e.g. '2 kg'"),
        ("mass: 2 g", "mass: -2 g", "toy.yaml:11:9: model.mass: should be greater than 0, not '-2 g'"),
        ("toy_models:Oscillator", "buble", "toy.yaml:10:9: model.name: unknown model 'buble'; did you mean 'bubble'?"),
        ("toy_models:Oscillator", "toy_models:No", "toy.yaml:10:9: model.name: model 'toy_models:No' cannot be loaded"),
        ("toy_models:Oscillator", "no_module:No", "toy.yaml:10:9: model.name: model 'no_module:No' cannot be loaded"),
        ("toy_models:Oscillator", "pathlib:Path", "toy.yaml:10:9: model.name: 'pathlib:Path' is not a subclass"),
        (", unit: um", "", "toy.yaml:7:5: data.columns.position.unit: required, but not given"),
        ("{name: t_ms, unit: ms}", "t_ms", "toy.yaml:6:11: data.columns.time: its unit is missing; write {name: t_ms,"),
        ("{name: x_um, unit: um}", "x_um", "toy.yaml:7:15: data.columns.position: its unit is missing; write {name"),
        (", unit: ms", "", "toy.yaml:6:11: data.columns.time: the unit of column 't_ms' is missing"),
        ("unit: um", "unit: us", "toy.yaml:7:34: data.columns.position.unit: unit 'us' cannot be converted to 'm'"),
        ("unit: um", "unit: mum", "toy.yaml:7:34: data.columns.position.unit: unknown unit 'mum'"),
        ("    position:", "    radius:", "toy.yaml:7:5: data.columns.radius: unknown column role 'radius'; known: "),
        ("position_std: 2 um", "position_std: 1e-6", "toy.yaml:8:25: data.error.position_std: 1e-06 has no unit"),
        ("position_std: 2 um", "position_std: -2 um", "toy.yaml:8:25: data.error.position_std: must be positive, not"),
        ("position_std: 2 um", "position_std: 1 %", "toy.yaml:8:25: data.error.position_std: '1 %' is a share, but"),
        ("position_std: 2 um", "time_std: 2 us", "toy.yaml:8:3: data.error.position_std: required"),
        ("2 um}", "2 um, time_std: -1 us}", "toy.yaml:8:41: data.error.time_std: must not be negative"),
        ("2 um}", "2 um, time_std: -5 % of step}", "toy.yaml:8:41: data.error.time_std: must not be negative"),
        ("2 um}", "2 um}\n  window: {to: minimun 2}", "toy.yaml:9:16: data.window.to: 'minimun 2' is not an instant"),
        ("2 um}", "2 um}\n  time_zero: nucleation", "toy.yaml:9:14: data.time_zero: write file, window, top, a time o"),
        ("std: 1 %", "std: -1 %", "toy.yaml:13:42: parameters.A.std: must be positive, not -1 %"),
        ("median: 3 N/m", "median: 3", "toy.yaml:14:33: parameters.k.median: 3 has no unit; write e.g. '3 N/m'"),
        ("median: 3 N/m", "median: -3 N/m", "toy.yaml:14:33: parameters.k.median: -3 N/m is outside the bounds"),
        ("median: 3 N/m", "median: 0 N/m", "toy.yaml:14:6: parameters.k: "),
        ("log_std: 0.3", "log_std: -0.3", "toy.yaml:14:49: parameters.k.log_std: should be greater than 0, not -0.3"),
        ("log_std: 0.3", "std: 1 N/m", "toy.yaml:14:6: parameters.k: a lognormal prior takes median and log_std"),
        ("lognormal", "lognorml", "toy.yaml:14:14: parameters.k.prior: 'lognorml' is not one of normal, logn"),
        ("c: 0.02 N s/m", "c: 1e-6", "toy.yaml:15:6: parameters.c: 1e-06 has no unit; write e.g. '1e-06 N s/m'"),
        ("  c: 0.02", "  q: 0.02", "toy.yaml:15:3: parameters.q: unknown parameter 'q'; known: A, k, c, t_s"),
        ("members: 8", "members: two", "toy.yaml:17:12: assimilation.members: should be a valid integer"),
        ("members: 8", "members: 2", "toy.yaml:17:12: assimilation.members: should be greater than or equal to 3"),
        ("name: toy", "name: ../toy/up", "toy.yaml:1:7: name: "),
        ("name: toy", "name: no", ""),
        ("mass: 2 g", "mass: 2 g\n  mass: 3 g", "toy.yaml:12:3: model: duplicate key 'mass', first given on line 11"),
        ("  k: {prior: lognormal, median: 3 N/m, log_std: 0.3}\n", "", "toy.yaml:12:1: parameters.k: stiffness 'k'"),
    ],
)  # fmt: skip
def test_one_fault_one_place(tmp_path: Path, old: str, new: str, fault: str) -> None:
    if not fault:  # `no` is text
        assert load_config(write_toy(tmp_path, (old, new))).name == "no"
        return
    found = faults(tmp_path, (old, new))
    assert [f[: len(fault)] for f in found] == [fault]


def test_all_faults_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    found = faults(
        tmp_path,
        ("seed: 3", "seed: x"),
        ("unit: um", "unit: s"),
        ("2 um}", "-1 um}"),
        ("0.3}", "0.3, q: 1}"),
        ("c: 0.02 N s/m", "c: 1"),
        ("members: 8", "members: 1"),
    )
    assert [f.split(": ")[0] for f in found] == [
        f"toy.yaml:{place}" for place in ("2:7", "7:34", "8:25", "14:54", "15:6", "17:12")
    ]
    found = faults(tmp_path, (YAML[YAML.index("parameters") :], ""))
    assert [f.split(" ")[1] for f in found] == ["parameters.A:", "parameters.k:"]
    found = faults(tmp_path, ("seed: 3", "seed: x"), ("mass: 2 g", "mas: 2 g"), ("members: 8", "members: 1"))
    assert [f.split(": ")[1] for f in found] == ["seed", "model.mas", "assimilation.members"]


def test_overrides(tmp_path: Path) -> None:
    path = write_toy(tmp_path)
    config = load_config(path, {"assimilation.members": "12", "parameters.c": "1 N s/m", "output.directory": "x"})
    assert config.assimilation.members == 12
    assert config.parameters[2] == Fixed(config.model.parameters[2], 1.0)
    assert config.directory == Path("x")
    assert config.text == YAML
    with pytest.raises(ConfigError, match=r"^--set assimilation\.member: unknown key"):
        load_config(path, {"assimilation.member": "12"})


def test_resolved_file_loads_again(tmp_path: Path) -> None:
    config = load_config(write_toy(tmp_path, ("  c: 0.02 N s/m\n", "")), {"assimilation.members": 12})
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "again.yaml").write_text(config.resolved, encoding="utf-8")
    again = load_config(elsewhere / "again.yaml")
    assert again.resolved == config.resolved
    assert again.assimilation == config.assimilation
    assert [p.value for p in again.parameters if isinstance(p, Fixed)] == [0.0]
    assert again.model.mass == 2e-3  # type: ignore[attr-defined]
    assert "epsilon: 0.001" in config.resolved


class Timed(Section):
    lag: Annotated[float, quantity(time_unit, "not negative")] = 0.0
    limit: Annotated[float, Quantity("s")] = 60.0
    count: int = 3


@pytest.mark.parametrize("section", [{}, {"lag": "2 us"}, {"limit": "1 min"}])
def test_a_default_in_the_units_of_the_model_is_not_written(tmp_path: Path, section) -> None:
    """A file would have to say it with a unit."""
    context = Context(Path(), built=load_config(write_toy(tmp_path)).model)
    written = Timed.model_validate(section, context=context).as_written(section)
    assert written == {**section, "count": 3}
    assert Timed.model_validate(written, context=context) == Timed.model_validate(section, context=context)


def test_a_resolved_choice_of_readings_loads_again(tmp_path: Path) -> None:
    design = "seed: 3\ndesign: {about: [k], times: {from: 0 ms, to: 2 ms, step: 1 ms}, choose: {readings: 2}}\n"
    resolved = load_config(write_toy(tmp_path, ("seed: 3\n", design))).resolved
    (tmp_path / "again.yaml").write_text(resolved, encoding="utf-8")
    assert load_config(tmp_path / "again.yaml").resolved == resolved


def test_a_resolved_file_has_the_folder_that_a_tilde_stands_for(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    resolved = load_config(write_toy(tmp_path), {"data.path": "~/toy.csv"}).resolved
    assert f"path: {tmp_path / 'toy.csv'}\n" in resolved


def test_simulate_grid(tmp_path: Path) -> None:
    grid = "simulate: {times: {from: 1 ms, to: 2 ms, step: 0.1 ms}}\n"
    config = load_config(write_toy(tmp_path, ("seed: 3\n", "seed: 3\n" + grid)))
    assert config.simulate_times is not None
    assert np.allclose(config.simulate_times, np.linspace(1e-3, 2e-3, 11))
    assert faults(tmp_path, ("seed: 3\n", "seed: 3\n" + grid.replace("0.1 ms", "0 ms")))[0].startswith(
        "toy.yaml:3:19: simulate.times: no instants"
    )
