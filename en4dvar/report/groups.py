"""Groups of the data sets of one run, such as two materials, each with a population: side by side."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.units import is_unit
from en4dvar.report.populations import PopulationsCompared, compare_populations, medians_table, sentences
from en4dvar.results.population_file import load_groups_of

_NUMBER = re.compile(r"(?<![^\W_])(?<!\.)(\d+(?:\.\d+)?)[ _]?(%|[^\W\d_]+)(?![^\W_])")


def numbers_of(names: Sequence[str]) -> tuple[tuple[float, ...], str]:
    """The number in each of the names and their unit, as of ``gel_5kPa`` and ``gel_8kPa``; nothing where a name has
    none or several, units differ, or all numbers are the same.
    """
    of_names = [[(number, unit) for number, unit in _NUMBER.findall(name) if is_unit(unit)] for name in names]
    units = {unit for of_name in of_names for _, unit in of_name}
    if any(len(of_name) != 1 for of_name in of_names) or len(units) != 1:
        return (), ""
    numbers = tuple(float(of_name[0][0]) for of_name in of_names)
    return (numbers, units.pop()) if len(set(numbers)) > 1 else ((), "")


def groups_compared(run_dir: Path) -> PopulationsCompared | str | None:
    """The groups of a run side by side; why not, where their data are the same; None where fewer than two have a
    population.
    """
    folders = {name: folder for name, (folder, _) in load_groups_of(run_dir).items()}
    if len(folders) < 2:
        return None
    numbers = numbers_of([*folders])[0] if len(folders) > 2 else ()  # a line through two is their difference
    try:
        return compare_populations(folders, numbers)
    except OutputError as error:
        return f"The groups are not compared: {error}."


def group_sentences(of: PopulationsCompared) -> Iterator[str]:
    """The answer, and which number the straight line is of."""
    yield from sentences(of)
    if of.lines:
        yield f"The number of the straight line is that of the names of the groups, in {numbers_of(of.populations)[1]}."


def group_lines(run_dir: Path) -> Iterator[str]:
    """What the terminal shows of the groups of a run before each of them."""
    of = groups_compared(run_dir)
    if isinstance(of, str):
        yield of
    elif of is not None:
        yield medians_table(of)
        yield ""
        yield from group_sentences(of)
