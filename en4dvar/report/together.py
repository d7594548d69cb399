"""The pages of estimates of several data sets: a joint one (what they share, each says alone, and is fitted) and a
population (the mean, how much the data sets vary, the next one, and each given all of them).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from en4dvar.diagnosis.diagnostics import HARDLY_INFORMED, member_quantiles
from en4dvar.diagnosis.honesty.checks import MOVED
from en4dvar.estimation.population.campaign import DETERMINED, FEWEST, Combination
from en4dvar.estimation.population.hierarchy import named
from en4dvar.estimation.summary import ParameterSummary, estimate_cells, results_table, summary_rows
from en4dvar.plumbing.caution import Caution, untrusted
from en4dvar.plumbing.files import write_text
from en4dvar.plumbing.hints import percent
from en4dvar.plumbing.tables import table, write_csv
from en4dvar.report import text
from en4dvar.report.chart import PAGE, POINTS, Chart, Panel, in_columns
from en4dvar.report.export import Found, latex_table
from en4dvar.report.html import write_page
from en4dvar.report.svg import Captioned
from en4dvar.results.declared import NAMES, Names, parameter_of
from en4dvar.results.netcdf import Group, Variable
from en4dvar.results.together import JOINT, POPULATION, QUANTILES, StoredGroups, StoredJoint, StoredPopulation

MOST_FITS = 12  # panels of the figure
NOTHING = np.full(1, np.nan)
NINETY = 3.2897073  # std of a normal distribution between its 5 and 95 %
DOUBTED = "Orange, without an interval: not to be trusted, because of its warnings."
SHARED = "Median and 5–95 % of the shared parameters, each data set alone (grey) and all{} together. " + DOUBTED
FITS = "Observations and 5–95 % of the joint posterior's predictions."


@dataclass(frozen=True)
class JointRow(ParameterSummary):
    """One number of the joint estimate; ``dataset`` "" for what is shared, ``without`` the names of the odd data sets
    where they are left out. ``stated``: the data have neither narrowed nor moved what is shared.
    """

    dataset: str = ""
    without: str = ""
    stated: bool = False


def estimates(joint: StoredJoint) -> tuple[JointRow, ...]:
    """What is shared, without the odd data sets first, then what is each data set's own: without these but of them."""
    rows = {(row.name, row.dataset, row.without): row for row in _rows(joint, "posterior", joint.cautions)}
    if odd := ", ".join(joint.odd):
        rest = _rows(joint, "without", joint.doubts, odd)
        rows |= {(row.name, row.dataset, "" if row.dataset else odd): row for row in rest}
    shared = list(joint.shared)

    def order(row: JointRow) -> tuple[int, ...]:
        return (1,) if row.dataset else (0, row.stated, shared.index(row.name), not row.without)

    return tuple(sorted(rows.values(), key=order))


def _rows(joint: StoredJoint, group: str, cautions: Sequence[Caution], without: str = "") -> Iterator[JointRow]:
    held = joint.group(group)
    for name, values in held.variables.items():
        every = _of_each(values, held) if "dataset" in values.dims else {"": values}
        for dataset, draws in every.items():
            if not np.isfinite(draws.values).any():
                continue
            row = _row(cautions, name, draws)
            stated = not (dataset or row.untrusted) and _as_stated(joint, name)
            yield JointRow(**vars(row), dataset=dataset, without=without, stated=stated)


def _of_each(values: Variable, held: Group) -> dict[str, Variable]:
    """By data set, what a variable along data sets is of it."""
    dims = values.dims[:-1]
    every = zip(map(str, held["dataset"].values), np.moveaxis(values.values, -1, 0), strict=True)
    return {dataset: replace(values, dims=dims, values=own) for dataset, own in every}


def _as_stated(joint: StoredJoint, name: str) -> bool:
    """Whether the posterior of what is shared, without the odd data sets, has the mean and the width of its prior."""
    draws, (low, middle, high) = joint.rest[name].values, joint.group("prior")[name].values
    std = (high - low) / NINETY
    return bool(draws.std() > np.sqrt(1 - HARDLY_INFORMED) * std and abs(np.median(draws) - middle) < MOVED * std)


