"""The commands that a siege stops and kills: every kind of run, and what else writes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from en4dvar.results.kinds import KINDS

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@dataclass(frozen=True)
class Command:
    """``words`` of a command that is stopped, without its folder; ``again``: what continues it, or None where nothing
    is left to continue; ``out``: whether it is given a folder.
    """

    words: list[str]
    again: list[str] | None = None
    out: bool = True

    def into(self, folder: Path) -> list[str]:
        python = self.words[0] == "python"
        return [*self.words, *([] if python or not self.out else ["--out"]), *([str(folder)] if self.out else [])]


def commands(base: Path) -> dict[str, Command]:
    """Every kind of run, and every command that is no run but writes; what can be continued ends in the same bits."""
    toy, campaign, twin = (str(base / name) for name in ("toy.yaml", "campaign", "twin.yaml"))
    ring = "assimilation.inflation=[1.0, 1.1]"
    often, resume = ["--set", "execution.checkpoint_every=0"], ["--resume"]
    runs = {f"run, {how}": ["run", toy, "--set", f"execution.executor={how}"] for how in ("serial", "threads")}
    runs |= {
        "run, processes": ["run", toy, "--set", "execution.executor=processes", "--workers", "2"],
        "run, chain": ["run", toy, "--set", "assimilation.refine=mcmc", "--no-report", *often],
        "estimate": ["run", toy, *often],
        "sequence": ["run", str(next((base / "series").glob("*.yaml"))), *often],
        "twin": ["run", twin, *often],
        "sweep-twin": ["sweep-twin", twin, "--vary", ring, "--seeds", "3"],
        "calibrate": ["calibrate", toy, "--sets", "5", *often],
        "design": ["design", str(CONFIGS / "linear_design.yaml"), *often],
        "sweep": ["sweep", toy, "--trajectories", "64", "--shift", "1 ns", "--step", "1 ms"],
        "study": ["study", str(base / "study" / "study.yaml")],
    }
    found = {name: Command(words, resume) for name, words in runs.items()}
    found |= {
        "joint": Command(["joint", campaign, "--share", "k"], []),  # they continue by themselves, or are told to
        "population": Command(["population", campaign, "--of", "k"], resume),
        "compare": Command(["compare", campaign, str(base / "other")], []),
        "control file": Command(["python", "siege_files", "pest", str(base / "pest" / "line.pst")]),
        "rerun": Command(["rerun", campaign], out=False),
        "track": Command(
            ["track", str(base / "movies" / "a.tif"), "--pixel", "2.5 um", "--frame-rate", "400 kHz", "--force"]
        ),
    }
    assert KINDS.keys() <= found.keys(), "a kind of run that the siege does not stop"
    return found
