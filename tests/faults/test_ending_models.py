"""Code of a user that ends the program: a lost member or an error of the configuration, with every executor."""

import os
import signal
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from faulty_models import STIFF
from rows import row
from run_files import assert_same_results, configuration, environment, make_campaign, run_cli
from toy_config import write_toy
from worker_calls import exits

from en4dvar.cli import main
from en4dvar.config import load_any, load_config
from en4dvar.executor import ProcessesExecutor, SerialExecutor, ThreadsExecutor
from en4dvar.plumbing.errors import ConfigError, En4dvarError
from en4dvar.plumbing.user_code import EndedError
from en4dvar.report.result import load_result
from en4dvar.runs.interrupt import Interrupted
from en4dvar.runs.runner import run, run_campaign
from en4dvar.runs.simulation import simulate

EXECUTORS = [
    {"executor": "serial"},
    {"executor": "threads", "workers": 2},
    {"executor": "processes", "workers": 2},
    pytest.param({"executor": "dask", "workers": 1}, marks=pytest.mark.slow),
]
IDS = ["serial", "threads", "processes", "dask"]


def ends(executor, fault):
    """The reason why a member is lost that does so; None: the interrupt is one of the program."""
    name = executor["executor"]
    if fault == "ends_its_process":
        return "a worker process died"
    return {
        "exits": "SystemExit: sys.exit(0)",
        "raises_no_exception": "GeneratorExit: enough",
        "interrupts_itself": None if name == "serial" else "KeyboardInterrupt",
    }[fault]


@pytest.fixture(scope="module")
def raising(tmp_path_factory):
    folder = tmp_path_factory.mktemp("raising")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EN4DVAR_TEST_FAULT", "raises")
        return run(configuration(faulty(folder), folder / "run", executor="serial"))


def faulty(folder, model="Faulty"):
    return write_toy(folder, ("toy_models:Oscillator", f"faulty_models:{model}"))


@pytest.mark.parametrize("fault", ["exits", "raises_no_exception", "interrupts_itself"])
@pytest.mark.parametrize("executor", EXECUTORS, ids=IDS)
@pytest.mark.fault("model-exits")
def test_a_member_that_ends_the_program_is_lost(raising, tmp_path, monkeypatch, executor, fault):
    monkeypatch.setenv("EN4DVAR_TEST_FAULT", fault)
    config, reason = configuration(faulty(tmp_path), tmp_path / "run", **executor), ends(executor, fault)
    if reason is None:  # in the main thread nobody can tell it from Ctrl-C
        with pytest.raises(Interrupted):
            run(config)
        return
    check_losses(run(config), raising, reason)


@pytest.mark.slow
@pytest.mark.parametrize("executor", EXECUTORS[2:], ids=IDS[2:])
@pytest.mark.fault("model-os-exit")
def test_a_member_that_ends_its_worker_is_lost(raising, tmp_path, monkeypatch, executor):
    monkeypatch.setenv("EN4DVAR_TEST_FAULT", "ends_its_process")
    check_losses(run(configuration(faulty(tmp_path), tmp_path / "run", **executor)), raising, "a worker process died")


@pytest.mark.parametrize("model", ["ExitsInInitialState", "ExitsInH"])
@pytest.mark.fault("model-exits")
def test_initial_states_and_H(raising, tmp_path, model):
    result = run(configuration(faulty(tmp_path, model), tmp_path / "run", executor="serial"))
    check_losses(result, raising, "SystemExit: sys.exit(0)")


def check_losses(result, raising, reason):
    reasons = result.sample_stats["prior_failure_reason"].values.ravel()
    stiff = result.prior["k"].values.ravel() > STIFF
    assert 0 < stiff.sum() < 4
    assert all(told == reason for told in reasons[stiff]), reasons
    assert not any(reasons[~stiff])
    for key in ("A", "k"):
        assert np.array_equal(result.posterior[key], raising.posterior[key])