def _row(cautions: Sequence[Caution], name: str, draws: Variable, prior: Variable | None = None) -> ParameterSummary:
    before, after = (NOTHING if draw is None else text.shown(draw).ravel() for draw in (prior, draws))
    centre, learned = float(np.median(draws.values)), float(draws.attrs.get("learned", np.nan))
    return ParameterSummary.of(parameter_of(name, draws.attrs), before, after, centre, learned, cautions)


def joint_lines(joint: StoredJoint) -> list[str]:
    """What is shared, without the odd data sets, a line each, for the page of the campaign; one line for what the data
    leave as it was stated.
    """
    lines, count = [], len(joint.datasets) - len(joint.odd)
    shared = [e for e in estimates(joint) if not e.dataset and e.without == ", ".join(joint.odd)]
    for e in (e for e in shared if not e.stated):
        without = f", one value in {count} data sets" + (f", without {e.without}" if e.without else "")
        doubt = f"not to be trusted: {', '.join(e.untrusted)}" if e.untrusted else f"5–95 %: {_range(e)}"
        lines.append(f"{e.label} {e.symbol} = {_median(e)} ({doubt}){without}")
    if stated := [e.label for e in shared if e.stated]:
        lines.append(f"the data add nothing to what was known before of: {', '.join(stated)}")
    return lines


def joint_figure(joint: StoredJoint) -> Captioned:
    """All data sets over what they share; without what the data leave as it was stated, where there is more."""
    held = [name for name in joint.shared if name in joint.rest]
    shared = {name: joint.rest[name] for name in [n for n in held if not _as_stated(joint, n)] or held}
    caption = SHARED.format(f" but {', '.join(joint.odd)}" if joint.odd else "")
    return "forest", caption, forest(joint, joint.datasets, shared)


def joint_table(joint: StoredJoint) -> str:
    rows = [
        (f"{e.name} without {e.without}" if e.without else e.name, e.unit, *estimate_cells(e))
        for e in estimates(joint)
        if not e.dataset
    ]
    return table([("shared", "unit", "mean", "std", "5 %", "50 %", "95 %"), *rows])


def forest(
    groups: StoredGroups, datasets: Sequence[str], common: Mapping[str, Variable],
    reference: Mapping[str, tuple[float, float]] | None = None,
) -> Chart:  # fmt: skip
    """Each data set alone, and the draws of what is ``common``, one panel each; of some a ``reference`` of others.
    Where the posterior has the parameter for each data set too, that is drawn below.
    """
    alone, posterior, count = groups.group("alone"), groups.group("posterior"), len(datasets)
    ticks, labels = (range(0, -count, -1), [text.figure_text(d) for d in datasets]) if count <= 60 else ((), ())
    panels = []
    for name, draws in common.items():
        low, middle, high = text.shown(draws, member_quantiles(draws.values, QUANTILES))
        panel = Panel(text.axis_label(draws), ylim=(-float(count), 1.0), yticks=ticks, y_names=labels)
        doubted = bool(untrusted(groups.doubts, name))
        if not doubted:
            panel.band([low, high], np.full(2, -count), np.ones(2), "posterior", 0.2)
        panel.line([middle, middle], [-count, 1], *(("centre", 0.9, "--") if doubted else ("posterior",)))
        if reference and name in reference:
            value = float(text.shown(draws, reference[name][0]))
            panel.line([value, value], [-count, 1], "ink", dash=":")
        rows = text.shown(draws, alone[name].values)
        has = np.flatnonzero(np.isfinite(rows[:, 1]))
        panel.intervals(rows[has, 0], rows[has, 2], -has, "prior")
        panel.dots(rows[has, 1], -has, "prior", 3.0)
        if name in posterior and "dataset" in posterior[name].dims:
            low, middle, high = text.shown(draws, member_quantiles(posterior[name].values[0], QUANTILES, axis=0))
            if not doubted:
                panel.intervals(low[has], high[has], -has - 0.3, "posterior")
                panel.dots(middle[has], -has - 0.3, "posterior", 2.0)
            else:
                panel.dots(middle[has], -has - 0.3, "centre", 3.0, kind="rings")
        least = min(np.nanmin(mark.x) for mark in panel.marks if mark.x.size)
        panel.x_logarithmic = bool(least > 0 and rows[has].max() > 20 * rows[has].min())
        panels.append(panel)
    return in_columns(panels, (2.0 + 0.36 * min(count, 60)) * POINTS)


