"""Turkish, where the capital of i is İ, and German, where a comma is the decimal sign."""

import shutil
import subprocess

import pytest
from run_files import TESTS, assert_same_results, configuration, make_campaign, run_cli

from en4dvar.runs.runner import run_campaign

SET_AT_START = """\
import locale, pathlib
locale.setlocale(locale.LC_ALL, "")  # as a model or a plug-in may do: from here on C code sees the user's locale
pathlib.Path(__file__).with_name("numbers").write_text(locale.str(1.5))
"""


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A configuration and its run where nobody has set a locale."""
    folder = tmp_path_factory.mktemp("plain")
    path = make_campaign(folder, 2)
    run_campaign(configuration(path, folder / "run"))
    return path, folder / "run"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "number"), [("tr_TR", "1,5"), pytest.param("de_DE", "1,5", marks=pytest.mark.long)])
@pytest.mark.fault("locale")
def test_a_run_in_another_locale(plain, tmp_path, name, number):
    localedef = shutil.which("localedef")
    made = localedef and subprocess.run([localedef, "-i", name, "-f", "UTF-8", tmp_path / f"{name}.UTF-8"], check=False)
    if not (tmp_path / f"{name}.UTF-8").exists():
        pytest.skip(f"the locale {name} cannot be made here ({made})")
    (tmp_path / "sitecustomize.py").write_text(SET_AT_START)
    path, undisturbed = plain
    there = {"LC_ALL": f"{name}.UTF-8", "LOCPATH": tmp_path}
    done = run_cli("run", path, "--out", tmp_path / "run", "--no-report", **there, PYTHONPATH=f"{tmp_path}:{TESTS}")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "numbers").read_text() == number
    assert_same_results(tmp_path / "run", undisturbed)
    assert (tmp_path / "run" / "summary.csv").read_bytes() == (undisturbed / "summary.csv").read_bytes()
    drawn = run_cli("report", tmp_path / "run", **there, PYTHONPATH=f"{tmp_path}:{TESTS}")
    assert drawn.returncode == 0, drawn.stderr
    assert (tmp_path / "run" / "report.html").exists()
