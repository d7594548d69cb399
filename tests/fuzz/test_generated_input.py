"""Bad input by generation. The long campaign, guided by coverage, is ``python benchmarks/fuzz.py``."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import fuzz_mutations as mutations
import fuzz_seeds as seeds
import pytest
import yaml
from click.testing import CliRunner
from fuzz_targets import TARGETS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from en4dvar.cli import main
from en4dvar.config.document import read_document
from en4dvar.config.kinds import resolve_campaign
from en4dvar.plumbing.errors import ConfigError

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same, in a fraction of the time of every collection
CONFIGS = [yaml.load(content, LOADER) for content in seeds.of("configuration")]
FEW = settings(deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the data that the shipped configurations name."""
    here = tmp_path_factory.mktemp("fuzz")
    for name in ("data", "programs"):
        (here / name).symlink_to(seeds.CONFIGS / name)
    return here


@pytest.mark.parametrize("target", [t for t in TARGETS if t != "result"])
def test_seeds_are_accepted(folder, target):
    accepted = [TARGETS[target](content, folder) for content in seeds.of(target)]
    if target == "configuration":  # seven of them name measurements that are not shipped, or not yet made
        assert sum(accepted) >= len(accepted) - 7
    else:
        assert accepted
        assert all(accepted)


@pytest.mark.slow
@given(st.data())
@settings(FEW, max_examples=250)
def test_configurations_of_the_right_shape(folder, data):
    document = data.draw(mutations.mutated(data.draw(st.sampled_from(CONFIGS))))
    text = yaml.safe_dump(document, allow_unicode=True, sort_keys=False)
    TARGETS["configuration"](text.encode("utf-8", "surrogatepass"), folder)


def _written(document):
    """As ``yaml.safe_dump`` does; by the C library where that gives the same (ASCII), in a fraction of the time."""
    text = yaml.dump(document, Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper), sort_keys=False)
    return text if "\\" not in text else yaml.safe_dump(document, allow_unicode=True, sort_keys=False)


def _one_place(folder, places):
    """Told where it is wrong, with every warning of numpy an error."""
    (folder / "toy.csv").write_bytes(seeds.SERIES)
    for path, document in places:
        text = _written(document)
        try:
            TARGETS["configuration"](text.encode("utf-8", "surrogatepass"), folder)
        except Exception as error:
            raise AssertionError(f"{'.'.join(map(str, path))}: {text[:2000]}") from error


@pytest.mark.parametrize(
    "step", [97, pytest.param(5, marks=pytest.mark.slow), pytest.param(1, marks=[pytest.mark.slow, pytest.mark.long])]
)
def test_odd_values_in_every_place(folder, step):
    """Every ``step``-th: prime to the numbers of values, so that every place and every value has its turn."""
    _one_place(folder, itertools.islice(mutations.one_changed(yaml.safe_load(seeds.FULL)), 0, None, step))


@pytest.mark.slow
@given(st.binary(max_size=200) | st.text(max_size=200).map(lambda s: s.encode("utf-8", "surrogatepass")))
@settings(FEW, max_examples=150)
@pytest.mark.parametrize("target", sorted(TARGETS))
def test_any_bytes(folder, target, content):
    TARGETS[target](content, folder)


@pytest.mark.slow
@given(st.data())
@settings(FEW, max_examples=150)
@pytest.mark.parametrize("target", ["csv", "covariance", "mat", "mat 7.3", "workbook", "quantity"])
def test_data_files_with_a_part_replaced(folder, target, data):
    content = data.draw(st.sampled_from(list(seeds.of(target))))
    first, last = sorted(data.draw(st.tuples(*[st.integers(0, len(content))] * 2)))
    TARGETS[target](content[:first] + data.draw(st.binary(max_size=20)) + content[last:], folder)


HOSTILE = {
    "deep": "[" * 20_000,
    "deep mapping": "a: " + "{b: " * 20_000,
    "billion laughs": "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n",
    "object": "name: !!python/object/apply:os.system ['touch HACKED']\n",
    "merge": "base: &b {name: x}\n<<: *b\n",
    "two documents": "name: a\n---\nname: b\n",
    "huge integer": f"name: x\nseed: {'9' * 5000}\n",
    "utf-16": "name: x\n".encode("utf-16"),
    "nul": b"name: \x00\n",
    "only a number": "1",
    "tabs": "name:\n\t- x\n",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_yaml_is_refused_with_a_place(tmp_path, name, monkeypatch):
    monkeypatch.chdir(tmp_path)
    content = HOSTILE[name]
    Path("case.yaml").write_bytes(content if isinstance(content, bytes) else content.encode())
    done = CliRunner().invoke(main, ["validate", "case.yaml"])
    assert done.exit_code == 2
    assert "Traceback" not in done.output
    assert re.search(r"^(Error: )?case\.yaml", done.output, re.MULTILINE), done.output
    assert not Path("HACKED").exists()


def test_only_the_named_plug_in_is_executed(tmp_path, monkeypatch):
    """A configuration is data: beside the file of the law nothing in the folder runs, and the law runs where named."""
    monkeypatch.chdir(tmp_path)
    for name in ("conftest.py", "sitecustomize.py", "numpy.py", "__init__.py", "other.py"):
        Path(name).write_text("from pathlib import Path\nPath(__file__ + '.ran').touch()\n", encoding="utf-8")
    Path("mine.py").write_text(
        "from pathlib import Path\nPath(__file__ + '.ran').touch()\n"
        "from en4dvar_bubble.laws import NeoHookeanKelvinVoigt\n"
        "class Mine(NeoHookeanKelvinVoigt):\n    name = 'mine'\n",
        encoding="utf-8",
    )
    case = yaml.safe_load((seeds.CONFIGS / "quickstart.yaml").read_bytes())
    case["data"]["path"] = str(seeds.CONFIGS / case["data"]["path"])
    case["model"]["law"] = "./mine.py:Mine"
    del case["parameters"]["alpha"]
    Path("case.yaml").write_text(yaml.safe_dump(case), encoding="utf-8")
    done = CliRunner().invoke(main, ["validate", "case.yaml"])
    assert done.exit_code == 0, done.output
    assert [p.name for p in Path().glob("*.ran")] == ["mine.py.ran"]


@pytest.mark.parametrize("name", ["..", ".", "../x", "/tmp/x", "a/b", "a\\b", ".hidden", ""])
def test_a_run_is_written_below_the_folder_of_runs(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    text = (
        (seeds.CONFIGS / "quickstart.yaml").read_text(encoding="utf-8").replace("name: quickstart", f"name: {name!r}")
    )
    Path("case.yaml").write_text(text, encoding="utf-8")
    done = CliRunner().invoke(main, ["validate", "case.yaml"])
    assert done.exit_code == 2
    assert "case.yaml:4:7: name:" in done.output


@pytest.mark.parametrize("directory", ["..", "../elsewhere", "/tmp/elsewhere", "data/../../x", "."])
def test_a_synthetic_campaign_is_written_below_its_configuration(tmp_path, directory):
    text = (seeds.CONFIGS / "agarose_twin.yaml").read_text(encoding="utf-8")
    assert "  directory: data/agarose_twin" in text
    path = tmp_path / "case.yaml"
    path.write_text(text.replace("  directory: data/agarose_twin", f"  directory: {directory}"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"campaign\.directory: must be a folder below"):
        resolve_campaign(read_document(path), tmp_path)