def fits(joint: StoredJoint) -> list[Captioned]:
    """Observations and bands of the first data sets that have several; no panel where a set is one number."""
    fit, panels = joint.group("fit"), []
    followed = [i for i, times in enumerate(fit["time"].values) if np.isfinite(times).sum() > 1]
    for i in followed[:MOST_FITS]:
        times, low, middle, high = fit["band"].values[i].T
        observable, unit, time_unit = (str(fit[key].values[i]) for key in ("observable", "unit", "time_unit"))
        label, title = text.with_unit(observable, unit), text.figure_text(joint.datasets[i])
        panel = Panel(text.with_unit("time", time_unit), label, title=title)
        panel.band(times, low, high, "posterior", 0.25)
        panel.line(times, middle, "posterior")
        panel.dots(fit["time"].values[i], fit["value"].values[i], "ink", 1.8)
        panels.append(panel)
    caption = FITS + (f" The first {MOST_FITS}." if len(joint.datasets) > MOST_FITS else "")
    return [("fits", caption, in_columns(panels, 3.6 * POINTS, width=PAGE))] if panels else []


def write_joint(folder: Path) -> Path:
    """Write ``joint.html`` and ``joint.csv`` from ``joint.nc``; returns the page. Raises :class:`OutputError`."""
    joint = StoredJoint.load(folder / JOINT)
    rows, fit, absent = estimates(joint), joint.group("fit"), np.full(len(joint.datasets), np.nan)
    # of each data set under the shared values the misfit per reading, and how far it is from all others alone
    fitted = [fit[c].values if c in fit else absent for c in ("chi2_per_observation", "distance", "chance")]
    columns = ("name", "dataset", "without", "mean", "std", "q05", "q50", "q95", "unit")
    cells = [[getattr(e, c) for c in columns] + [" ".join(e.untrusted)] for e in rows]
    write_csv(folder / "joint.csv", [[*columns, "warnings"], *cells])
    return write_page(
        folder,
        "joint",
        [joint_figure(joint), *fits(joint)],
        joint=joint,
        shared=[("", e) for e in rows if not e.dataset],
        own=[(e.dataset, e) for e in rows if e.dataset],
        sets=[*zip(joint.datasets, *fitted, strict=True)],
    )


CAPTION = (
    "Median and 5–95 % of each data set alone (grey) and given all (below it); band: the {} of the population{}. "
    + DOUBTED
)


def summaries(stored: StoredPopulation, group: str = "posterior") -> list[Found]:
    """Median, mean, spread and the next one; of the posterior also each data set, given all of them."""
    posterior, prior = stored.group(group), stored.group("prior")
    rows: list[Found] = []
    for what, words in stored.words.items():
        columns = {name: f"{name}_{what}" for name in stored.names}
        of_it = [_row(stored.cautions, name, posterior[key], prior[key]) for name, key in columns.items()]
        rows.append((words, tuple(of_it), stored.cautions))
    if group != "posterior":
        return rows
    own = {name: _of_each(v, posterior) for name, v in posterior.variables.items() if "dataset" in v.dims}
    for dataset in stored.datasets:
        of_set = tuple(_row(stored.cautions, name, of[dataset]) for name, of in own.items())
        rows.append((dataset, of_set, stored.cautions))
    return rows


def sentences(stored: StoredPopulation, names: Names = NAMES) -> tuple[str, ...]:
    """The answer: one sentence a parameter, and what the data determine together only."""
    return tuple(_Answer(stored, names).sentences())


