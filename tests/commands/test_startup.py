"""Start-up: help and the package itself import nothing heavy; the public names are all there."""

import inspect
import re
import subprocess
import sys
import types
from importlib import import_module
from pathlib import Path

from pydantic import BaseModel
from run_files import environment
from toy_config import write_toy

import en4dvar
from en4dvar.cli import main
from en4dvar.config.schema import Output
from en4dvar.plumbing.described import Described

HEAVY = ("numba", "scipy", "xarray", "matplotlib", "pydantic", "numpy", "yaml", "rich")


def loaded(code: str) -> set[str]:
    """Packages and modules that a fresh interpreter holds after ``code``."""
    script = code + "\nimport sys; print('\\n'.join({n for m in sys.modules for n in (m, m.partition('.')[0])}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment())
    return set(done.stdout.split())


def test_cli_and_package_import_nothing_heavy() -> None:
    assert not loaded("import en4dvar, en4dvar.cli").intersection(HEAVY)
    assert "numpy" in loaded("import en4dvar; en4dvar.Parameter")  # the check can fail


def test_stopped_while_it_is_imported_the_program_ends_as_it_does_later() -> None:
    script = """
import sys
class Stop:
    def find_spec(self, name, *_):
        if name == "en4dvar.commands":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Stop())
from en4dvar.cli import main"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment())
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "interrupted\n")


def test_units_and_errors_need_no_pydantic() -> None:
    assert not loaded("import en4dvar.plumbing.units, en4dvar.plumbing.errors").intersection(
        {"pydantic", "numba", "scipy"}
    )


def test_a_run_imports_nothing_that_takes_long(tmp_path: Path) -> None:
    """A second of every start, and of every worker's; its page is drawn and its files are read without, too."""
    slow = {"matplotlib", "xarray", "pandas", "dask", "scipy.fft", "scipy.spatial"}
    words = ["run", str(write_toy(tmp_path)), "--out", str(tmp_path / "run")]
    first, then = (f"main({words + more}, standalone_mode=False)" for more in (["--no-report"], ["--force"]))
    beside = tmp_path / "first.txt"
    page = loaded(f"""
import sys
from pathlib import Path
from en4dvar.cli import main
{first}
Path({str(beside)!r}).write_text(" ".join({{name for m in sys.modules for name in (m, m.partition(".")[0])}}))
{then}""")
    without = set(beside.read_text().split())
    assert "scipy" in without
    assert not without.intersection({*slow, "jinja2"})
    assert "jinja2" in page
    assert not page.intersection(slow)


def test_no_section_reads_its_file_as_it_is_declared() -> None:
    """Pydantic would, for the descriptions of keys, of each section: 0.2 s of every start."""
    import_module("en4dvar.config")
    import_module("en4dvar_bubble.model")

    def below(kind: type[BaseModel]) -> set[type[BaseModel]]:
        return {kind}.union(*map(below, kind.__subclasses__()))

    sections = below(Described)
    assert len(sections) > 50
    assert [kind for kind in sections if kind.model_config.get("use_attribute_docstrings")] == []
    assert Output.model_json_schema()["properties"]["report"]["description"] == "Write report.html."


def test_public_names() -> None:
    names = [n for n in dir(en4dvar) if not n.startswith("__")]
    assert {"run", "load_config", "load_result", "Parameter", "ForwardModel"} <= set(names)
    import_module("en4dvar.runs.runner")  # a submodule must not take the place of a public name
    import_module("en4dvar.runs.simulation")
    for name in names:
        value = getattr(en4dvar, name)
        assert not isinstance(value, types.ModuleType)
        assert value.__module__.startswith("en4dvar.")
    assert re.match(r"\d+\.\d+\.\d+", en4dvar.__version__)


def test_every_command_has_help_with_an_example() -> None:
    for name, command in main.commands.items():
        assert "Example:\n" in inspect.cleandoc(command.help or ""), name
        assert f"en4dvar {name} " in (command.help or "")
