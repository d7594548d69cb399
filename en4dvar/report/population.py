"""The page of a population: the mean, how much the data sets vary, the next one, and each given all of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import xarray as xr

from en4dvar.files import write_text
from en4dvar.population.campaign import DETERMINED, Combination
from en4dvar.population.estimate import FEWEST
from en4dvar.report.export import Found, latex_table
from en4dvar.report.html import render
from en4dvar.report.joint import forest
from en4dvar.report.style import inline_svg
from en4dvar.report.text import number_like, percent, plain_number, plus_minus, pretty_unit, shown
from en4dvar.state import Parameter
from en4dvar.storage.population_file import WORDS, StoredPopulation
from en4dvar.summary import ParameterSummary, results_table, summary_rows
from en4dvar.tables import write_csv

CAPTION = "Median and 5–95 % of each data set alone (grey) and given all (below it); band: the mean of the population."


def summaries(found: StoredPopulation, group: str = "posterior") -> list[Found]:
    """Mean, spread and the next one; of the posterior also each data set, given all of them."""
    posterior, prior = found.group(group), found.group("prior")
    rows: list[Found] = []
    for what, words in WORDS.items():
        of_it = [_row(found, name, posterior[f"{name}_{what}"], prior[f"{name}_{what}"]) for name in found.names]
        rows.append((words, tuple(of_it), found.cautions))
    if group != "posterior":
        return rows
    nothing = xr.DataArray(np.full(1, np.nan))
    for dataset in found.datasets:
        of_set = (v.sel(dataset=dataset) for v in posterior.data_vars.values() if "dataset" in v.dims)
        rows.append((dataset, tuple(_row(found, str(v.name), v, nothing) for v in of_set), found.cautions))
    return rows


def _row(found: StoredPopulation, name: str, posterior: xr.DataArray, prior: xr.DataArray) -> ParameterSummary:
    about = posterior.attrs
    p = Parameter(
        name, str(about["units"]), label=str(about["label"]), symbol=str(about["symbol"]),
        display_unit=str(about["display_units"]),
    )  # fmt: skip
    draws = shown(posterior).ravel()
    before = shown(prior).ravel() if "units" in prior.attrs else prior.values
    learned = float(about.get("learned", np.nan))
    return ParameterSummary.of(p, before, draws, float(np.median(posterior.values)), learned, found.cautions)


def sentences(found: StoredPopulation) -> tuple[str, ...]:
    """The answer: one sentence a parameter, and what the data determine together only."""
    (_, means, _), (_, spreads, _), *_ = summaries(found)
    (_, free_means, _), (_, free_spreads, _), _ = summaries(found, "without_hyperprior")
    lines = [_sentence(found, m, s) for m, s in zip(means, spreads, strict=True)]
    lines += [_together(found, one) for one in found.combinations]
    effective = float(found.tree.attrs["effective_draws_without_hyperprior"])
    if effective < FEWEST:
        words = "the data leave mean or spread open, or lie in its tail"
        return (*lines, f"What would hold without the hyperprior cannot be told from it: {words}.")
    free = (f"{m.name} {_range(m)}, spread {_range(s)}" for m, s in zip(free_means, free_spreads, strict=True))
    return (*lines, f"Without the hyperprior (mean and spread equally likely everywhere): {'; '.join(free)}.")


def _range(row: ParameterSummary) -> str:
    unit = f" {pretty_unit(row.unit)}" if row.unit != "1" else ""
    return f"{number_like(row.q05, row.std)} … {number_like(row.q95, row.std)}{unit}"


def _sentence(found: StoredPopulation, mean: ParameterSummary, between: ParameterSummary) -> str:
    unit = f" {pretty_unit(mean.unit)}" if mean.unit != "1" else ""
    if mean.untrusted:
        return f"{mean.label} {mean.name} = {plain_number(mean.mean, 3)}{unit}, not to be trusted: see the warnings."
    spread = f"{number_like(between.q50, between.std)}{unit} ({_range(between)})"
    draws = [found.group("posterior")[f"{mean.name}_{what}"] for what in ("mean", "between")]
    if _logarithmic(draws[0]):
        low, middle, high = map(percent, np.quantile(draws[1].values / draws[0].values, (0.05, 0.5, 0.95)))
        spread = f"{middle} ({low} … {high})"
    words = f"{mean.label} {mean.name} = {plus_minus(mean.mean, mean.std)}{unit} (5–95 %: {_range(mean)})"
    words += f"; from data set to data set it varies by {spread}"
    return words + (f"; its mean is {mean.informed}." if mean.dfs < DETERMINED and mean.informed else ".")


def _together(found: StoredPopulation, one: Combination) -> str:
    """What is sharp: a product of powers where all are logarithms."""
    names = " and ".join(name for name, _ in one.parts)
    if not all(_logarithmic(found.group("posterior")[f"{name}_mean"]) for name, _ in one.parts):
        return f"{names}: the data determine a combination of them, and less of each."
    powers = ((name, number_like(exponent, 0.1)) for name, exponent in one.parts)
    product = " · ".join(name if power == "1.00" else f"{name}^{power}" for name, power in powers)
    return f"{names}: the data determine {product}, to {percent(one.std)}, and less of each."


def _logarithmic(draws: xr.DataArray) -> bool:
    return bool(draws.attrs["transform"] == "lognormal")


def population_lines(found: StoredPopulation) -> Iterator[str]:
    """What the terminal shows."""
    yield results_table({words: rows for words, rows, _ in summaries(found)[: len(WORDS)]})
    yield ""
    yield from sentences(found)


def write_population(found: StoredPopulation, folder: Path) -> Path:
    """Write ``population.html``, ``.csv`` and ``.tex``. Returns the path of the page. Raises :class:`OutputError`."""
    rows = summaries(found)
    write_csv(folder / "population.csv", summary_rows(rows, {}))
    write_text(folder / "population.tex", latex_table(rows))
    posterior = found.group("posterior")
    page = render(
        "population.html.j2",
        title="Population",
        sortable=True,
        runs=str(found.tree.attrs["runs"]),
        count=len(found.datasets),
        sentences=sentences(found),
        population=rows[: len(WORDS)],
        sets=rows[len(WORDS) :],
        forest=inline_svg(
            forest(found, found.datasets, {n: posterior[f"{n}_mean"] for n in found.names}), "forest", CAPTION
        ),
        caption=CAPTION,
        attributes=found.tree.attrs,
        cautions=[(c, "") for c in found.cautions],
    )
    return write_text(folder / "population.html", page)