def _range(row: ParameterSummary) -> str:
    return text.range_words(row.q05, row.q95, row.std, row.unit)


def _median(row: ParameterSummary) -> str:
    return text.quantity(row.q50, row.std, row.unit)


@dataclass(frozen=True)
class _Answer:
    """What is said of a population, parameters by their ``names``."""

    stored: StoredPopulation
    names: Names

    def sentences(self) -> Iterator[str]:
        stored, names = self.stored, self.names
        of = dict(zip(stored.words, (rows for _, rows, _ in summaries(stored)), strict=False))
        free_of = dict(zip(stored.words, (rows for _, rows, _ in summaries(stored, "without_hyperprior")), strict=True))
        centres = of[stored.headline]
        for centre, mean, spread in zip(centres, of["mean"], of["between"], strict=True):
            yield self._centre(centre, mean, spread)
            if stored.common and not centre.untrusted:
                of_it = stored.group("posterior")[f"{centre.name}_{stored.headline}"]
                yield self._in_parts(centre, of_it, centre.std)
            if centre.name in stored.reference:
                yield self._compared(centre)
        if stored.doubted:
            words = "Counted only as far as the others bear them out, since warnings say that their readings are wrong"
            yield f"{words}: {', '.join(stored.doubted)}."
        odd = named(np.array([*stored.belongs.values()]), stored.odd_before)
        if odd:
            sets = ", ".join(stored.datasets[i] for i in odd)
            yield f"Perhaps not of the population; these numbers count them only as far as they are: {sets}."
        if "/empirical" in stored.groups:
            checked = [self._of_sets(centre) for centre in centres if not centre.untrusted]
            yield from (f"Check without a model of the population: {words}." for words in checked)
        yield from map(self._together, stored.combinations)
        if float(stored.attributes["effective_draws_without_hyperprior"]) < FEWEST:
            words = f"the data leave {stored.headline} or spread open, or lie in its tail"
            yield f"The result without the hyperprior of {stored.headline} and spread is not known: {words}."
        else:
            each = zip(free_of[stored.headline], free_of["between"], strict=True)
            ranges = "; ".join(f"{names[c.name]} {_range(c)}, spread {_range(spread)}" for c, spread in each)
            yield f"Without the hyperprior ({stored.headline} and spread equally likely everywhere): {ranges}."

    def _centre(self, centre: ParameterSummary, mean: ParameterSummary, between: ParameterSummary) -> str:
        """The population's median (its geometric mean where it is lognormal) with its interval, mean and spread."""
        stored = self.stored
        if centre.untrusted and "/empirical" in stored.groups:
            doubt = f"the draws of the population are not to be trusted ({', '.join(centre.untrusted)})"
            return f"{centre.label}: {self._of_sets(centre)}; {doubt}: see the warnings."
        spread = f"{_median(between)} ({_range(between)})"
        draws = [stored.group("posterior")[f"{centre.name}_{what}"] for what in ("mean", "between")]
        logarithmic = _logarithmic(draws[0])
        if logarithmic:
            low, middle, high = map(percent, np.quantile(draws[1].values / draws[0].values, (0.05, 0.5, 0.95)))
            spread = f"{middle} ({low} … {high})"
        geometric = logarithmic and stored.headline == "median"
        what = "median (geometric mean)" if geometric else stored.headline
        words = f"{centre.label} {self.names[centre.name]} = {_median(centre)} (5–95 %: {_range(centre)}), "
        words += f"the {what} of the population; from data set to data set it varies by {spread}"
        words += f"; its arithmetic mean is {_median(mean)} ({_range(mean)})" if geometric else ""
        if centre.untrusted:
            return f"{words}; not to be trusted: see the warnings."
        return words + (f"; the median is {centre.informed}." if centre.dfs < DETERMINED and centre.informed else ".")

    def _compared(self, centre: ParameterSummary) -> str:
        posterior = self.stored.group("posterior")[f"{centre.name}_{self.stored.headline}"]
        value, std = map(float, text.shown(posterior, self.stored.reference[centre.name]))
        source = str(self.stored.attributes.get("reference_source", ""))
        stated = text.plus_minus(value, std) if std == std else text.plain_number(value, 4)
        below = float(np.mean(text.shown(posterior) < value))
        name, unit = self.names[centre.name], text.unit_behind(centre.unit)
        words = f"reference: {name} = {stated}{unit}{f', {source}' if source else ''}"
        side, chance = ("below", below) if below > 0.5 else ("above", 1 - below)
        return f"{words}; the estimate lies {side} it with probability {chance:.2f}."

    def _in_parts(self, mean: ParameterSummary, of: Variable, std: float) -> str:
        """What the interval is made of, where data sets have anything in common."""
        stds = map(float, text.shown(of, [of.attrs["std_between"], of.attrs["std_common"]]))
        between, common = (text.quantity(part, std, mean.unit) for part in stds)
        return (
            f"Of this interval ± {between} comes from the data sets and how they differ, ± {common} from common "
            f"quantities ({self.names.of(self.stored.common)}), which more data sets do not reduce."
        )

    def _of_sets(self, centre: ParameterSummary) -> str:
        """The median over the data sets one by one, which needs no model of how they vary."""
        of = self.stored.group("empirical")[centre.name]
        low, middle, high = text.shown(of)
        std = (high - low) / 3.29
        words = (
            f"the median of {len(self.stored.datasets)} data sets one by one is {self.names[centre.name]} = "
            f"{text.quantity(middle, std, centre.unit)} (5–95 %: {text.range_words(low, high, std)}), each weighted by "
            "the share of its prior's variance that its data took away"
        )
        if doubted := self.stored.doubted:
            words += f", {' and '.join(doubted)} at a fraction of it, for warnings say that readings there are wrong"
        if centre.untrusted and self.stored.common:
            words += f". {self._in_parts(centre, of, std).removesuffix('.')}"
        return words

    def _together(self, combination: Combination) -> str:
        """What is sharp: a product of powers where all are logarithms."""
        posterior, parts = self.stored.group("posterior"), dict(combination.parts)
        names = self.names.of(parts, " and ")
        if not all(_logarithmic(posterior[f"{name}_mean"]) for name in parts):
            return f"The data determine a combination of {names} better than each of them."
        powers = ((self.names[name], text.quantity(exponent, 0.1)) for name, exponent in parts.items())
        product = " · ".join(name if power == "1.00" else f"{name}^{power}" for name, power in powers)
        return f"The data determine {product}, to {percent(combination.std)}, better than {names}."


