"""``assimilation.localisation`` and fields of ``initial_state`` in a file: what they come to, and what can be wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from field_models import write_line

from en4dvar.assembly.build import build
from en4dvar.commands.describe import problem_summary
from en4dvar.config import load_config
from en4dvar.descent.preview import preview
from en4dvar.plumbing.errors import ConfigError
from en4dvar.report.result import load_result
from en4dvar.runs.checks import validate
from en4dvar.runs.runner import run, run_campaign


def test_units_are_those_of_the_coordinates(tmp_path: Path) -> None:
    config = load_config(write_line(tmp_path))
    (problem,) = build(config)
    (field,) = problem.fields
    assert (field.std, field.kernel, field.length, field.relative) == (1.0, "gaussian", 1.5, False)
    assert config.assimilation.localisation is not None
    assert config.assimilation.localisation.radius == 3.0
    assert "30 cells" in problem_summary(config, [problem])
    seen = preview(problem, config.assimilation, 1)
    assert seen.run.predictions.shape == (12, 6)
    assert seen.runs > 2 * 12


def test_the_resolved_file_says_the_same(tmp_path: Path) -> None:
    config = load_config(write_line(tmp_path, ("radius: 300 cm", "radius: 300 cm, at: {offset: 50 cm}"),
                                    ("offset: 0", "offset: {prior: normal, mean: 0, std: 1}")))  # fmt: skip
    (tmp_path / "again.yaml").write_text(config.resolved, encoding="utf-8")
    again = load_config(tmp_path / "again.yaml")
    assert again.assimilation == config.assimilation
    assert again.assimilation.localisation is not None
    assert again.assimilation.localisation.at == {"offset": (0.5,)}
    assert again.initial_state == config.initial_state
    written = yaml.safe_load(config.resolved)
    assert written["initial_state"]["u"] == {"std": "1 K", "kernel": "gaussian", "length": "150 cm"}


@pytest.mark.parametrize("scheme", ["en4dvar", "es-mda"])
def test_a_run_shows_a_field_as_a_field(tmp_path: Path, scheme: str) -> None:
    result = run(
        write_line(tmp_path),
        overrides={"assimilation.scheme": scheme, "output.directory": str(tmp_path / "run")},
    )
    again = load_result(tmp_path / "run" / "posterior.nc")
    fields = again.dataset("fields")
    assert fields["u"].dims == ("draw", "u_cell")
    members = fields["u"].values.astype(float)
    assert fields["u_mean"].values == pytest.approx(members.mean(axis=0), rel=1e-6)
    assert fields["u_std"].values == pytest.approx(members.std(axis=0, ddof=1), rel=1e-5)
    assert fields["u_at"].values[:, 0] == pytest.approx(0.5 * np.arange(30))
    assert np.all(fields["u_std"].values < 1.05 * fields["u_prior_std"].values)
    assert not result.posterior.data_vars
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert 'id="d0-fields"' in page
    assert 'id="d0-posterior"' not in page
    assert "of 0 estimated" not in page


@pytest.mark.slow
def test_a_campaign_of_fields(tmp_path: Path) -> None:
    path = write_line(tmp_path, ("path: line.csv", "path: [line.csv, other.csv]"))
    (tmp_path / "other.csv").write_text((tmp_path / "line.csv").read_text(encoding="utf-8"), encoding="utf-8")
    campaign = run_campaign(path, overrides={"output.directory": str(tmp_path / "run")})
    assert [result.name for result in campaign] == ["line", "other"]
    first, second = (result.dataset("fields")["u_mean"].values for result in campaign)
    assert np.max(np.abs(first - second)) > 0  # streams of their own
    assert (tmp_path / "run" / "posterior.nc").exists()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("radius: 300 cm", "radius: 0 m", "line.yaml:16:26: assimilation.localisation.radius: must be positive"),
        ("radius: 300 cm", "radius: 3 s", "line.yaml:16:26: assimilation.localisation.radius:"),
        ("radius: 300 cm", "by: distance", "assimilation.localisation.radius: required: how far a reading acts"),
        ("radius: 300 cm", "by: chance", "localisation.by: 'chance' is not one of distance, correlation"),
        ("radius: 300 cm", "radius: 3 m, threshold: 0.2", "assimilation.localisation.threshold: not with by: distance"),
        ("radius: 300 cm", "by: correlation, radius: 1 m", "localisation.radius: not with by: correlation"),
        ("radius: 300 cm", "by: correlation, threshold: 2", "assimilation.localisation.threshold: "),
        ("radius: 300 cm", "by: correlation", "assimilation.localisation: by correlation there is no cost"),
        ("radius: 300 cm", "radius: 3 m, at: {k: 1 m}", "localisation: at: 'k' is not a parameter with a prior"),
        ("radius: 300 cm", "radius: 3 m, at: {u: [1 m, 2 m]}", "localisation: u has 1 coordinates, the readings"),
        ("radius: 300 cm", "radius: 3 m, at: {offset: 1 s}", "assimilation.localisation: "),
        ("  localisation: {radius: 300 cm}\n", "", "assimilation.members: 12 are too few for 18 parameters, 18 of"),
        ("members: 12", "scheme: etkf", "assimilation.localisation: a scheme for data that can be localised is"),
        ("members: 12", "scheme: [etkf]", "line.yaml:15:11: assimilation.scheme: "),
        ("{u_std: 0.3 K}", "{u_std: 0.3 K, robust: huber}", "assimilation.localisation: takes independent Gaussian"),
        (", length: 150 cm", "", "initial_state.u.kernel: kernel and length go together; give length as well"),
        ("kernel: gaussian, ", "", "initial_state.u.length: kernel and length go together; give kernel as well"),
        ("length: 150 cm", "length: 0 m", "initial_state.u.length: must be positive, not 0"),
        ("kernel: gaussian", "kernel: cubic", "initial_state.u.kernel: 'cubic' is not one of exponential, matern-3/2"),
        (", kernel: gaussian, length: 150 cm", ", modes: 3", "initial_state.u.modes: modes are those of a kernel"),
        ("length: 150 cm", "length: 150 cm, modes: 0", "initial_state.u.modes: "),
    ],
)  # fmt: skip
def test_one_located_message(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write_line(tmp_path, (old, new))
    with pytest.raises(ConfigError) as error:
        validate(path)
    assert len(error.value.problems) == 1, str(error.value)
    assert message in str(error.value)
    assert f"{path.name}:" in str(error.value)
