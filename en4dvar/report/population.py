"""The page of a population: the mean, how much the data sets vary, the next one, and each given all of them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr

from en4dvar.estimation.population.campaign import DETERMINED, FEWEST, Combination
from en4dvar.estimation.population.hierarchy import named
from en4dvar.estimation.summary import ParameterSummary, results_table, summary_rows
from en4dvar.plumbing.files import write_text
from en4dvar.plumbing.tables import write_csv
from en4dvar.report.export import Found, latex_table
from en4dvar.report.html import write_page
from en4dvar.report.joint import NOTHING, forest
from en4dvar.report.svg import svg
from en4dvar.report.text import number_like, percent, plain_number, plus_minus, range_words, shown, unit_behind
from en4dvar.results.declared import parameter_of
from en4dvar.results.population_file import FILE, StoredPopulation, load_population

CAPTION = "Median and 5–95 % of each data set alone (grey) and given all (below it); band: the {} of the population{}."


def summaries(stored: StoredPopulation, group: str = "posterior") -> list[Found]:
    """Median, mean, spread and the next one; of the posterior also each data set, given all of them."""
    posterior, prior = stored.group(group), stored.group("prior")
    rows: list[Found] = []
    for what, words in stored.words.items():
        of_it = [_row(stored, name, posterior[f"{name}_{what}"], prior[f"{name}_{what}"]) for name in stored.names]
        rows.append((words, tuple(of_it), stored.cautions))
    if group != "posterior":
        return rows
    nothing = xr.DataArray(NOTHING)
    for dataset in stored.datasets:
        of_set = (v.sel(dataset=dataset) for v in posterior.data_vars.values() if "dataset" in v.dims)
        rows.append((dataset, tuple(_row(stored, str(v.name), v, nothing) for v in of_set), stored.cautions))
    return rows


def _row(stored: StoredPopulation, name: str, posterior: xr.DataArray, prior: xr.DataArray) -> ParameterSummary:
    before = shown(prior).ravel() if "units" in prior.attrs else prior.values
    centre, learned = float(np.median(posterior.values)), float(posterior.attrs.get("learned", np.nan))
    of = parameter_of(name, posterior.attrs)
    return ParameterSummary.of(of, before, shown(posterior).ravel(), centre, learned, stored.cautions)


def sentences(stored: StoredPopulation) -> tuple[str, ...]:
    """The answer: one sentence a parameter, and what the data determine together only."""
    of = dict(zip(stored.words, (rows for _, rows, _ in summaries(stored)), strict=False))
    free_of = dict(zip(stored.words, (rows for _, rows, _ in summaries(stored, "without_hyperprior")), strict=True))
    centres, free_centres, free_spreads = of[stored.headline], free_of[stored.headline], free_of["between"]
    lines = []
    for centre, mean, spread in zip(centres, of["mean"], of["between"], strict=True):
        lines.append(_sentence(stored, centre, mean, spread))
        if stored.common and not centre.untrusted:
            of_it = stored.group("posterior")[f"{centre.name}_{stored.headline}"]
            lines.append(_in_parts(stored, centre, of_it, centre.std))
        lines += _compared(stored, centre)
    odd = named(np.array([*stored.belongs.values()]), float(stored.tree.attrs.get("hyperprior_odd", 0)))
    if odd:
        names = ", ".join(stored.datasets[i] for i in odd)
        lines.append(f"Perhaps not of the population, and as far as not, no part of these numbers: {names}.")
    if "empirical" in stored.tree.children:
        checked = [_of_sets(stored, centre) for centre in centres if not centre.untrusted]
        lines += [f"Check without a model of the population: {words}." for words in checked]
    lines += [_together(stored, combination) for combination in stored.combinations]
    effective = float(stored.tree.attrs["effective_draws_without_hyperprior"])
    if effective < FEWEST:
        words = f"the data leave {stored.headline} or spread open, or lie in its tail"
        return (*lines, f"What would hold without the hyperprior cannot be told from it: {words}.")
    free = (f"{m.name} {_range(m)}, spread {_range(s)}" for m, s in zip(free_centres, free_spreads, strict=True))
    words = f"{stored.headline} and spread equally likely everywhere"
    return (*lines, f"Without the hyperprior ({words}): {'; '.join(free)}.")


def _range(row: ParameterSummary) -> str:
    return range_words(row.q05, row.q95, row.std, row.unit)


def _sentence(
    stored: StoredPopulation, centre: ParameterSummary, mean: ParameterSummary, between: ParameterSummary
) -> str:
    """The population's median (its geometric mean where it is lognormal) with its interval, mean and spread beside."""
    if centre.untrusted and "empirical" in stored.tree.children:
        words = f"the draws of the population are not to be trusted ({', '.join(centre.untrusted)}): see the warnings"
        return f"{centre.label}: {_of_sets(stored, centre)}; {words}."
    unit = unit_behind(centre.unit)
    spread = f"{number_like(between.q50, between.std)}{unit} ({_range(between)})"
    draws = [stored.group("posterior")[f"{centre.name}_{what}"] for what in ("mean", "between")]
    logarithmic = _logarithmic(draws[0])
    if logarithmic:
        low, middle, high = map(percent, np.quantile(draws[1].values / draws[0].values, (0.05, 0.5, 0.95)))
        spread = f"{middle} ({low} … {high})"
    what = "median (geometric mean)" if logarithmic and stored.headline == "median" else stored.headline
    words = f"{centre.label} {centre.name} = {number_like(centre.q50, centre.std)}{unit} (5–95 %: {_range(centre)}), "
    words += f"the {what} of the population; from data set to data set it varies by {spread}"
    if logarithmic and stored.headline == "median":
        words += f"; its arithmetic mean is {number_like(mean.q50, mean.std)}{unit} ({_range(mean)})"
    if centre.untrusted:
        return f"{words}; not to be trusted: see the warnings."
    return words + (f"; the median is {centre.informed}." if centre.dfs < DETERMINED and centre.informed else ".")


