"""Programs as forward models: the bits of the same model in this process, and what becomes of one that goes wrong."""

from __future__ import annotations

import math
import os
import re
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import en4dvar
from en4dvar.executor import ProcessesExecutor, ThreadsExecutor
from en4dvar.model.forward import Failure
from en4dvar.model.programs.model import CommandModel, CommandSettings
from en4dvar.plumbing.user_code import RefusedError
from en4dvar.runs.rerun import rerun

CURVE = Path(__file__).with_name("curve.py")
TIMES = np.linspace(0.0, 3.0, 12)
VALUES = 1.0 + 0.5 * np.cos(TIMES + 1 / 3) + 0.1 * np.random.default_rng(4).standard_normal(12)
PRIORS = {"a": {"prior": "normal", "mean": 0, "std": 2}, "b": {"prior": "normal", "mean": 0, "std": 1}}
OUTPUTS: dict[str, dict[str, Any]] = {
    "column": {"column": "y", "time": "t"},
    "number of a column": {"column": 2},
    "key": {"file": "out.json", "key": "run.y", "time": "run.t"},
    "pattern": {"file": "stdout", "pattern": r"y = (\S+)"},
}


def curve(parameters: dict[str, float], times: Any) -> Any:
    return [parameters["a"] + parameters["b"] * math.cos(t + 1 / 3) for t in times]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "in.json.j2").write_text('{"a": {{ a }}, "b": {{ b }}, "times": {{ times }}}\n')
    return tmp_path


def section(what: str = "well", **more: Any) -> dict[str, Any]:
    return {
        "command": f"{sys.executable} -S {CURVE} {what} {{input}} {{output}}",
        "templates": "in.json.j2",
        "parameters": {"a": "1", "b": "1"},
        "outputs": {"y": OUTPUTS["column"]},
        "time_unit": "1",
        **more,
    }


def model_of(folder: Path, what: str = "well", **more: Any) -> CommandModel:
    return CommandModel(CommandSettings.model_validate(section(what, **more), context={"base": folder}))


def failure(folder: Path, what: str = "well", **more: Any) -> str:
    (lost,) = model_of(folder, what, **more).trajectories(np.array([[1.0, 0.5]]), TIMES)
    assert isinstance(lost, Failure)
    return lost.reason


def fit(model: Any, **more: Any) -> en4dvar.Result:
    settings = {"members": 6, "emulator": "off"}
    return en4dvar.estimate(model, (TIMES, VALUES), PRIORS, error=0.1, progress=False, assimilation=settings, **more)


@pytest.mark.parametrize("way", OUTPUTS)
def test_every_way_of_reading_has_the_bits_of_the_function(way, folder):
    states = np.array([[1.0, 0.5], [-1 / 3, 1e-7]])
    model = model_of(folder, outputs={"y": OUTPUTS[way]})
    for path, (a, b) in zip(model.trajectories(states, TIMES), states, strict=True):
        np.testing.assert_array_equal(path["y"], curve({"a": a, "b": b}, TIMES.tolist()))


def test_only_what_has_times_of_its_own_is_interpolated(folder):
    timed = {"y": {"column": "y", "time": "t"}, "z": {"column": "y"}}
    assert model_of(folder, outputs=timed).interpolated == {"y"}


def test_a_posterior_has_the_bits_of_the_function(folder, monkeypatch):
    monkeypatch.chdir(folder)
    assert fit(section()).posterior.identical(fit(curve).posterior)


@pytest.mark.slow
@pytest.mark.parametrize("executor", [ThreadsExecutor, ProcessesExecutor])
def test_workers_give_the_same_bits(executor, folder):
    model, states = model_of(folder), np.array([[1.0, 0.5], [0.2, 0.1], [0.3, -1.0]])
    with executor(2) as pool:
        parallel = pool.trajectories(model, states, TIMES)
    for one, other in zip(parallel, model.trajectories(states, TIMES), strict=True):
        np.testing.assert_array_equal(one["y"], other["y"])


def test_parameters_may_be_arguments_and_the_program_a_shell_line(folder):
    outputs = {"y": {"file": "stdout", "column": 1}}
    plain = {"parameters": {"a": "1", "b": "1"}, "outputs": outputs, "time_unit": "1"}
    for more in ({"command": "printf '%s\\n' {a} {b} {a}"}, {"command": "echo {a}; echo {b}; echo {a}", "shell": True}):
        model = CommandModel(CommandSettings.model_validate({**plain, **more}, context={"base": folder}))
        (path,) = model.trajectories(np.array([[0.1, 1 / 3]]), TIMES[:3])
        assert path["y"].tolist() == [0.1, 1 / 3, 0.1]


