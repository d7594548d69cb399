"""The pages "Your own constitutive law" and of coatings do what they say: their files are written, checked and run."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from en4dvar.cli import main
from en4dvar_bubble import REGISTRY, simulate

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "own_constitutive_law.md").read_text(encoding="utf-8")
FILES, COATINGS = (
    dict(re.findall(r"```(?:python|yaml)\n# ([\w.]+)[^\n]*\n(.*?)```", page, re.S))
    for page in (PAGE, (DOCS / "shells.md").read_text(encoding="utf-8"))
)
LAWS = ["yeoh.py:Yeoh", "shear_thinning_gel.py:ShearThinningGel", "relaxing_gel.py:RelaxingGel"]
LAWS += ["stiffening.py:Stiffening"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    for name, text in (FILES | COATINGS).items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_example_is_short():
    assert len(FILES["yeoh.py"].splitlines()) < 35
    assert len(FILES) == 5


def test_check_prints_what_the_page_shows():
    (command, shown) = re.search(r"```console\n\$ en4dvar (.*?)\n(.*?)```", PAGE, re.S).groups()
    done = CliRunner().invoke(main, command.split())
    assert done.exit_code == 0
    assert done.output == shown


@pytest.mark.parametrize("law", LAWS)
def test_every_law_of_the_page_passes_the_battery(law):
    done = CliRunner().invoke(main, ["laws", "--check", law])
    assert done.exit_code == 0, done.output


def test_the_simulation_of_the_page(capsys):
    bubbles = runpy.run_path("simulate.py")["bubbles"]
    assert np.all(bubbles.status == 0)
    printed = [float(x) for x in capsys.readouterr().out.strip(" []\n").split()]
    assert printed[0] > printed[1] > printed[2] > 5
    same = simulate("neo-hookean-kelvin-voigt", {"G": 500.0, "mu": 0.1, "R0": 0.5e-6}, bubbles.time.values)
    np.testing.assert_allclose(bubbles.R[0], same.R[0], rtol=1e-5)


def test_the_coatings_of_the_page():
    """Three coatings of one tension at rest; the lipid contracts more than it expands, as the caption says."""
    made = runpy.run_path("coatings.py")
    rest = np.flatnonzero(np.isclose(made["stretch"], 1.0))
    for name in made["laws"]:
        np.testing.assert_allclose(made["tensions"][name][rest], 12e-3, rtol=1e-6)
    radius = made["radii"]["marmottant-shell"] / 2.1e-6
    assert 1 - radius.min() > radius.max() - 1 > 0.1


def test_the_yaml_of_the_page(folder):
    """Completed by the data of the quick start, it validates, and names the parameters of the class."""
    root = Path(__file__).parents[2]
    config = yaml.safe_load((root / "configs" / "quickstart.yaml").read_text())
    config["data"]["path"] = str(root / "configs" / config["data"]["path"])
    config["parameters"] = {k: v for k, v in config["parameters"].items() if k in ("mu", "R0", "t_s")}
    case = yaml.safe_load(FILES["case.yaml"])
    config["model"] |= case["model"]
    config["parameters"] |= case["parameters"]
    (folder / "case.yaml").write_text(yaml.safe_dump(config))
    done = CliRunner().invoke(main, ["validate", "case.yaml"])
    assert done.exit_code == 0, done.output
    assert "beta" in done.output


def test_the_table_of_laws_is_complete():
    section = (DOCS / "laws.md").read_text(encoding="utf-8")
    stems = re.findall(r"`([a-z-]+)`", section)
    named = {*stems, *(s + "kelvin-voigt" for s in stems if s.endswith("-"))}
    assert set(REGISTRY) <= named