def _compared(stored: StoredPopulation, centre: ParameterSummary) -> Iterator[str]:
    """The value of others that the configuration gives."""
    if centre.name not in stored.reference:
        return
    posterior = stored.group("posterior")[f"{centre.name}_{stored.headline}"]
    value, std = map(float, shown(posterior, stored.reference[centre.name]))
    source = str(stored.tree.attrs.get("reference_source", ""))
    stated = plus_minus(value, std) if std == std else plain_number(value, 4)
    below = float(np.mean(shown(posterior) < value))
    words = f"reference: {centre.name} = {stated}{unit_behind(centre.unit)}{f', {source}' if source else ''}"
    side, chance = ("below", below) if below > 0.5 else ("above", 1 - below)
    yield f"{words}; the estimate lies {side} it with probability {chance:.2f}."


def _in_parts(stored: StoredPopulation, mean: ParameterSummary, of: xr.DataArray, std: float) -> str:
    """What the interval is made of, where data sets have anything in common."""
    between, common = map(float, shown(of, [of.attrs["std_between"], of.attrs["std_common"]]))
    unit, shared = unit_behind(mean.unit), ", ".join(stored.common)
    return (
        f"Of it ± {number_like(between, std)}{unit} is from the data sets and how they differ, and ± "
        f"{number_like(common, std)}{unit} from what they have in common ({shared}), which more of them do not reduce."
    )


def _of_sets(stored: StoredPopulation, centre: ParameterSummary) -> str:
    """The median over the data sets one by one, which needs no model of how they vary."""
    of = stored.group("empirical")[centre.name]
    low, middle, high = shown(of)
    std = (high - low) / 3.29
    words = (
        f"the median of {len(stored.datasets)} data sets one by one is {centre.name} = "
        f"{number_like(middle, std)}{unit_behind(centre.unit)} (5–95 %: {range_words(low, high, std)}), where each "
        "counts by the share of its prior's variance that its data took away"
    )
    parts = _in_parts(stored, centre, of, std).removesuffix(".") if centre.untrusted and stored.common else ""
    return f"{words}. {parts}" if parts else words


def _together(stored: StoredPopulation, combination: Combination) -> str:
    """What is sharp: a product of powers where all are logarithms."""
    names = " and ".join(name for name, _ in combination.parts)
    if not all(_logarithmic(stored.group("posterior")[f"{name}_mean"]) for name, _ in combination.parts):
        return f"{names}: the data determine a combination of them, and less of each."
    powers = ((name, number_like(exponent, 0.1)) for name, exponent in combination.parts)
    product = " · ".join(name if power == "1.00" else f"{name}^{power}" for name, power in powers)
    return f"{names}: the data determine {product}, to {percent(combination.std)}, and less of each."


def _logarithmic(draws: xr.DataArray) -> bool:
    return bool(draws.attrs["transform"] == "lognormal")


def population_lines(stored: StoredPopulation) -> Iterator[str]:
    """What the terminal shows."""
    yield results_table({words: rows for words, rows, _ in summaries(stored)[: len(stored.words)]})
    yield ""
    yield from sentences(stored)


def figure(stored: StoredPopulation) -> str:
    """All data sets over the population, as SVG."""
    posterior = stored.group("posterior")
    centres = {name: posterior[f"{name}_{stored.headline}"] for name in stored.names}
    return svg(forest(stored, stored.datasets, centres, stored.reference), "forest", caption(stored))


def caption(stored: StoredPopulation) -> str:
    """Of the figure."""
    return CAPTION.format(stored.headline, "; dotted: the reference" if stored.reference else "")


def write_population(folder: Path) -> Path:
    """Write ``population.html``, ``.csv`` and ``.tex`` from ``population.nc``; returns the path of the page.

    Raises :class:`OutputError`.
    """
    stored = load_population(folder / FILE)
    rows = summaries(stored)
    write_csv(folder / "population.csv", summary_rows(rows, {}))
    write_text(folder / "population.tex", latex_table(rows))
    return write_page(
        folder / "population.html",
        "population.html.j2",
        stored=stored,
        sentences=sentences(stored),
        population=rows[: len(stored.words)],
        sets=rows[len(stored.words) :],
        forest=figure(stored),
        caption=caption(stored),
    )
