"""Populations side by side, of several runs or of groups of the data sets of one, such as two materials: is one median
larger than another, by how much, how surely, and its trend.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from en4dvar.config.dependence import reference_value
from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.estimation.population.contrast import Centre, StraightLine, drawn_together, line, without_pull
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.caution import untrusted
from en4dvar.plumbing.errors import OutputError, retold
from en4dvar.plumbing.files import make_folder
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.tables import table, write_csv
from en4dvar.plumbing.units import UnitError, convert, is_unit
from en4dvar.priors.prior import PriorTerm
from en4dvar.report.chart import POINTS, Chart, Panel, in_columns
from en4dvar.report.compare import named
from en4dvar.report.html import write_page
from en4dvar.report.paper import on_paper
from en4dvar.report.text import figure_text, number_like, plain_number, plus_minus, range_words, unit_behind, with_unit
from en4dvar.results.declared import NAMES, Names
from en4dvar.results.netcdf import understood
from en4dvar.results.together import POPULATION, QUANTILES, StoredPopulation, load_population

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Values = Mapping[str, tuple[float, float]]  # parameter → value and std
SURE = 0.999  # no number of draws says more
FAR, TOO_FAR = 2.5, 4.0  # standard deviations between what is known and what the data say: told, and not believed
_NUMBER = re.compile(r"(?<![^\W_])(?<!\.)(\d+(?:\.\d+)?)[ _]?(%|[^\W\d_]+)(?![^\W_])")  # with a unit, in a name
OFF_THE_LINE = 0.05  # probability below which populations differ by more than a line says
CAPTION = (
    "Median and 5–95 % of each population's {}: the numbers to quote. Ratios are in the sentences. Orange ring "
    "without a bar: not to be trusted, because of the warnings of the population."
)


@dataclass(frozen=True)
class Difference:
    """The median of one parameter in ``first`` against that in ``second``: 5, 50 and 95 % of their ratio (NaN where the
    prior allows values of both signs) and of their difference in ``unit``; ``greater``: probability that the first is.

    ``apart`` (3,): the quantiles of ratio or difference if nothing were common. ``untrusted``: codes of warnings.
    """

    parameter: str
    first: str
    second: str
    unit: str
    ratio: tuple[float, float, float]
    difference: tuple[float, float, float]
    greater: float
    apart: tuple[float, float, float]
    untrusted: str = ""

    @property
    def is_ratio(self) -> bool:
        return bool(np.isfinite(self.ratio[1]))


@dataclass(frozen=True)
class PopulationsCompared:
    """By parameter, ``medians``: draws (M, K) in its display unit, of all populations together; ``lines``: the straight
    line of them, of their logarithm where it is in ``logarithmic``, against a number of each population; ``quoted``:
    5, 50 and 95 % (3, K) of the median of each population by itself, or, where ``calibrated`` by what is known of some
    of them, of ``medians``; ``doubted``: the populations in which it is not to be trusted. ``common``: quantities with
    one value in several populations; ``notes``: what else has to be known; ``symbols``: how a page writes the names.
    """

    populations: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    medians: Mapping[str, Array]
    quoted: Mapping[str, Array]
    differences: tuple[Difference, ...]
    common: tuple[str, ...]
    notes: tuple[str, ...] = ()
    lines: Mapping[str, StraightLine] = field(default_factory=dict)
    logarithmic: frozenset[str] = frozenset()
    calibrated: bool = False
    doubted: Mapping[str, Collection[str]] = field(default_factory=dict)
    symbols: Names = field(default_factory=Names)

    @property
    def caption(self) -> str:
        """Of the figure."""
        return CAPTION.format("median, calibrated by what is known of some" if self.calibrated else "own median")

    def plot(self) -> Figure:
        """The median of each population with its interval, a panel a parameter."""
        return on_paper(figure(self))

    def __str__(self) -> str:
        return "\n".join(sentences(self))


def compare_populations(
    runs: Sequence[str | Path] | Mapping[str, str | Path],
    numbers: Sequence[float] = (),
    apart: Sequence[str] = (),
    seed: int = 1,
    known: Mapping[str, Mapping[str, str]] | None = None,
) -> PopulationsCompared:
    """Compare the populations behind runs, e.g. of two materials; ``runs``: folders, or name → folder.

    Quantities that are common to the data sets of each population, of the same name and prior, have one value in all
    populations, but for those named ``apart``. ``numbers``: of each run one, e.g. a concentration, that the medians are
    seen as a straight line of. ``known``: of a run medians that are known from elsewhere, {"G": "9.8 ± 0.3 kPa"},
    which calibrate what is common; they go before those of its configuration. One that is :data:`TOO_FAR` from what
    its own data say calibrates nothing. ``seed``: of the draws that a difference, a line and their intervals are of.

    Raises :class:`OutputError`: fewer than two, no population in a folder or one of an earlier version, no parameter of
    all of them, data sets that two of them hold, not a number for each or all the same, a name that nothing common has;
    what is known of no run or no parameter, or is no value with a standard deviation.
    """
    stored = {name: _stored(Path(run)) for name, run in named(runs).items()}
    return _compared(stored, numbers, apart, seed, known)


def _compared(
    stored: Mapping[str, StoredPopulation], numbers: Sequence[float], apart: Sequence[str] = (), seed: int = 1,
    known: Mapping[str, Mapping[str, str]] | None = None,
) -> PopulationsCompared:  # fmt: skip
    names = [n for n in next(iter(stored.values())).names if all(n in s.names for s in stored.values())]
    if not names:
        raise OutputError("compare: the populations have no parameter in common")
    if words := same_readings(stored):
        raise OutputError(f"compare: {words}")
    if numbers and (len(numbers) != len(stored) or np.ptp(numbers) == 0 or not np.isfinite(numbers).all()):
        raise OutputError(f"compare: {len(stored)} numbers are needed, one for each run and not all the same")
    values = _known_medians(stored, known or {})
    off = {label: {name: _off(name, s, values[label][name]) for name in values[label]} for label, s in stored.items()}
    used = {label: {n: v for n, v in of_it.items() if off[label][n] <= TOO_FAR} for label, of_it in values.items()}
    keys = {name: _common(s, apart, name) for name, s in stored.items()}
    every = [key for of_one in keys.values() for key in of_one]
    common = tuple(dict.fromkeys(key[0] for key in every if every.count(key) > 1))
    every_common = tuple(dict.fromkeys(n for s in stored.values() for n in s.common))
    if unknown := [name for name in apart if name not in every_common]:
        hint = suggest(unknown[0], every_common)
        raise OutputError(f"compare: {unknown[0]}: not common to the data sets of any population{hint}")
    terms = {name: [s.prior_of(name) for s in stored.values()] for name in names}
    logarithmic = frozenset(name for name in names if all(t.transform == "lognormal" for t in terms[name]))
    medians, quoted, calibrated = dict[str, Array](), dict[str, Array](), any(used.values())
    lines: dict[str, StraightLine] = {}
    differences, notes = [], []
    if own := [name for name in every_common if name not in (*common, *apart)]:
        notes.append(f"{', '.join(own)}: of one population alone, or with other priors: taken as each population's own")
    for name in names:
        centres = {label: _centre(name, s, keys[label], seed, used[label]) for label, s in stored.items()}
        alone = [replace(c, common=tuple((label, key) for key in c.common)) for label, c in centres.items()]
        medians[name] = _physical(drawn_together([*centres.values()], seed), terms[name])
        each = medians[name].T if calibrated else [_own(s, name) for s in stored.values()]
        quoted[name] = np.transpose([_three(draws) for draws in each])
        independent = _physical(drawn_together(alone, seed), terms[name])
        for (i, a), (j, b) in combinations(enumerate(stored), 2):
            doubts = dict.fromkeys((*untrusted(stored[a].cautions, name), *untrusted(stored[b].cautions, name)))
            (x, y), (own_x, own_y) = medians[name][:, [i, j]].T, independent[:, [i, j]].T
            ratio, by_itself = (np.nan,) * 3, _three(own_x - own_y)
            if name in logarithmic:
                ratio, by_itself = _three(x / y), _three(own_x / own_y)
            unit, more = terms[name][0].parameter.display_unit, _three(x - y)
            greater = float(np.mean(x > y))
            differences.append(Difference(name, a, b, unit, ratio, more, greater, by_itself, " ".join(doubts)))
        notes += _calibrated(name, stored, values, off, medians[name], independent if common else None)
        if held := [label for label, c in centres.items() if c.pulled]:
            notes.append(f"{name}: the data of {', '.join(held)} leave its median open: the hyperprior holds it")
        if numbers:
            of_it = np.log(medians[name]) if name in logarithmic else medians[name]
            lines[name] = line(of_it, np.asarray(numbers, dtype=float))
    parameters = {name: terms[name][0].parameter for name in names}
    doubted = {name: [label for label, s in stored.items() if untrusted(s.cautions, name)] for name in names}
    return PopulationsCompared(
        tuple(stored), parameters, medians, quoted, tuple(differences), common, tuple(notes), lines, logarithmic,
        calibrated, doubted, Names(chain.from_iterable(s.symbols.items() for s in stored.values())),
    )  # fmt: skip


def _own(s: StoredPopulation, name: str) -> Array:
    """Draws (M,) of the median of a population by itself, in the display unit."""
    parameter = s.prior_of(name).parameter
    draws = s.group("posterior")[f"{name}_{s.headline}"].values.ravel()
    return convert(draws, parameter.unit, parameter.display_unit)


def _physical(white: Array, terms: Sequence[PriorTerm]) -> Array:
    """Draws (M, K) in the display unit of the first."""
    p = terms[0].parameter
    columns = [t.to_physical(t.mean + t.std * white[:, k]) for k, t in enumerate(terms)]
    return np.stack([convert(column, p.unit, p.display_unit) for column in columns], axis=1)


def same_readings(stored: Mapping[str, StoredPopulation]) -> str:
    """Why populations are not independent; "" where they are."""
    for (a, first), (b, second) in combinations(stored.items(), 2):
        if both := sorted(first.readings[key] for key in first.readings.keys() & second.readings.keys()):
            which = f"{a} and {b} hold the same readings ({', '.join(both[:3])})"
            return f"{which}: what differs between them is the model and not what was measured"
    return ""


def _centre(name: str, s: StoredPopulation, keys: tuple[tuple[str, str], ...], seed: int, values: Values) -> Centre:
    nu = np.stack([s.white(n) for n in s.names], axis=1)
    theta = np.stack([s.white(n) for n in s.common], axis=1) if s.common else np.empty((len(nu), 0))
    attributes = s.attributes
    return without_pull(
        s.names.index(name), nu, theta, keys, float(attributes["hyperprior_mean_std"]),
        float(attributes["effective_draws"]), seed, [*_known(s, values)], s.prior_of(name).log_std,
    )  # fmt: skip


def _known_medians(
    stored: Mapping[str, StoredPopulation], known: Mapping[str, Mapping[str, str]]
) -> Mapping[str, Values]:
    """Of each population value and std of what is known from elsewhere, in the parameters' units."""
    values = {label: dict(s.known) for label, s in stored.items()}
    for label, texts in known.items():
        if label not in stored:
            raise OutputError(f"compare: {label}, of which something is known: no such run{suggest(label, stored)}")
        for name, text in texts.items():
            if name not in stored[label].names:
                hint = suggest(name, stored[label].names)
                raise OutputError(f"compare: {name}: not a parameter of the population of {label}{hint}")
            with retold(UnitError, OutputError, f"compare: {name} of {label}: "):
                value, std = reference_value(text, stored[label].prior_of(name).parameter.unit)
            if not std > 0:
                raise OutputError(f"compare: {name} of {label}: say how well it is known, such as '9.8 ± 0.3 kPa'")
            values[label][name] = value, std
    return values