def test_no_shell_unless_asked_for(folder):
    model = model_of(
        folder,
        command="echo {a} ';' touch nowhere",
        templates=(),
        outputs={"y": {"file": "stdout", "pattern": r"(\S+)$"}},
    )
    (lost,) = model.trajectories(np.array([[0.1, 0.2]]), TIMES[:1])
    assert lost.reason.endswith("'nowhere' is no number")


def test_a_program_that_goes_wrong_is_a_lost_member_with_its_reason(folder):
    assert failure(folder, "fails") == "ProgramError: the program ended with exit status 1: no convergence"
    assert re.search(r"ended by signal SIGABRT.*retries: 2 runs it again", failure(folder, "crashes"))
    assert "retries" not in failure(folder, "crashes", retries=1)
    assert failure(folder, "nothing") == "ProgramError: no output file output: no such file; the folder holds stdout"
    assert failure(folder, "garbage") == "ProgramError: output: 'n/a' is no number"
    assert "output: 11 values for 12 times; name the column of times" in failure(
        folder, "short", outputs={"y": {"column": "y"}}
    )
    twice = {"y": {"file": "stdout", "pattern": r"(\S+)"}}
    assert "times; the pattern is to match once for each value" in failure(folder, outputs=twice)
    assert "output: times must increase, but the one of value 13 does not: nan follows 3" in failure(folder, "footer")
    assert "'1,5' is no number; let the program write decimal points" in failure(folder, "comma")
    assert "times from 0 to 2.72727, but 0 to 3 are needed" in failure(folder, "short")
    assert "no column 'z'; the columns are: t, y" in failure(folder, outputs={"y": {"column": "z"}})
    missing = {"y": {"file": "out.json", "key": "run.z"}}
    assert "out.json: no key 'run.z', for there is no 'z'" in failure(folder, outputs=missing)
    assert "not JSON" in failure(folder, outputs={"y": {"key": "run"}})


@pytest.mark.parametrize(
    ("what", "way"), [*(("fortran", way) for way in OUTPUTS), ("bare", "number of a column"), ("marked", "column")]
)
def test_exponents_may_be_those_of_fortran(what, way, folder):
    """1.03D+00; a table may have no header, and begin with a mark of byte order."""
    (path,) = model_of(folder, what, outputs={"y": OUTPUTS[way]}).trajectories(np.array([[1.0, 0.5]]), TIMES)
    np.testing.assert_array_equal(path["y"], curve({"a": 1.0, "b": 0.5}, TIMES.tolist()))


@pytest.mark.parametrize("way", OUTPUTS)
def test_a_value_that_is_missing_is_lost_alone(way, folder):
    model = model_of(folder, "gaps", outputs={"y": OUTPUTS[way]})
    (path,) = model.trajectories(np.array([[1.0, 0.5]]), TIMES)
    expected = np.where(np.arange(12) == 4, np.nan, curve({"a": 1.0, "b": 0.5}, TIMES.tolist()))
    np.testing.assert_array_equal(path["y"], expected)


def test_a_first_line_that_lacks_a_value_is_no_line_of_names(folder):
    outputs = {"y": {"file": "stdout", "column": 2}}
    words = {"command": "printf '%s\\n' '1 ******' '2 {a}'", "templates": (), "outputs": outputs}
    (path,) = model_of(folder, **words).trajectories(np.array([[0.5, 1.0]]), TIMES[:2])
    np.testing.assert_array_equal(path["y"], [np.nan, 0.5])


@pytest.mark.slow
def test_members_that_lack_a_value_leave_a_linear_posterior_as_it_is(folder, monkeypatch):
    """Some quarter of them, at random; the reading is regressed on the others."""
    monkeypatch.chdir(folder)
    whole, gaps = (fit(section(what), directory=what, report=False) for what in ("well", "gaps"))
    for name in "ab":
        np.testing.assert_allclose(gaps.posterior[name], whole.posterior[name], atol=1e-6)
    assert "readings-missing" in [w.code for w in gaps.cautions]