@pytest.mark.parametrize(
    "make", [SerialExecutor, lambda: ThreadsExecutor(2), lambda: ProcessesExecutor(1)], ids=IDS[:3]
)
@pytest.mark.fault("model-exits")
def test_a_call_that_exits_has_raised(make):
    with make() as executor:
        found = dict(executor.map(exits, [(0,), (7,)]))
    assert all(isinstance(value, EndedError) for value in found.values())
    assert [str(found[i]) for i in (0, 1)] == ["SystemExit: sys.exit(0)", "SystemExit: sys.exit(7)"]


@pytest.mark.slow
@pytest.mark.fault("model-os-exit-here")
def test_the_end_of_the_process_of_the_run(tmp_path, monkeypatch):
    """Nothing can catch it, and its exit code is the model's; what was done is kept."""
    path, out = make_campaign(tmp_path, 3, "execution_models:EndsAt"), tmp_path / "run"
    choice = ("--set", "execution.executor=serial", "--set", "execution.checkpoint_every=0", "--no-report")
    ended = run_cli("run", path, "--out", out, *choice, EN4DVAR_TEST_CALL=20)
    assert (ended.returncode, ended.stdout) == (0, "")
    assert not (out / "posterior.nc").exists()
    assert not (out / "run.log").read_text().endswith("done\n")
    monkeypatch.setenv("EN4DVAR_TEST_CALL", "-1")
    run_campaign(configuration(path, out, executor="serial"), resume=True)
    run_campaign(configuration(path, tmp_path / "quiet", executor="serial"))
    assert_same_results(out, tmp_path / "quiet")