def _known(s: StoredPopulation, values: Values) -> Iterator[tuple[int, float, float]]:
    """Column of each centre that is known from elsewhere, its value and std in units of its prior."""
    for name, (value, std) in values.items():
        term = s.prior_of(name)
        with retold(ValueError, OutputError, f"{name}, known to be {value:g}: "):
            x = float(term.from_physical(np.array([value]))[0])
        yield s.names.index(name), (x - term.mean) / term.std, std / abs(term.slope(x)) / term.std


def _off(name: str, s: StoredPopulation, value: tuple[float, float]) -> float:
    """How far a ``value`` with its std is from what the data say, in standard deviations of both, transformed."""
    ((_, known, std),) = _known(s, {name: value})
    own = s.white(name)
    return float(abs(known - np.median(own)) / np.hypot(own.std(), std))


def _calibrated(
    name: str, stored: Mapping[str, StoredPopulation], values: Mapping[str, Values],
    off: Mapping[str, Mapping[str, float]], median: Array, alone: Array | None,
) -> Iterator[str]:  # fmt: skip
    """What groups that are known from elsewhere, ``off`` from their own data, do to the median (M, K) of a parameter in
    the others; ``alone``: the same were nothing common, None where nothing is.
    """
    known = [label for label, of_it in off.items() if any(by <= TOO_FAR for by in of_it.values())]
    for k, (label, s) in enumerate(stored.items()):
        parameter = s.prior_of(name).parameter
        unit = unit_behind(parameter.display_unit)
        if name in values[label]:
            value, std = (convert(number, parameter.unit, parameter.display_unit) for number in values[label][name])
            by = off[label][name]
            words = f"{name} of {label} is known, {plus_minus(value, std)}{unit}"
            words += f"; its own data say otherwise, {by:.1f} std away" if by > FAR else ""
            yield words + (": it calibrates nothing (is its unit right?)" if by > TOO_FAR else "")
            if alone is None and by <= TOO_FAR:
                yield "Nothing is common to the groups that this could calibrate"
        elif known and alone is not None and label not in known:
            now, before = (_range(_three(draws[:, k]), plain=True) for draws in (median, alone))
            yield f"{name} of {label} is {now}{unit}, calibrated by {', '.join(known)}; without, {before}{unit}"