def test_a_program_past_its_time_is_ended_with_its_children(folder):
    began = time.monotonic()
    assert failure(folder, "hangs", time_limit="0.5 s") == "ProgramError: not done after 0.5 s"
    assert time.monotonic() - began < 30  # of 60 that its children sleep with our pipe in their hands


def test_a_failed_run_is_tried_again_and_leaves_nothing_behind(folder):
    more = {"environment": {"FLAG": str(folder / "flag")}, "scratch": str(folder)}
    assert "exit status 7" in failure(folder, "once", **more)
    (folder / "flag").unlink()
    (path,) = model_of(folder, "once", retries=1, **more).trajectories(np.array([[1.0, 0.5]]), TIMES)
    np.testing.assert_array_equal(path["y"], curve({"a": 1.0, "b": 0.5}, TIMES))
    assert {p.name for p in folder.iterdir()} == {"in.json.j2", "flag"}


@pytest.mark.slow
def test_a_rerun_asks_before_it_runs_a_program(folder, monkeypatch):
    monkeypatch.chdir(folder)
    fit(section(), directory="run", report=False)
    (folder / "data.csv").unlink(missing_ok=True)
    with pytest.raises(RefusedError, match=r"runs a program, .*; read it, then give --trust to run it"):
        rerun("run")
    questions: list[str] = []
    assert rerun("run", ask=lambda question: not questions.append(question)).same
    assert len(questions) == 1
    assert "curve.py" in questions[0]


@pytest.mark.slow
def test_a_program_that_has_changed_is_another_run(folder, monkeypatch):
    monkeypatch.chdir(folder)
    program = folder / "own.py"
    program.write_text(CURVE.read_text())
    own = section(command=f"{sys.executable} -S {{here}}/own.py well {{input}} {{output}}")
    fit(own, directory="run", report=False)
    program.write_text(CURVE.read_text() + "# changed\n")
    with pytest.raises(en4dvar.OutputError, match="cannot be resumed to the same result"):
        fit(own, directory="run", report=False, resume=True)


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no command": ({"command": ""}, "model.command: "),
    "quotes": ({"command": "echo 'a"}, "model.command: No closing quotation"),
    "no program": ({"command": "no-such-program {a}"}, "model.command: no program 'no-such-program' on the PATH"),
    "no file": ({"command": "./solver {a}"}, "solver: no such file"),
    "not executable": ({"command": "./in.json.j2"}, "is not executable; chmod +x it"),
    "placeholder": (
        {"command": "echo {aa}", "templates": []},
        "model: command: {aa} is not something that can be filled in",
    ),
    "no input": ({"templates": []}, "model: command: {input} is the first of templates, and there is none"),
    "a file left behind": (
        {"command": "cat tail.dat > {output}", "shell": True, "templates": []},
        "model: command: tail.dat is not in the scratch directory that each run has; write {here}/tail.dat, or name it",
    ),
    "parameters": ({"parameters": {}}, "model.parameters: give at least 1"),
    "name": ({"parameters": {"a b": "1"}}, "model.parameters: 'a b' cannot be the name of a parameter"),
    "unit": ({"parameters": {"a": "metre per", "b": "1"}}, "model.parameters.a: unknown unit 'metre'"),
    "unit 1": ({"parameters": {"a": 1, "b": "1"}}, "model.parameters.a: expected text; put it in quotes, not 1"),
    "bounds": (
        {"parameters": {"a": {"lower": 2, "upper": 1}, "b": "1"}},
        "model.parameters.a: lower (2) must lie below",
    ),
    "outputs": ({"outputs": {}}, "model.outputs: give at least 1"),
    "ways": ({"outputs": {"y": {"column": 1, "key": "k"}}}, "model.outputs.y: give one of column, key, pattern"),
    "no way": ({"outputs": {"y": {}}}, "model.outputs.y: give one of column, key, pattern, instructions; given: none"),
    "column": ({"outputs": {"y": {"column": 0}}}, "model.outputs.y.column: columns are counted from 1"),
    "pattern": ({"outputs": {"y": {"pattern": "("}}}, "model.outputs.y.pattern: is not a regular expression"),
    "groups": ({"outputs": {"y": {"pattern": "a"}}}, "model.outputs.y.pattern: has 0 groups; put the number"),
    "time": ({"outputs": {"y": {"pattern": "(a)", "time": 1}}}, "model.outputs.y: time goes with column or key"),
    "observations": (
        {"outputs": {"y": {"column": 1, "observations": ["a"]}}},
        "model.outputs.y: observations are those",
    ),
    "name of a file": ({"templates": {"../x": "in.json.j2"}}, "name a file of the scratch directory"),
    "file": ({"outputs": {"y": {"column": 1, "file": "../x"}}}, "model.outputs.y.file: name a file of the scratch"),
    "instructions": (
        {"outputs": {"y": {"instructions": "in.json.j2"}}},
        "the first line of PEST's instructions is pif",
    ),
    "template": ({"templates": "in.jsn.j2"}, "in.jsn.j2: no such file; the folder holds in.json.j2"),
    "unknown in template": ({"parameters": {"a": "1"}}, "model: {folder}/in.json.j2: 'b' is no parameter of the model"),
    "files": ({"files": "mesh.dat"}, "mesh.dat: no such file"),
    "two files": (
        {"templates": "in.json.tpl", "files": ["in.json.j2", "in.json"]},
        "two of them become 'in.json'",
    ),
    "time unit": ({"time_unit": "fortnight"}, "model.time_unit: "),
    "environment": ({"environment": {"A": 1}}, "model.environment.A: expected text; put it in quotes"),
    "limit": ({"time_limit": "0 s"}, "model.time_limit: should be greater than 0"),
    "limit unit": ({"time_limit": 3}, "model.time_limit: 3 has no unit; write e.g. '3 s'"),
    "retries": ({"retries": -1}, "model.retries: should be greater than or equal to 0"),
    "shell": ({"shell": "perhaps"}, "model.shell: "),
    "no shell": ({"command": "'./a && b' > {output}"}, "the program would get > as an argument; write shell: true"),
    "no shell for a file": ({"command": "./a {input} >{output}"}, "would get >{output} as an argument"),
    "no shell for two": ({"command": "./a {input}; ./b"}, "would get {input}; as an argument"),
    "scratch": ({"scratch": "nowhere"}, "nowhere: no such folder"),
    "key": ({"comand": "x"}, "model.comand: unknown key 'comand'; did you mean 'command'?"),
}


