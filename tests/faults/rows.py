"""The rows of docs/faults.md: what goes wrong, what the user sees, what is kept. Tests name the row they prove.

``python tests/faults/rows.py`` writes the tables of the page again: these rows, and what attacks have found.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "faults.md"
BEGIN, END = "<!-- table: python tests/faults/rows.py -->\n", "<!-- end of the table -->\n"
FOUND, FOUND_END = "<!-- findings: python tests/faults/rows.py -->\n", "<!-- end of the findings -->\n"


@dataclass(frozen=True)
class Row:
    """``message`` is what the tests find word by word, but for what stands in braces."""

    name: str
    fault: str
    message: str
    exit_code: str
    kept: str

    def told(self, text: str) -> bool:
        """Whether ``text`` holds the message, as the command line or a function tells it."""
        for argument, option in AS_TYPED.items():
            text = text.replace(argument, option)
        parts = (re.escape(part) for part in re.split(r"\{[^}]*\}", self.message))
        return re.search(".*".join(parts), text) is not None


AS_TYPED = {
    "the run with resume=True": "'en4dvar run' with --resume",
    "give resume=True": "give --resume",
    "give another directory": "give another --out",
}
DONE = "every finished data set; the others continue from their last forward runs"
ROWS = tuple(
    Row(*cells)
    for cells in (
        ("kill", "SIGKILL, a crash, the power gone: at any moment", "", "137", f"{DONE}; the same bits after --resume"),
        ("kill-force", "the same while --force replaces an earlier run", "", "137",
         "the earlier result until the new one is whole; then the new one"),
        ("kill-workers", "the main process is killed while workers are at work (processes, dask)", "", "137",
         "the same; the workers end by themselves"),
        ("interrupt", "Ctrl-C (SIGINT), the time limit of a batch system (SIGTERM), a terminal that is gone (SIGHUP)",
         "interrupted; {n} of {all} data sets are done and kept in {run}\nto continue: en4dvar run {words} --resume",
         "130", DONE),
        ("interrupt-early", "the same before the run directory is there",
         "interrupted before the run began\nto run it: en4dvar run {words}", "130", "everything; nothing is begun"),
        ("requeued", "a batch job was killed before it began, and is started with --resume",
         "note: {run} holds no run yet; this one begins", "0", "nothing was there"),
        ("kill-commands", "study, sweep, joint, population, report, rerun or export are killed", "", "137",
         "what was there; study, sweep, joint and population continue with --resume; run the others again"),
        ("foreign", "a run directory that somebody else prepared: names that lead out of it, links, pipes, devices",
         "{file}: is a symbolic link, which a run neither follows nor replaces; remove it", "2",
         "everything outside the directory"),
        ("own-files", "the run directory holds files of the user's, one under a name that the run would write",
         "{run}: {file} was not written by a run and would be replaced; move it away", "2",
         "the user's files; nothing is begun, and no page is written"),
        ("half-replaced", "report, export, compare or rerun where a run was killed while it replaced another",
         "{run}: a run was killed while its files took the place of an earlier run's; 'en4dvar run' with --resume "
         "finishes that", "2", "everything; these commands write nothing"),
        ("chdir", "a model changes the current directory (--out is relative)", "", "0", "everything"),
        ("disk-full", "the disk is full",
         "{file}: cannot be written: No space left on device; {n} of {all} data sets are done and kept in {run}; "
         "give --resume to continue", "2", f"{DONE}; no half-written file"),
        ("disk-failing", "the disk or a quota is full, or the disk fails (ENOSPC, EDQUOT, EIO), under any command",
         "cannot be written: {reason of the system}", "2", "what was there before; no half-written file"),
        ("output-full", "standard output cannot be written", "standard output: cannot be written: {reason}", "2",
         "the same"),
        ("read-only", "the output directory cannot be written",
         "{run}: cannot be used as run directory: Permission denied", "2", "nothing is begun"),
        ("removed", "the run directory is removed or renamed during the run",
         "{file}: cannot be written: No such file or directory; the run directory {run} was removed or renamed while "
         "the run was at work", "2", "what was renamed; it can be resumed there"),
        ("checkpoint-damaged", "a checkpoint is cut short, altered or of another run",
         "{file}: damaged or incomplete (its checksum does not match); {data set} is estimated from the start", "0",
         "everything else"),
        ("checkpoint-older", "a checkpoint of another version",
         "{file}: checkpoint format 0; this version reads 4; {data set} is estimated from the start", "0",
         "everything else"),
        ("result-damaged", "a result file is altered",
         "{file}: damaged or altered since it was written (its checksum does not match)", "2",
         "the file is not read; --resume estimates it again"),
        ("result-cut", "a result file is cut short",
         "{file}: not a complete result of en4dvar: it is cut short, was altered, or comes from an older version", "2",
         "the file is not read; --resume estimates it again"),
        ("result-older", "a result file of another version",
         "{file}: result format 0; this version of en4dvar reads 1", "2", "the file stays as it is"),
        ("pack-damaged", "the results of a campaign (`datasets.pack`) are damaged anywhere, cut short or gone",
         "{run}: no result that can be read of {data set} ({reason}); 'en4dvar run' with --resume estimates what is "
         "missing", "1 (export, report: the others are given), 2",
         "every data set that is intact; the others are named, and --resume estimates them to the same bits"),
        ("two-runs", "two runs in one directory",
         "{run}: in use by process {pid} on {machine}; wait for it to end, or give another --out", "2",
         "the first run"),
        ("stale-lock", "the lock of a run that was killed", "", "0", "the lock goes with its process"),
        ("no-locks", "the file system knows no locks (some network file systems)", "", "0",
         "everything, but nobody is kept from starting a second run there"),
        ("worker-killed", "a worker process is killed (processes, dask), by the system for its memory, or by hand", "",
         "0", "everything; its work is repeated, to the same bits"),
        ("worker-always", "a data set kills every worker that tries it",
         "{data set}: WorkerLostError: a worker process died", "1", "all other data sets"),
        ("worker-memory",
         "a dask worker passes its limit of memory whenever it is at a data set, and is ended by its nanny",
         "{n} of {all} members failed in the {stage}; at least {few} must survive. Most frequent reasons: a worker "
         "process died", "3", "all other data sets; where it does so once: everything, to the same bits"),
        ("worker-paused", "all dask workers are paused for a minute, near their limit of memory",
         "dask scheduler {address}: has had no worker for {time} s that takes work: all are paused near their limit of "
         "memory (dask worker --memory-limit); {n} of {all} data sets are done and kept in {run}; give --resume to "
         "continue", "1", DONE),
        ("scheduler-lost", "the dask scheduler is lost",
         "lost the connection to the dask scheduler {address}; {n} of {all} data sets are done and kept in {run}; "
         "give --resume to continue", "1", DONE),
        ("no-worker", "the dask cluster has no worker left for a minute",
         "dask scheduler {address}: has had no worker for {time} s; {n} of {all} data sets are done and kept in {run}; "
         "give --resume to continue", "1", DONE),
        ("model-raises", "the forward model raises an exception", "ArithmeticError: no such oscillation", "0",
         "all other members; the member is lost, its reason in the result"),
        ("model-nan", "it returns NaN", "non-finite state", "0", "the same"),
        ("model-shape", "it returns an array of the wrong shape", "step returned shape (3,), expected (4,)", "0",
         "the same"),
        ("model-hangs", "it never returns (with `execution: {time_limit: 60 s}`)",
         "TimeLimitError: not done after {time} s", "0", "the same; compiled code is ended with its worker process"),
        ("model-memory", "it allocates without bound (with `execution: {memory_limit: 4 GB}`)", "MemoryError: {size}",
         "0", "the same; without the limit the system kills the worker, see there"),
        ("half-lost", "half of the members fail at once, in any iteration",
         "4 of 8 members failed in the {stage}: {reason} (4×)", "0", "the result, with a warning"),
        ("all-lost", "all members fail at once, in any iteration",
         "8 of 8 members failed in the {stage}; at least 4 must survive. Most frequent reasons: {reason} (8×)", "3",
         "all other data sets"),
        ("model-exits", "it ends the program (`sys.exit()`, `quit()`), or raises what is no `Exception`",
         "SystemExit: sys.exit(0)", "0", "the same, with every executor"),
        ("model-os-exit", "it ends its process (`os._exit`, a crash of compiled code): in a worker process",
         "a worker process died", "0", "the same"),
        ("model-os-exit-here", "the same in the process of the run (serial, threads), which nothing can catch", "",
         "that of the model", f"{DONE}; the same bits after --resume"),
        ("load-exits", "the file of a model or law ends the program or raises anything as it is loaded or set up",
         "{where}: SystemExit: sys.exit(0)", "2", "nothing is begun"),
        ("model-shared", "a model changes what the process shares: numpy's errors and random state, warnings, "
         "Ctrl-C, the working directory", "", "0", "everything; the same bits as without"),
        ("output-closed", "a model closes standard output", "standard output was closed, by a model perhaps; what was "
         "computed is kept", "1", "everything"),
        ("model-varies", "a model gives other numbers when a member is run again: noise, or a state that it keeps",
         "the model gives other numbers when a member is run again", "2 (of many data sets: 1)",
         "nothing is estimated"),
        ("rerun-stranger", "`rerun`, `joint`, `population` or `compare` of a result file that names code that is not "
         "installed", "{run}: its {model} is code that no configuration of yours has named as it is now, {path}; read "
         "it, then give --trust to run it", "2", "nothing of that code has run; at a terminal the user is asked"),
        ("program-children", "a program (`command`) leaves processes behind, in its background or in a session of "
         "their own", "", "0", "everything; they are ended with it"),
        ("program-output", "a program's output is a pipe, a device or endless, or its template never ends", "{reason}",
         "0", "all other members; the member is lost, a template within the `time_limit` of the program"),
        ("program-stop", "a stop (Ctrl-C, SIGTERM) while programs are at work, or the run is killed",
         "interrupted; {n} of {all} data sets are done and kept in {run}\nto continue: en4dvar run {words} --resume",
         "130", "as above; the programs, their children and their scratch folders are gone within two seconds"),
        ("no-file", "a pipe, a socket, a device or a folder where a file is read", "{file}: {what}", "2",
         "the command does not wait"),
        ("sparse", "a file of a terabyte, sparse or not", "{file}: {size}; at most {most} are read", "2",
         "its size is checked before it is read"),
        ("decoding", "a movie, workbook or MATLAB file that takes its library down, or too much time or memory",
         "{file}: {takes more than it may, or ends its process}; it is damaged, or not what it says it is",
         "2", "everything; a process of its own reads it, and is ended"),
        ("foreign-data", "a result with variables or groups in other files (external storage, virtual data, links)",
         "{variable} {is} {in or into} another file, which is not opened", "2", "nothing of the other file is read"),
        ("clock", "the clock jumps backwards", "", "0", "everything; only monotonic clocks are used"),
        ("many-sets", "10 000 data sets in a folder", "", "0", "memory flat, the first estimate within seconds"),
        ("many-rows", "a data file of 1 000 000 rows", "", "0", "read within seconds; estimated in flat memory"),
        ("many-members", "10 000 members", "", "0",
         "time and memory in proportion to their number (En4D-Var with a bundle, the default)"),
        ("mat-damaged", "a `.mat` file is damaged",
         "{file}: cannot be read as a MATLAB file: {what scipy says of it}", "2",
         "everything; a process of its own reads it, and is ended"),
        ("bomb", "a file that is small until it is read, or has no end: a configuration of 100 MB, `.mat` that unpacks "
         "to terabytes", "longer than 1 MB, which no configuration is; numbers belong into data files", "2",
         "nothing is begun"),
        ("alias-bomb", "aliases in YAML that name each other (\"billion laughs\")", "aliases are not used here; repeat "
         "the value", "2", "nothing is begun"),
        ("wide", "a CSV file of 10 000 000 columns",
         "{file}: {count} columns; at most 10000 are read; if a line holds one column's numbers, transpose it", "2",
         "nothing is begun"),
        ("locale", "a Turkish or German locale", "", "0", "the same bits, points in every file"),
        ("first-starts", "20 first starts at once: an empty cache of compiled code, one HOME", "", "0",
         "all end, with the same bits"),
        ("read-only-home", "program and HOME cannot be written",
         "note: {place} cannot be written; compiled code is kept in {folder}, and compiled again where that is gone "
         "(set NUMBA_CACHE_DIR to a folder that stays)", "0", "everything"),
        ("odd-number", "a number that cannot be computed with (a prior of std 1e308, readings of 1e300, a seed of 2⁶³)",
         "{file}:{line}:{column}: {key}: {reason}", "2", "nothing is begun"),
        ("long-value", "a value of 50 000 characters where another was expected",
         "{file}:{line}:{column}: {key}: {the beginning and the end of it}", "2", "nothing is begun"),
        ("no-home", "a path that begins with the home of somebody who is not there",
         "{path}: the home folder that ~ stands for is not known", "2", "nothing is begun"),
        ("own-code", "the file of an own model or law raises as it is imported",
         "{file}:{line}: RuntimeError: not today", "2", "nothing is begun"),
        ("symbol", "a symbol or label of a model that no figure can hold",
         "the symbol {symbol} of {name} cannot be written in a figure: {reason}", "2", "nothing is begun"),
        ("lock-number", "a lock that names an impossible process",
         "{run}: in use by process 99999999999999999999 on {machine}; wait for it to end, or give another --out", "2",
         "everything"),
        ("result-incomplete", "a result file that lacks something, or holds a unit or symbol that means nothing, with "
         "a good seal", "{file}: not a result of en4dvar: {what}", "2", "the file stays as it is"),
        ("environment", "an environment variable that prevents computing or drawing "
         "(`NUMBA_DISABLE_JIT`, a `SOURCE_DATE_EPOCH` that is no number)", "{name}; unset it", "2", "nothing is begun"),
        ("left-behind", "files half written and temporary folders of a process that was killed", "", "0",
         "they are removed by the next that writes there, files of others never"),
        ("formula", "names that a spreadsheet takes for formulas, symbols that LaTeX takes for commands", "", "0",
         "everything; in CSV behind an apostrophe, in LaTeX as text"),
        ("model-warns", "the model overflows or divides by zero", "", "0",
         "all other members; the member is lost where its state is not finite"),
        ("paths", "blanks, any script, bytes that are not UTF-8 in the names of files and folders", "", "0",
         "everything"),
    )
)  # fmt: skip


FINDINGS = (
    ("code that a result names by `/proc/self/cwd/…` or an absolute path was run without asking",
     "faults/test_strangers.py::test_a_law_of_a_strangers_file"),
    ("`design --force` and `sweep-twin` overwrote a file of the user's",
     "runs/test_kinds.py::test_a_foreign_file_is_never_replaced"),
    ("a data set vanished without a word from a damaged or cut `datasets.pack`; `--resume` called a damaged set done",
     "faults/test_packs.py::test_no_set_vanishes_from_a_damaged_pack "
     "faults/test_packs.py::test_no_set_vanishes_from_many_damaged_packs"),
    ("children of a program survived it", "model/test_ending.py::test_no_child_survives_its_program"),
    ("a program's output that is a pipe or a device, or its template, blocked the run, and a stop was not heeded",
     "model/test_ending.py::test_an_output_that_cannot_be_read_is_a_lost_member "
     "model/test_ending.py::test_a_template_without_end_is_past_its_time "
     "model/test_ending.py::test_a_stop_is_heeded_wherever_a_program_stands_and_nothing_survives"),
    ("a TIFF that points to itself, a page of 30 000 × 30 000, 20 MB of metadata, a pipe among frames, a cut mp4",
     "faults/test_gate.py::test_a_tiff_that_does_not_end faults/test_gate.py::test_a_pipe_is_refused "
     "faults/test_gate.py::test_a_cut_mp4_is_told faults/test_gate.py::test_a_frame_of_a_folder_that_is_too_large"),
    ("a workbook of 313 kB took 13.6 GB",
     "faults/test_gate.py::test_a_workbook_that_is_wide_where_nothing_stands "
     "faults/test_gate.py::test_limits_of_decoding"),
    ("a result with external storage, virtual data or links gave bytes of another file",
     "faults/test_gate.py::test_a_result_with_numbers_in_another_file_is_refused"),
    ("tracebacks of damaged results and checkpoints with a good seal, and of PEST's files",
     "faults/test_gate.py::test_a_series_with_a_good_seal_that_lacks_something "
     "faults/test_gate.py::test_a_sealed_file_that_takes_its_library_down "
     "faults/test_gate.py::test_an_estimate_of_several_with_a_good_seal_that_lacks_something "
     "faults/test_plain_input.py::test_a_result_sealed_again_without_what_is_read "
     "faults/test_siege.py::test_an_attack_holds "
     "faults/test_gate.py::test_control_files_of_pest_that_mean_nothing"),
    ("sparse files of a terabyte were read",
     "faults/test_gate.py::test_a_sparse_file_of_a_terabyte_is_refused "
     "faults/test_gate.py::test_a_manifest_of_a_terabyte_is_refused"),
    ("tracebacks for a closed standard output, `NUMBA_DISABLE_JIT=1` and `SOURCE_DATE_EPOCH=junk`",
     "faults/test_surroundings.py::test_an_environment_that_cannot_be_worked_in "
     "faults/test_surroundings.py::test_standard_output_that_is_closed"),
    ("escape sequences in names reached `run.log`, `summary.csv` and the terminal",
     "faults/test_terminal.py::test_a_terminal_and_a_log_obey_no_name"),
    ("half-written files and temporary folders stayed behind after kills",
     "faults/test_surroundings.py::test_what_a_killed_process_has_left_is_removed_by_the_next"),
    ("a run that hit a limit of 300 bytes a file could not be resumed",
     "faults/test_commands.py::test_no_room "
     "runs/test_run_directory.py::test_a_run_that_could_not_begin_is_begun_by_resume"),
)  # fmt: skip
"""What the second siege found on earlier code, and the tests (``file::function`` below ``tests/``) that fail there."""


def row(name: str) -> Row:
    """Raises :class:`KeyError`."""
    return {r.name: r for r in ROWS}[name]


@cache
def proofs() -> dict[str, set[str]]:
    """Name of the row → files of tests (relative to ``tests/``) that are marked with it."""
    found: dict[str, set[str]] = {}
    for file in sorted((ROOT / "tests").rglob("test_*.py")):
        text = file.read_text(encoding="utf-8")
        for name in _marks(ast.parse(text)) if "mark.fault" in text else ():
            found.setdefault(name, set()).add(file.relative_to(ROOT / "tests").as_posix())
    return found


def _marks(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("mark.fault"):
            yield from (str(a.value) for a in node.args if isinstance(a, ast.Constant))


def table() -> str:
    """The table in Markdown."""
    lines = ["| fault | what the user sees | exit code | what is kept | test |", "|---|---|---|---|---|"]
    tests = proofs()
    for r in ROWS:
        message = "<br>".join(f"`{part}`" for part in r.message.splitlines()) or "nothing"
        files = "<br>".join(f"`{name}`" for name in sorted(tests.get(r.name, ())))
        lines.append(f"| {r.fault} | {message} | {r.exit_code} | {r.kept} | {files} |")
    return "".join(f"{line}\n" for line in lines)


def findings() -> str:
    """The table of findings in Markdown."""
    lines = ["| found | test |", "|---|---|"]
    for found, tests in FINDINGS:
        names = "<br>".join(f"`{name}`" for name in tests.split())
        lines.append(f"| {found} | {names} |")
    return "".join(f"{line}\n" for line in lines)


def functions_in(file: str) -> set[str]:
    """Names of the test functions of a file below ``tests/``."""
    tree = ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


def rendered(page: str) -> str:
    """The page with the tables of today."""
    for begin, end, lines in ((BEGIN, END, table()), (FOUND, FOUND_END, findings())):
        before, _, rest = page.partition(begin)
        _, _, after = rest.partition(end)
        page = f"{before}{begin}\n{lines}\n{end}{after}"
    return page


if __name__ == "__main__":
    PAGE.write_text(rendered(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