def _logarithmic(draws: Variable) -> bool:
    return bool(draws.attrs["transform"] == "lognormal")


def population_lines(stored: StoredPopulation) -> Iterator[str]:
    yield results_table({words: rows for words, rows, _ in summaries(stored)[: len(stored.words)]})
    yield ""
    yield from sentences(stored)


def population_figure(stored: StoredPopulation) -> Captioned:
    """All data sets over the population."""
    centres = {name: stored.group("posterior")[f"{name}_{stored.headline}"] for name in stored.names}
    caption = CAPTION.format(stored.headline, "; dotted: the reference" if stored.reference else "")
    return "forest", caption, forest(stored, stored.datasets, centres, stored.reference)


def write_population(folder: Path) -> Path:
    """Write ``population.html``, ``.csv``, ``.tex`` from its file; returns the page. Raises :class:`OutputError`."""
    stored = StoredPopulation.load(folder / POPULATION)
    rows, count = summaries(stored), len(stored.words)
    write_csv(folder / "population.csv", summary_rows(rows, {}))
    write_text(folder / "population.tex", latex_table(rows))
    return write_page(
        folder,
        "population",
        [population_figure(stored)],
        stored=stored,
        sentences=sentences(stored, stored.symbols),
        population=[(words, e) for words, of_it, _ in rows[:count] for e in of_it],
        sets=[(name, e) for name, of_it, _ in rows[count:] for e in of_it],
    )