def _three(values: Array) -> tuple[float, float, float]:
    low, middle, high = map(float, member_quantiles(values, QUANTILES))
    return low, middle, high


def _stored(folder: Path) -> StoredPopulation:
    path = folder / POPULATION
    if not path.is_file():
        raise OutputError(
            f"{folder}: holds no population; a run whose configuration has 'population:' ends with one, 'en4dvar "
            "population' makes one of finished runs"
        )
    return _whole(path, load_population(path))


def _whole(path: Path, stored: StoredPopulation) -> StoredPopulation:
    """With everything that a comparison takes. Raises :class:`OutputError`."""
    with understood(path):
        if "/white" not in stored.groups:
            raise OutputError(f"{path}: written by an earlier version of en4dvar; make it again to compare it")
        for name in (*stored.names, *stored.common):
            _ = stored.white(name), stored.prior_of(name)
    return stored


def _common(s: StoredPopulation, apart: Sequence[str], label: str) -> tuple[tuple[str, str], ...]:
    """Of each common quantity what makes it the same in two populations."""
    priors = {name: str(s.group("white")[name].attrs["prior"]) for name in s.common}
    return tuple((name, label if name in apart else prior) for name, prior in priors.items())


def sentences(c: PopulationsCompared, names: Names = NAMES) -> Iterator[str]:
    """The answer: one sentence a pair and parameter, one a line, and what is taken to be common."""
    for d in c.differences:
        yield _sentence(d, names)
    for name, of_it in c.lines.items():
        yield f"{names[name]} {_line_words(c, name, of_it)}"
    if c.common:
        yield f"These have one value in all of them and cancel as far as they move all alike: {names.of(c.common)}."
    if not c.calibrated:
        yield (
            "For a single population quote its own median. Ratios and differences use all data, without the pull "
            "of the hyperpriors on the medians unless a note says so; they need not be those of the single medians."
        )
    for note in c.notes:
        name = re.split("[ :]", note, maxsplit=1)[0]  # most notes begin with the parameter that they are about
        yield f"{names[name]}{note.removeprefix(name)}."


