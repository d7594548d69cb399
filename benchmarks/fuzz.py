"""Coverage-guided fuzzing of everything that reads from outside: one command, figures as a table.

    pip install atheris
    python benchmarks/fuzz.py [--runs 15000] [--seed 1] [TARGET ...]

Each target of ``tests/fuzz/fuzz_targets.py`` gets ``--runs`` inputs that libFuzzer derives from valid ones, guided by
the branches they reach in ``en4dvar`` and PyYAML; ``shape`` are valid configurations with parts replaced, removed,
renamed or swapped. An exception that is not an error of ours, a message without a place, or 30 s without an answer is a
finding: the input is kept in ``runs/fuzz/`` and the exit code is 1.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FINDINGS = ROOT / "runs" / "fuzz"
SHAPE = "shape"
SECONDS = 30  # for one input
_ONE = "--one"  # target in this process
_DONE = re.compile(r"Done (\d+)(?: runs?)? in")
_COVERAGE = re.compile(r"cov: (\d+)")


def main() -> None:
    sys.path[:0] = [str(ROOT), str(ROOT / "models"), str(ROOT / "tests" / "fuzz")]
    if sys.argv[1:2] == [_ONE]:
        fuzz(sys.argv[2], sys.argv[3:])
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="default: all")
    parser.add_argument("--runs", type=int, default=15_000, help="inputs a target")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    from fuzz_targets import TARGETS

    chosen = options.targets or [*TARGETS, SHAPE]
    if unknown := set(chosen) - {*TARGETS, SHAPE}:
        parser.error(f"no target {', '.join(sorted(unknown))}; there are {', '.join([*TARGETS, SHAPE])}")
    print("| target | inputs | branches reached | s | findings |\n|---|---|---|---|---|")
    total = findings = 0
    for target in chosen:
        runs, reached, seconds, failed = campaign(target, options.runs, options.seed)
        print(f"| {target} | {runs} | {reached} | {seconds:.0f} | {failed} |", flush=True)
        total, findings = total + runs, findings + failed
    print(f"| all | {total} | | | {findings} |")
    sys.exit(1 if findings else 0)


def campaign(target: str, runs: int, seed: int) -> tuple[int, int, float, int]:
    """(inputs tried, branches reached, seconds, findings) of one target in a process of its own."""
    FINDINGS.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as corpus:
        for i, content in enumerate(_seeds(target)):
            (Path(corpus) / f"seed{i}").write_bytes(content)
        begin = time.perf_counter()
        options = [
            f"-atheris_runs={runs}",
            f"-seed={seed}",
            f"-timeout={SECONDS}",
            "-max_len=4096",
            "-rss_limit_mb=4096",
        ]
        command = [sys.executable, __file__, _ONE, target, *options, f"-artifact_prefix={FINDINGS}/{target}-", corpus]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=corpus)
        seconds = time.perf_counter() - begin
    finished, reached = _DONE.search(done.stderr), _COVERAGE.findall(done.stderr)
    if done.returncode:
        print(done.stdout[-3000:], done.stderr[-3000:], f"exit code {done.returncode}", file=sys.stderr)
    tried = int(finished[1]) if finished else max([0, *map(int, re.findall(r"^#(\d+)", done.stderr, re.MULTILINE))])
    return tried, int(reached[-1]) if reached else 0, seconds, int(done.returncode != 0)


def _seeds(target: str) -> list[bytes]:
    import fuzz_seeds

    if target == SHAPE:
        return [bytes(range(64))]
    if target == "result":
        return [b"\x89HDF\r\n\x1a\n" + bytes(200)]
    return list(fuzz_seeds.of(target))


def fuzz(target: str, options: list[str]) -> None:
    """Does not return: libFuzzer ends the process."""
    import atheris

    with atheris.instrument_imports(include=["en4dvar", "yaml"], exclude=["en4dvar_bubble.solver"]):
        import fuzz_targets
    import fuzz_mutations
    import fuzz_seeds
    import yaml
    from hypothesis import HealthCheck, given, settings
    from hypothesis import strategies as st

    folder = Path(tempfile.mkdtemp(prefix="en4dvar_fuzz_"))
    (folder / "data").symlink_to(fuzz_seeds.CONFIGS / "data")
    documents = [yaml.safe_load(content) for content in fuzz_seeds.of("configuration")]

    @given(st.data())
    @settings(deadline=None, database=None, suppress_health_check=list(HealthCheck))
    def shape(data: st.DataObject) -> None:
        document = data.draw(fuzz_mutations.mutated(data.draw(st.sampled_from(documents))))
        text = yaml.safe_dump(document, allow_unicode=True, sort_keys=False)
        fuzz_targets.configuration(text.encode("utf-8", "surrogatepass"), folder)

    def raw(content: bytes) -> None:
        fuzz_targets.TARGETS[target](content, folder)

    one_input = vars(shape)["hypothesis"].fuzz_one_input if target == SHAPE else raw
    atheris.Setup([sys.argv[0], *options], one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
