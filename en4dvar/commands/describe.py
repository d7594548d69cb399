"""Plain-text tables for the terminal: what would be estimated, and what was."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from en4dvar.config import Config
from en4dvar.data.series import Part
from en4dvar.descent.preview import Preview
from en4dvar.model.state import Parameter
from en4dvar.plumbing.hints import counted, duration, rounded
from en4dvar.plumbing.tables import table
from en4dvar.plumbing.units import convert, unit_after
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.problem import InverseProblem
from en4dvar.sampling.refine import may_sample, runs_of_doubt

MOST_PAIRS, MOST_NAMED, LEAST_SHOWN = 15, 100, 0.005  # of correlations: rows, parameters of a block, size


def problem_summary(config: Config, problems: Sequence[InverseProblem]) -> str:
    """The lines that ``validate`` prints: data sets, priors (centre and 5–95 %), fixed values, scheme."""
    first = problems[0]
    settings = config.assimilation
    rows = [_series_row(problem, part) for problem in problems for part in problem.parts]
    cells = sum(prior.field.size for prior in first.fields)
    and_cells = f" and {cells} cells of fields" if cells else ""
    parts = [
        f"{config.name}: {counted(len(first.prior.names), 'parameter')}{and_cells} from "
        f"{counted(len(problems), 'data set')} with {settings.scheme}, {counted(settings.members, 'member')}, "
        f"weights {config.weights}, seed {config.seed}",
        table([("data set", "observations", "window", "maximum", "error std"), *rows]),
    ]
    parts.append(_together(problems, ("estimated", "unit", "prior", "median", "5 %", "95 %"), _prior_rows))
    if first.fields:
        parts.append(table([("field", "cells", "std", "correlation"), *map(_field_row, first.fields)]))
    if correlated := _correlation_rows(first):
        parts.append(table([("correlated in the prior", "correlation"), *correlated]))
    if first.tied:
        rows = [(tie.parameter.name, tie.to, f"{tie.factor:g}") for tie in first.tied]
        parts.append(table([("tied", "to", "times"), *rows]))
    if first.fixed:
        known = {p.parameter.name: p.parameter for p in config.parameters}

        def fixed(problem: InverseProblem) -> list[tuple[str, ...]]:
            return [(name, *_shown(known[name], value)) for name, value in problem.fixed.items()]

        parts.append(_together(problems, ("fixed", "value", "unit"), fixed))
    parts.append(f"run directory: {config.directory}")
    return "\n\n".join(parts)


def _together(
    problems: Sequence[InverseProblem], header: tuple[str, ...], rows: Callable[[InverseProblem], list[tuple[str, ...]]]
) -> str:
    """One table for all data sets: a row a parameter, or a row each where a value comes from the data."""
    groups: dict[str, dict[str, tuple[str, ...]]] = {}
    for problem in problems:
        for name, *row in rows(problem):
            groups.setdefault(name, {})[problem.observations.name] = tuple(row)
    if len(problems) == 1:
        return table([header, *rows(problems[0])])
    lines: list[tuple[str, ...]] = []
    for name, each in groups.items():
        same = len(each) == len(problems) and len(set(each.values())) == 1
        shown = {"all": next(iter(each.values()))} if same else each
        lines += [(name, dataset, *row) for dataset, row in shown.items()]
    return table([(header[0], "data set", *header[1:]), *lines])


def _field_row(prior: FieldPrior) -> tuple[str, ...]:
    std = f"{100 * prior.std:g} %" if prior.relative else f"{prior.std:g} {prior.field.unit}"
    kernel = f"{prior.kernel}, length {prior.length:g} {prior.field.coordinate_unit}"
    return prior.field.name, str(prior.field.size), std, kernel


def cost_summary(config: Config, preview: Preview, count: int) -> str:
    """The cost of an estimate: forward runs of a data set and of all ``count``, and the time on one thread."""
    settings, least = config.assimilation, preview.runs
    most, more = least, "; the Markov chain comes on top" if settings.refine == "mcmc" else ""
    if may_sample(preview.problem, settings):
        most += runs_of_doubt(preview.problem, settings)
        most += least * len(preview.problem.alternatives) if settings.what_if else 0
        more = "; the most where a doubt is sampled, and minima that are hard to find can take twice as many"

    def span(words: Callable[[float], str], times: float) -> str:
        return " to ".join(dict.fromkeys(words(runs * times) for runs in (least, most)))

    a_set, in_all = (" a data set", f"; in all {span(rounded, count)},") if count > 1 else ("", ":")
    runs = f"about {span(rounded, 1)} forward runs{a_set}, {duration(preview.seconds)} each{in_all}"
    took = f"{span(duration, count * preview.seconds)} on one thread"
    return f"cost: {runs} {took}, plus up to some seconds a data set for all else{more}"


def _series_row(problem: InverseProblem, part: Part) -> tuple[str, ...]:
    y, own, model, observable = problem.observations, part.where, problem.model, part.observable
    name = y.name if len(problem.parts) == 1 else f"{y.name}: {part.name}"
    start, end = (convert(float(t), model.time_unit, model.time_display_unit) for t in y.file_times[own][[0, -1]])
    stated = y.values[own].max(), np.median(y.std[own])
    top, std = (convert(float(v), observable.unit, observable.display_unit) for v in stated)
    timing = convert(float(np.median(y.noise.time_std[own])), model.time_unit, model.time_display_unit)
    clock, unit = unit_after(model.time_display_unit), unit_after(observable.display_unit)
    also = f", {timing:.3g}{clock} in time" if timing else ""
    also += y.noise.words
    window = f"{start:.6g} to {end:.6g}{clock}"
    count = str(part.end - part.begin)
    if y.continued is not None:
        count += f", then {len(y.continued) - len(y)} to predict"
    return name, count, window, f"{top:.4g}{unit}", f"{std:.3g}{unit}{also}"


def _prior_rows(problem: InverseProblem) -> list[tuple[str, ...]]:
    rows = []
    for term in problem.prior.terms:
        quantiles = term.to_physical(term.mean + term.std * np.array([0.0, -1.6448536, 1.6448536]))
        shown = [_shown(term.parameter, float(q))[0] for q in quantiles]
        rows.append((term.parameter.name, term.parameter.display_unit, term.transform, *shown))
    return rows


def _correlation_rows(problem: InverseProblem) -> list[tuple[str, ...]]:
    pairs = [
        (block.matrix[i, j], f"{block.names[i]}, {block.names[j]}")
        for block in problem.prior.blocks
        for i, j in itertools.combinations(range(min(len(block.names), MOST_NAMED)), 2)
    ]
    strongest = sorted(pairs, key=lambda pair: -abs(pair[0]))[:MOST_PAIRS]
    return [(names, f"{value:.2f}") for value, names in strongest if abs(value) >= LEAST_SHOWN]


def _shown(parameter: Parameter, value: float) -> tuple[str, str]:
    return f"{convert(value, parameter.unit, parameter.display_unit):.4g}", parameter.display_unit