@pytest.mark.parametrize("fault", BAD)
def test_each_wrong_value_is_one_located_message(fault, folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "in.json.tpl").write_text("{}")
    (folder / "in.json").write_text("{}")
    (folder / "tail.dat").touch()
    changes, words = BAD[fault]
    with pytest.raises(en4dvar.ConfigError) as caught:
        fit(section(**changes))
    assert words.replace("{folder}", str(folder)) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1, str(caught.value)


@pytest.mark.parametrize(
    "command", [f"{CURVE} own.csv", "cd {here} && cat tail.dat", "cp {here}/tail.dat .; cat tail.dat"]
)
def test_a_file_that_the_command_writes_fetches_or_goes_to_is_not_left_behind(command, folder):
    """Beside the configuration, ``own.csv`` is what an earlier run by hand has left."""
    for name in ("own.csv", "tail.dat"):
        (folder / name).touch()
    model_of(folder, command=command, shell=True, templates=[], outputs={"y": {"file": "own.csv", "column": 2}})


def test_a_template_cannot_reach_what_a_sandbox_hides(folder):
    (folder / "in.json.j2").write_text("{{ a.__class__.__mro__ }}")
    assert "SecurityError" in failure(folder)


def test_a_broken_template_is_told_with_its_line(folder):
    (folder / "in.json.j2").write_text("{\n{{ a }\n")
    with pytest.raises(ValueError, match=r"in\.json\.j2:2: "):
        model_of(folder)


@pytest.mark.slow
def test_a_run_costs_less_than_five_milliseconds_beside_the_process(folder):
    """Against the same process started by subprocess alone, in turns; the best of many: others use this machine."""
    import subprocess

    model = CommandModel(
        CommandSettings.model_validate(
            {"command": "/bin/echo {a}", "parameters": {"a": "1"}, "outputs": {"y": {"file": "stdout", "column": 1}}},
            context={"base": folder},
        )
    )

    def took(run: Any) -> float:
        began = time.perf_counter()
        run()
        return time.perf_counter() - began

    def bare() -> Any:
        return subprocess.run(["/bin/echo", "1"], capture_output=True, check=True, env=os.environ)

    both = [(took(lambda: model.trajectories(np.ones((1, 1)), np.ones(1))), took(bare)) for _ in range(60)]
    ours, alone = np.min(both, axis=0)
    assert ours - alone < 5e-3
