"""Commands that can be continued are killed at random: python benchmarks/kills.py [KILLS] [--seed 1] [COMMAND ...]

Each is killed (SIGKILL) after a random part of the time that it takes undisturbed, continued, killed again, each time
perhaps a little later, until it ends; then its tables and results are compared with those of the undisturbed one, and
it begins anew until it has been killed KILLS times (default 20).
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import zlib
from pathlib import Path

import numpy as np
from siege import ATTACKED, LONGEST, Siege, Task, same  # where the tests are found
from siege_commands import Command, commands

from en4dvar.results.provenance import cpu_model, git_commit


def survive(siege: Siege, name: str, command: Command, kills: int, seed: int) -> tuple[float, int, int, str]:
    """Time that the command takes, s; how often it was killed, how often whole with the same bits; and a fault."""
    rng, killed, whole = np.random.default_rng([seed, zlib.crc32(name.encode())]), 0, 0
    twice = [Task(command.into(siege.base / "timed" / f"{name}{i}"), seconds=LONGEST) for i in range(2)]
    *_, timed = siege.children.attempt(twice, timeout=LONGEST)  # the first compiles
    fault = "" if timed.code == 0 else timed.told
    while killed < kills and not fault:
        out, again, latest = siege.base / "killed" / f"{name}{whole}", list[str](), timed.seconds
        while True:
            task = Task([*command.into(out), *again], seconds=LONGEST, stop=signal.SIGKILL)
            task.after, latest = float(rng.uniform(0, latest)), 1.1 * latest  # to continue may take longer
            (found,) = siege.children.attempt([task])
            if found.code != -signal.SIGKILL:
                break
            killed, again = killed + 1, command.again or []
        fault = found.told if found.code or "Traceback" in found.told else same(out, siege.undisturbed(command))
        whole += not fault
    return timed.seconds, killed, whole, fault


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kills", nargs="?", type=int, default=20)
    parser.add_argument("names", nargs="*", metavar="COMMAND")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    os.environ["PYTHONPATH"] = os.pathsep.join(ATTACKED)
    faults = []
    with tempfile.TemporaryDirectory() as folder:
        siege = Siege(Path(folder) / "base")
        siege.base.mkdir()
        siege.prepare()
        print(f"commit {git_commit(Path(__file__))}, seed {asked.seed}, {cpu_model()}\n", flush=True)
        print("| command | takes | killed | whole in the end, with the same bits |\n|---|---|---|---|", flush=True)
        for name, command in commands(siege.base).items():
            if command.again is not None and (not asked.names or name in asked.names):
                seconds, killed, whole, fault = survive(siege, name, command, asked.kills, asked.seed)
                print(f"| {name} | {seconds:.1f} s | {killed} | {whole} |", flush=True)
                faults += [f"{name}: {fault}"] * bool(fault)
        siege.children.close()
    print("\n".join(faults))
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