def _sentence(d: Difference, names: Names = NAMES) -> str:
    low, middle, high = d.difference
    by, more = (d.difference, "more") if middle >= 0 else ((-high, -middle, -low), "less")
    difference = f"{_range(by, plain=True)}{unit_behind(d.unit)} {more}"
    sure, side = (d.greater, "larger") if d.greater >= 0.5 else (1 - d.greater, "smaller")
    chance = f"over {SURE}" if sure > SURE else f"{sure:.3f}" if sure > 0.99 else f"{sure:.2f}"
    if d.is_ratio:
        words = f"{names[d.parameter]} of {d.first} is {_range(d.ratio)} times that of {d.second}, and {difference}"
    else:
        words = f"{names[d.parameter]} of {d.first} is {difference} than that of {d.second}"
    words += f"; it is {side} with probability {chance}"
    alone = range_words(d.apart[0], d.apart[2], _std(d.apart), "1" if d.is_ratio else d.unit)
    words += f" (were nothing common: {alone}{' times' * d.is_ratio})"
    return f"{words}; not to be trusted: {d.untrusted.replace(' ', ', ')}." if d.untrusted else f"{words}."


def _line_words(c: PopulationsCompared, name: str, of_it: StraightLine) -> str:
    unit = unit_behind(c.parameters[name].display_unit)
    slope = _three(np.exp(of_it.slope) if name in c.logarithmic else of_it.slope)
    rising = np.clip(np.mean(of_it.slope > 0), 1 - SURE, SURE)
    by = f"a factor of {_range(slope)}" if name in c.logarithmic else f"{_range(slope)}{unit}"
    words = f"grows by {by} for each unit of the number; it rises with probability {rising:.3f}"
    if of_it.chance < OFF_THE_LINE:
        chi = plain_number(of_it.misfit, 2)
        return f"{words}; they do not lie on a line (χ² {chi} of {of_it.freedom}), for which the interval is widened."
    return f"{words}."


