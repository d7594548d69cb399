"""The page of a population: the mean, how much the data sets vary, the next one, and each given all of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr

from en4dvar.estimation.population.campaign import DETERMINED, Combination
from en4dvar.estimation.population.estimate import FEWEST
from en4dvar.estimation.summary import ParameterSummary, results_table, summary_rows
from en4dvar.model.state import Parameter
from en4dvar.plumbing.files import write_text
from en4dvar.plumbing.tables import write_csv
from en4dvar.plumbing.units import convert
from en4dvar.report.export import Found, latex_table
from en4dvar.report.html import render
from en4dvar.report.joint import forest
from en4dvar.report.svg import svg
from en4dvar.report.text import number_like, percent, plain_number, plus_minus, pretty_unit, shown
from en4dvar.results.population_file import WORDS, StoredPopulation

CAPTION = "Median and 5–95 % of each data set alone (grey) and given all (below it); band: the mean of the population."


def summaries(stored: StoredPopulation, group: str = "posterior") -> list[Found]:
    """Mean, spread and the next one; of the posterior also each data set, given all of them."""
    posterior, prior = stored.group(group), stored.group("prior")
    rows: list[Found] = []
    for what, words in WORDS.items():
        of_it = [_row(stored, name, posterior[f"{name}_{what}"], prior[f"{name}_{what}"]) for name in stored.names]
        rows.append((words, tuple(of_it), stored.cautions))
    if group != "posterior":
        return rows
    nothing = xr.DataArray(np.full(1, np.nan))
    for dataset in stored.datasets:
        of_set = (v.sel(dataset=dataset) for v in posterior.data_vars.values() if "dataset" in v.dims)
        rows.append((dataset, tuple(_row(stored, str(v.name), v, nothing) for v in of_set), stored.cautions))
    return rows


def _row(stored: StoredPopulation, name: str, posterior: xr.DataArray, prior: xr.DataArray) -> ParameterSummary:
    about = posterior.attrs
    p = Parameter(
        name, str(about["units"]), label=str(about["label"]), symbol=str(about["symbol"]),
        display_unit=str(about["display_units"]),
    )  # fmt: skip
    draws = shown(posterior).ravel()
    before = shown(prior).ravel() if "units" in prior.attrs else prior.values
    learned = float(about.get("learned", np.nan))
    return ParameterSummary.of(p, before, draws, float(np.median(posterior.values)), learned, stored.cautions)


def sentences(stored: StoredPopulation) -> tuple[str, ...]:
    """The answer: one sentence a parameter, and what the data determine together only."""
    (_, means, _), (_, spreads, _), *_ = summaries(stored)
    (_, free_means, _), (_, free_spreads, _), _ = summaries(stored, "without_hyperprior")
    lines = []
    for mean, spread in zip(means, spreads, strict=True):
        lines += [_sentence(stored, mean, spread), *_parts(stored, mean)]
    lines += [_one_by_one(stored, mean) for mean in means if "empirical" in stored.tree.children]
    lines += [_together(stored, combination) for combination in stored.combinations]
    effective = float(stored.tree.attrs["effective_draws_without_hyperprior"])
    if effective < FEWEST:
        words = "the data leave mean or spread open, or lie in its tail"
        return (*lines, f"What would hold without the hyperprior cannot be told from it: {words}.")
    free = (f"{m.name} {_range(m)}, spread {_range(s)}" for m, s in zip(free_means, free_spreads, strict=True))
    return (*lines, f"Without the hyperprior (mean and spread equally likely everywhere): {'; '.join(free)}.")


def _range(row: ParameterSummary) -> str:
    unit = f" {pretty_unit(row.unit)}" if row.unit != "1" else ""
    return f"{number_like(row.q05, row.std)} … {number_like(row.q95, row.std)}{unit}"


def _sentence(stored: StoredPopulation, mean: ParameterSummary, between: ParameterSummary) -> str:
    unit = f" {pretty_unit(mean.unit)}" if mean.unit != "1" else ""
    if mean.untrusted:
        return f"{mean.label} {mean.name} = {plain_number(mean.mean, 3)}{unit}, not to be trusted: see the warnings."
    spread = f"{number_like(between.q50, between.std)}{unit} ({_range(between)})"
    draws = [stored.group("posterior")[f"{mean.name}_{what}"] for what in ("mean", "between")]
    if _logarithmic(draws[0]):
        low, middle, high = map(percent, np.quantile(draws[1].values / draws[0].values, (0.05, 0.5, 0.95)))
        spread = f"{middle} ({low} … {high})"
    words = f"{mean.label} {mean.name} = {plus_minus(mean.mean, mean.std)}{unit} (5–95 %: {_range(mean)})"
    words += f"; from data set to data set it varies by {spread}"
    return words + (f"; its mean is {mean.informed}." if mean.dfs < DETERMINED and mean.informed else ".")


def _parts(stored: StoredPopulation, mean: ParameterSummary) -> Iterator[str]:
    """What the interval of a mean is made of, where data sets have anything in common."""
    if stored.common and not mean.untrusted:
        yield _in_parts(stored, mean, stored.group("posterior")[f"{mean.name}_mean"], mean.std)


def _in_parts(stored: StoredPopulation, mean: ParameterSummary, of: xr.DataArray, std: float) -> str:
    about = of.attrs
    between, common = (
        float(convert(about[key], str(about["units"]), mean.unit)) for key in ("std_between", "std_common")
    )
    unit = f" {pretty_unit(mean.unit)}" if mean.unit != "1" else ""
    shared = ", ".join(stored.common)
    return (
        f"Of it ± {number_like(between, std)}{unit} is from the data sets and how they differ, and ± "
        f"{number_like(common, std)}{unit} from what they have in common ({shared}), which more of them do not reduce."
    )


def _one_by_one(stored: StoredPopulation, mean: ParameterSummary) -> str:
    """The median over the data sets, which needs no model of how they vary."""
    of = stored.group("empirical")[mean.name]
    low, middle, high = map(float, convert(of.values, str(of.attrs["units"]), mean.unit))
    std, unit = (high - low) / 3.29, f" {pretty_unit(mean.unit)}" if mean.unit != "1" else ""
    words = (
        f"Check without a model of the population: the median of {len(stored.datasets)} data sets one by one is "
        f"{mean.name} = {number_like(middle, std)}{unit} (5–95 %: {number_like(low, std)} … {number_like(high, std)})."
    )
    return f"{words} {_in_parts(stored, mean, of, std)}" if mean.untrusted and stored.common else words


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
    yield results_table({words: rows for words, rows, _ in summaries(stored)[: len(WORDS)]})
    yield ""
    yield from sentences(stored)


def write_population(stored: StoredPopulation, folder: Path) -> Path:
    """Write ``population.html``, ``.csv`` and ``.tex``. Returns the path of the page. Raises :class:`OutputError`."""
    rows = summaries(stored)
    write_csv(folder / "population.csv", summary_rows(rows, {}))
    write_text(folder / "population.tex", latex_table(rows))
    posterior = stored.group("posterior")
    page = render(
        "population.html.j2",
        title="Population",
        sortable=True,
        charts=True,
        runs=str(stored.tree.attrs["runs"]),
        count=len(stored.datasets),
        sentences=sentences(stored),
        population=rows[: len(WORDS)],
        sets=rows[len(WORDS) :],
        forest=svg(
            forest(stored, stored.datasets, {n: posterior[f"{n}_mean"] for n in stored.names}), "forest", CAPTION
        ),
        caption=CAPTION,
        belongs=list(stored.belongs.items()),
        attributes=stored.tree.attrs,
        cautions=[(c, "") for c in stored.cautions],
    )
    return write_text(folder / "population.html", page)
