"""A synthetic campaign: truths drawn from distributions, observed as an experiment would observe them.

Each data set has its own stream of random numbers, by (seed, its name): adding data sets leaves the others as they
were. When a series ends is decided by its readings alone, never by the truth. No reading is refused for its value, not
even one that noise puts below zero: that would bias the noise, and with it whatever such readings tell.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from en4dvar.config.synthetic import CampaignPlan, GroupSection
from en4dvar.diagnosis.diagnostics import nrmse
from en4dvar.executor import run_chunk
from en4dvar.model.forward import Failure
from en4dvar.model.state import TIME_SHIFT, Array
from en4dvar.plumbing.errors import En4dvarError, OutputError
from en4dvar.plumbing.files import make_folder, write_text
from en4dvar.plumbing.tables import csv_text
from en4dvar.plumbing.units import convert
from en4dvar.plumbing.user_code import reason_of
from en4dvar.priors.prior import member_stream

ATTEMPTS = 100  # truths that cannot be integrated, or yield too few readings, are drawn again so often
TRUTH = "truth.csv"


@dataclass(frozen=True)
class SyntheticSet:
    """Readings ``values`` (K,) told at ``times`` (K,), what they would be without noise, and the truth; SI."""

    name: str
    group: str
    times: Array
    values: Array
    exact: Array
    truth: Mapping[str, float]

    @property
    def nrmse(self) -> float:
        """NRMSE of the truth."""
        return nrmse(self.values, self.exact)


def draw_campaign(plan: CampaignPlan) -> tuple[SyntheticSet, ...]:
    """Every data set of the campaign, named ``<group>_01`` …. Raises :class:`En4dvarError` where none can be drawn."""
    return tuple(
        _draw(plan, name, group, i + 1) for name, group in plan.settings.groups.items() for i in range(group.datasets)
    )


def _draw(plan: CampaignPlan, kind: str, group: GroupSection, number: int) -> SyntheticSet:
    name = f"{kind}_{number:02d}"
    stream = member_stream(plan.seed, name)
    model, asked = plan.model, plan.settings
    reason = ""
    for _ in range(ATTEMPTS):
        theta = dict(group.fixed)
        theta |= {
            t.parameter.name: float(t.to_physical(np.array(t.mean + t.std * stream.standard_normal())))
            for t in group.terms
        }
        shift = float(stream.uniform(*asked.time_shift))
        gaps = stream.uniform(*asked.spacing, asked.most - 1)
        times = stream.uniform(*asked.first) + np.concatenate([[0.0], np.cumsum(gaps)])
        noise = asked.noise * stream.standard_normal(asked.most)
        try:
            state = np.asarray(model.initial_state(theta), dtype=float)
        except BaseException as error:
            reason = str(error) if isinstance(error, ValueError) else reason_of(error)
            continue
        (path,) = run_chunk(model, state[None], times + shift)
        if isinstance(path, Failure):
            reason = path.reason
            continue
        exact = np.asarray(plan.observable.operator(path), dtype=float)
        values = exact + noise
        below = np.flatnonzero(values < asked.stop * np.maximum.accumulate(values))
        count = int(below[0]) + 1 if len(below) else asked.most
        if count >= asked.fewest:
            truth = {**theta, TIME_SHIFT.name: shift}
            return SyntheticSet(name, kind, times[:count], values[:count], exact[:count], truth)
        reason = f"{count} usable readings"
    raise En4dvarError(f"{name}: no truth could be observed in {ATTEMPTS} attempts ({reason})")


def write_campaign(plan: CampaignPlan, sets: tuple[SyntheticSet, ...], command: str, force: bool = False) -> Path:
    """One CSV file a data set and ``truth.csv``, which no estimation reads. Raises :class:`OutputError`."""
    folder = plan.directory
    files = [folder / f"{s.name}.csv" for s in sets] + [folder / TRUTH]
    if not force and (there := [file for file in files if file.exists()]):
        raise OutputError(f"{there[0]}: exists; give --force to replace it")
    make_folder(folder)
    for file, dataset in zip(files, sets, strict=False):
        write_text(file, _data_csv(plan, dataset, command))
    return write_text(folder / TRUTH, truth_csv(plan, sets))


def _data_csv(plan: CampaignPlan, dataset: SyntheticSet, command: str) -> str:
    model, seen = plan.model, plan.observable
    t, v = f"t_{model.time_display_unit}", f"{seen.symbol.strip('$')}_{seen.display_unit}"
    noise = convert(plan.settings.noise, seen.unit, seen.display_unit)
    lines = [
        f"# SYNTHETIC data, no measurement: set {dataset.name} of the twin campaign {plan.name!r}",
        f"# {command}; seed {plan.seed}",
        f"# {t} in {model.time_display_unit}, {v} in {seen.display_unit}; noise std {noise:.9g} {seen.display_unit}",
        f"{t},{v}",
    ]
    times = convert(dataset.times, model.time_unit, model.time_display_unit)
    values = convert(dataset.values, seen.unit, seen.display_unit)
    return "\n".join([*lines, *(f"{a:.5f},{b:.5f}" for a, b in zip(times, values, strict=True))]) + "\n"


def truth_csv(plan: CampaignPlan, sets: tuple[SyntheticSet, ...]) -> str:
    """One line a data set: parameters in display units, NRMSE of the truth."""
    display = {p.name: (p.unit, p.display_unit or p.unit) for p in plan.model.parameters}
    display[TIME_SHIFT.name] = (plan.model.time_unit, plan.model.time_display_unit)
    heads = [name if unit == "1" else f"{name}_{unit.replace(' ', '_')}" for name, (_, unit) in display.items()]
    rows = [["dataset", "group", *heads, "nrmse_of_truth"]]
    for s in sets:
        row = [f"{convert(s.truth[name], *units):.9g}" for name, units in display.items()]
        rows.append([s.name, s.group, *row, f"{s.nrmse:.4f}"])
    about = f"# SYNTHETIC campaign {plan.name!r}: the truth behind its data sets; no estimation reads this file\n"
    return about + csv_text(rows)