def _std(three: Sequence[float]) -> float:
    return (three[2] - three[0]) / 3.29


def _range(three: tuple[float, float, float], plain: bool = False) -> str:
    low, middle, high = three
    between = range_words(low, high, _std(three))
    return f"{number_like(middle, _std(three))} ({between if plain else f'5–95 %: {between}'})"


def medians_table(c: PopulationsCompared) -> str:
    """What the terminal shows: the median to quote of each parameter in each population."""
    rows: list[tuple[str, ...]] = [("population", "parameter", "unit", "5 %", "50 %", "95 %")]
    for name, quantiles in c.quoted.items():
        for label, three in zip(c.populations, quantiles.T, strict=True):
            cells = (number_like(value, _std(three)).replace("−", "-") for value in three)
            rows.append((label, name, c.parameters[name].display_unit, *cells))
    return table(rows)


def figure(c: PopulationsCompared) -> Chart:
    panels = []
    for name, (low, middle, high) in c.quoted.items():
        p, places = c.parameters[name], -np.arange(float(len(c.populations)))
        panel = Panel(with_unit(p.symbol, p.display_unit), ylim=(-float(len(places)), 1.0))
        panel.yticks, panel.y_names = [*places], [figure_text(label) for label in c.populations]
        doubted = np.isin(c.populations, [*c.doubted.get(name, ())])
        panel.intervals(low[~doubted], high[~doubted], places[~doubted], "posterior")
        panel.dots(middle[~doubted], places[~doubted], "posterior", 3.0)
        panel.dots(middle[doubted], places[doubted], "centre", 5.5, kind="rings")
        panels.append(panel)
    return in_columns(panels, (2.0 + 0.6 * len(c.populations)) * POINTS)