PLACES = {
    "import": "import sys\nsys.exit(0)\n",
    "import, raises": "raise RuntimeError('sys.exit(0)')\n",
    "__init__": "import sys\nfrom toy_models import Oscillator\nclass Model(Oscillator):\n"
    "    def __init__(self, settings):\n        sys.exit(0)\n",
    "settings": "import sys\nfrom pydantic import BaseModel, model_validator\nfrom toy_models import Oscillator\n"
    "class Model(Oscillator):\n    class Settings(BaseModel):\n        mass: str\n"
    "        @model_validator(mode='after')\n        def check(self):\n            sys.exit(0)\n",
    "observables": "import sys\nfrom toy_models import Oscillator\nclass Model(Oscillator):\n"
    "    @property\n    def observables(self):\n        sys.exit(0)\n",
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.fault("load-exits")
def test_a_model_that_ends_the_program_as_it_is_loaded(tmp_path, monkeypatch, place):
    file = tmp_path / f"model_{abs(hash(place))}.py"
    file.write_text(PLACES[place])
    monkeypatch.syspath_prepend(tmp_path)
    path = write_toy(tmp_path, ("toy_models:Oscillator", f"{file.stem}:Model"))
    with pytest.raises(ConfigError) as told:
        load_any(path)
    (fault,) = told.value.problems
    assert fault.path.startswith("model")
    assert fault.line > 0
    assert "sys.exit(0)" in fault.message
    assert f"({file}:{PLACES[place].count(chr(10))})" in fault.message


@pytest.mark.parametrize("command", ["run", "validate", "simulate"])
@pytest.mark.fault("load-exits")
@pytest.mark.slow
def test_every_command_says_so(tmp_path, command):
    (tmp_path / "ends.py").write_text(PLACES["import"])
    path = write_toy(tmp_path, ("toy_models:Oscillator", "ends:Model"))
    done = run_cli(command, path, PYTHONPATH=os.pathsep.join([str(tmp_path), environment()["PYTHONPATH"]]))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(
        f"{path}:10:9: model.name: model 'ends:Model' cannot be loaded: SystemExit: sys.exit(0)"
    )
    assert row("load-exits").told(done.stderr)


@pytest.mark.fault("model-shared")
def test_what_a_model_changes_in_the_process(raising, tmp_path, monkeypatch):
    """As it is made, and as it runs; the numbers are those of a model that leaves everything alone."""
    monkeypatch.delenv("EN4DVAR_TEST_DISTURBED", raising=False)
    before = shared()
    config = configuration(faulty(tmp_path, "Disturbs"), tmp_path / "run", executor="serial")
    assert shared() == before
    result = run(config)
    assert os.environ["EN4DVAR_TEST_DISTURBED"] == "1"
    assert shared() == before
    (tmp_path / "quiet").mkdir()
    quiet = run(configuration(write_toy(tmp_path / "quiet"), tmp_path / "quiet" / "run", executor="serial"))
    for key in ("A", "k"):
        assert np.array_equal(result.posterior[key], quiet.posterior[key])


def shared():
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    return os.getcwd(), np.geterr(), sum(f[0] == "error" for f in warnings.filters), handlers


SINGLE = {
    "ExitsInH": "position cannot be read from the run",
    "ExitsInInitialState": "the model refuses its parameters",
}


@pytest.mark.parametrize("model", SINGLE)
@pytest.mark.fault("model-exits")
def test_a_single_run_that_ends_the_program(tmp_path, model):
    config = load_config(faulty(tmp_path, model), {"parameters.k": "5 N/m"})
    with pytest.raises(En4dvarError, match=rf"{SINGLE[model]}: SystemExit: sys.exit\(0\)"):
        simulate(config, np.array([0.0, 0.01]))


@pytest.mark.fault("model-exits")
def test_whatever_else_ends_the_program(tmp_path, monkeypatch):
    """A part of a model that nobody thought of."""
    monkeypatch.setattr("en4dvar.runs.simulation.run_chunk", lambda *_: sys.exit(0))
    done = CliRunner().invoke(main, ["simulate", str(write_toy(tmp_path))])
    assert (done.exit_code, done.stdout) == (1, "")
    assert done.stderr == "the code of a model ended the program: SystemExit: sys.exit(0)\n"


@pytest.mark.parametrize("whose", ["system", "another", "python"])
@pytest.mark.fault("output-closed")
@pytest.mark.slow
def test_a_model_that_closes_standard_output(tmp_path, whose):
    path = faulty(tmp_path, "Closes")
    modules = os.pathsep.join([str(Path(__file__).parent), environment()["PYTHONPATH"]])
    choice = ("--set", "execution.executor=serial", "--no-report")
    done = run_cli("run", path, "--out", tmp_path / "run", *choice, PYTHONPATH=modules, EN4DVAR_TEST_FAULT=whose)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "standard output was closed, by a model perhaps; what was computed is kept\n"
    assert load_result(tmp_path / "run" / "posterior.nc").posterior["k"].size == 8


LAW = """\
import sys
from en4dvar import Parameter
from en4dvar_bubble import ConstitutiveLaw

class Law(ConstitutiveLaw):
    title = "As none"
    parameters = (Parameter("G", "Pa", bounds=(0.0, float("inf"))),)
    def strain_energy_rate(self, stretch, p):
        return p.G * stretch
"""
LAWS = {
    "as it is loaded": "sys.exit(0)\n",
    "as it is made": "    def __init__(self):\n        sys.exit(0)\n",
    "as it is called": "    def strain_energy_rate(self, stretch, p):\n        sys.exit(0)\n",
}


@pytest.mark.parametrize("when", LAWS)
@pytest.mark.fault("load-exits")
def test_a_law_that_ends_the_program(tmp_path, when):
    law = tmp_path / "law.py"
    law.write_text(LAW + LAWS[when])
    for words in (["laws", f"{law}:Law"], ["laws", "--check", f"{law}:Law"]):
        done = CliRunner().invoke(main, words)
        assert (done.exit_code, done.stdout) == (2, "")
        assert "SystemExit: sys.exit(0)" in done.stderr
        assert str(law) in done.stderr