def write_populations(c: PopulationsCompared, out: str | Path) -> Path:
    """Write ``compare.html``, ``populations.png``, ``.pdf``, tables; returns the page. Raises :class:`OutputError`."""
    out = make_folder(out)
    write_tables(c, out)
    title, told = " – ".join(c.populations), tuple(sentences(c, c.symbols))
    figures = [("populations", c.caption, figure(c))]
    return write_page(out, "compare", figures, out, title=title, populations=told)


def write_tables(c: PopulationsCompared, folder: Path) -> None:
    """``differences.csv`` and, with numbers, ``lines.csv``. Raises :class:`OutputError`."""
    three = [f"{what}_{q}" for what in ("ratio", "difference", "apart") for q in ("q05", "q50", "q95")]
    head = ["parameter", "first", "second", "unit", *three, "greater", "untrusted"]
    rows = (
        [d.parameter, d.first, d.second, d.unit, *d.ratio, *d.difference, *d.apart, d.greater, d.untrusted]
        for d in c.differences
    )
    write_csv(folder / "differences.csv", [head, *rows])
    if c.lines:
        three = [f"{what}_{q}" for what in ("slope", "level") for q in ("q05", "q50", "q95")]
        lines = [
            [name, "ln" if name in c.logarithmic else "", *_three(it.slope), *_three(it.level), it.misfit, it.freedom]
            for name, it in c.lines.items()
        ]
        write_csv(folder / "lines.csv", [["parameter", "of", *three, "chi2", "freedom"], *lines])


def numbers_of(names: Sequence[str]) -> tuple[tuple[float, ...], str]:
    """The numbers in names such as ``gel_5kPa``, and their unit; nothing where one has not one, or units differ."""
    of_names = [[(number, unit) for number, unit in _NUMBER.findall(name) if is_unit(unit)] for name in names]
    units = {unit for of_name in of_names for _, unit in of_name}
    if any(len(of_name) != 1 for of_name in of_names) or len(units) != 1:
        return (), ""
    numbers = tuple(float(of_name[0][0]) for of_name in of_names)
    return (numbers, units.pop()) if len(set(numbers)) > 1 else ((), "")


def groups_compared(held: Mapping[str, tuple[Path, StoredPopulation]]) -> PopulationsCompared | str | None:
    """The groups of a run side by side, of what :func:`~en4dvar.results.together.populations_of` gives; why not, where
    they share data; None with fewer than two populations.
    """
    groups = {name: of_group for name, of_group in held.items() if name}
    if len(groups) < 2:
        return None
    numbers = numbers_of([*groups])[0] if len(groups) > 2 else ()  # a line through two is their difference
    try:
        return _compared({name: _whole(folder / POPULATION, of) for name, (folder, of) in groups.items()}, numbers)
    except OutputError as error:
        return f"The groups are not compared: {error}."


def group_sentences(of: PopulationsCompared, names: Names = NAMES) -> Iterator[str]:
    """The answer, and which number the straight line is of."""
    yield from sentences(of, names)
    if of.lines:
        yield f"The number of the straight line is that of the names of the groups, in {numbers_of(of.populations)[1]}."


def group_lines(held: Mapping[str, tuple[Path, StoredPopulation]]) -> Iterator[str]:
    """What the terminal shows of the groups of a run, as of :func:`groups_compared`, before each of them."""
    of = groups_compared(held)
    if isinstance(of, str):
        yield of
    elif of is not None:
        yield medians_table(of)
        yield ""
        yield from group_sentences(of)
