"""A run directory's netCDF → ``summary.csv``, self-contained HTML pages and, on demand, figures as PDF and PNG.

Nothing is recomputed: whatever is shown was stored by the run. One data set is one page, ``report.html``. A campaign's
``report.html`` is its table, with a page for each data set beside it in ``pages/``; of more than :data:`PAGES` sets
the worst warned of get theirs at once and the others when they are asked for by name.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from urllib.parse import quote

from en4dvar.estimation.summary import summary_rows
from en4dvar.executor import ProcessesExecutor, SerialExecutor, WorkerLostError
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.files import inside, make_folder, write_text
from en4dvar.plumbing.hints import suggest
from en4dvar.plumbing.tables import write_csv
from en4dvar.report.figures import PIECE_COLUMNS, stored_walks
from en4dvar.report.history import WITHHELD_COLUMNS, withheld_lines
from en4dvar.report.page import Headline, SetSummary, overview_figures, render_overview, render_set
from en4dvar.report.responses import ENTRY_COLUMNS, SHIFT_COLUMNS, stored_ledger, stored_shifts
from en4dvar.report.svg import draw
from en4dvar.report.text import upper_first
from en4dvar.results.campaign_file import failed_datasets
from en4dvar.results.pack import PACK
from en4dvar.results.run_results import RunResults
from en4dvar.results.store import StoredResult, load_stored
from en4dvar.results.together import JOINT, StoredPopulation, load_joint, populations_of

PAGES = 40  # data sets of a campaign with a page from the start
SHARE = 20  # pages that are worth the start of a process
Line = tuple[object, ...]
TABLES: dict[str, tuple[Sequence[str], Callable[[StoredResult], Iterable[Line]]]] = {
    # columns behind the name of the data set, and what gives lines that begin with these cells
    "what_if.csv": (SHIFT_COLUMNS, lambda result: chain(*stored_shifts(result))),
    "ledger.csv": (ENTRY_COLUMNS, lambda result: chain(*stored_ledger(result))),
    "varying.csv": (PIECE_COLUMNS, lambda result: chain(*(walk.cells for walk in stored_walks(result)))),
    "withheld.csv": (WITHHELD_COLUMNS, withheld_lines),
}


def write_pages(run_dir: str | Path, datasets: Sequence[str] = (), workers: int = 1, files: bool = False) -> Path:
    """Write the report of a run and return the path of ``report.html``.

    ``datasets`` are names of data sets of a campaign: their pages are written and the overview links to them.
    ``files``: figures are also kept as PDF and PNG, in a campaign of ``datasets`` or, where none is named, of all that
    have a page. Pages of a campaign are drawn by up to ``workers`` processes, with :data:`SHARE` or more for each.

    Raises :class:`OutputError`: there is nothing to read, a name is unknown, or the directory cannot be written.
    :class:`LackingError`: results of data sets cannot be read; the page of the others, ``rest``, names them.
    """
    run_dir = Path(run_dir)
    stored = RunResults(run_dir)
    sets, lines = [], []
    for path, result in stored:
        sets.append(SetSummary.of(result, path.name))
        lines.append(_lines(result))
    if not sets:
        stored.require()
    stems = {s.name: s.stem for s in sets}
    for name in datasets:
        if name not in stems:
            raise OutputError(f"{run_dir}: no data set {name!r}{suggest(name, stems)}")
    for (table, (columns, _)), parts in zip(TABLES.items(), zip(*lines, strict=True), strict=True):
        if rows := [*chain(*parts)]:
            write_csv(run_dir / table, [("dataset", *columns), *rows])
    single = stored.files == [stored.whole]
    failures = {} if single else failed_datasets(stored.whole) | stored.lacking
    write_csv(run_dir / "summary.csv", summary_rows(((s.name, s.rows.values(), s.cautions) for s in sets), failures))
    if single:
        folder = inside(run_dir, "figures") if files else None
        return write_text(run_dir / "report.html", render_set(result, folder=folder))
    page = _write_campaign(run_dir, sets, failures, {stems[name] for name in datasets}, workers, files)
    stored.require(page)
    return page


def _lines(result: StoredResult) -> list[list[Line]]:
    """Of each of :data:`TABLES`, the name of the data set first."""
    return [[(result.name, *line[: len(columns)]) for line in lines(result)] for columns, lines in TABLES.values()]


def _write_campaign(
    run_dir: Path, sets: Sequence[SetSummary], failures: Mapping[str, str], asked: set[str], workers: int,
    files: bool,
) -> Path:  # fmt: skip
    folder = make_folder(inside(run_dir, "pages"))
    first = {s.stem for s in sorted(sets, key=lambda s: -s.gravity)[:PAGES]}
    paged = [s for s in sets if s.stem in asked | first or (folder / f"{s.stem}.html").is_file()]
    workers = min(workers, len(paged) // SHARE)
    calls: list[tuple[Path, str, str | None, list[tuple[str, str]]]] = []
    for before, listed, after in zip([None, *paged[:-1]], paged, [*paged[1:], None], strict=True):
        neighbours = (("← ", before), ("→ ", after))
        trail = [("All data sets", "../report.html")]
        trail += [(f"{arrow}{s.name}", quote(f"{s.stem}.html")) for arrow, s in neighbours if s is not None]
        copies = f"{listed.stem}_" if files and (listed.stem in asked or not asked) else None
        calls.append((run_dir, listed.stem, copies, trail))
    with ProcessesExecutor(workers) if workers > 1 else SerialExecutor() as executor:
        for i, value in executor.map(_write_page, calls):
            if isinstance(value, WorkerLostError):
                _write_page(*calls[i])
            elif isinstance(value, Exception):
                raise value
    held = populations_of(run_dir)
    of_gel = {name for _, of in held.values() for name in of.names}
    figures = draw(overview_figures(sets, of_gel), folder=inside(run_dir, "figures") if files else None)
    pages = {s.stem: quote(f"pages/{s.stem}.html") for s in paged}
    shown = {"pages": pages, "failures": failures, "figures": figures}
    return write_text(run_dir / "report.html", render_overview(sets, _headlines(run_dir, held), **shown))


def _headlines(run_dir: Path, held: Mapping[str, tuple[Path, StoredPopulation]]) -> list[Headline]:
    """What the data sets say together, where the run estimated it (``held`` its populations); the tables of its groups
    are written.
    """
    from en4dvar.report import populations, together  # with the estimates, which other pages do not need

    headlines: list[Headline] = []
    groups = populations.groups_compared(held)
    if isinstance(groups, str):
        headlines.append(("summary.csv", "All data sets", [groups], [], ()))
    elif groups is not None:
        populations.write_tables(groups, run_dir)
        told = [*populations.group_sentences(groups, groups.symbols)]
        figures = [("populations", groups.caption, populations.figure(groups))]
        headlines.append(("differences.csv", "The differences", told, figures, ()))
    for name, (folder, of) in held.items():
        words = f"The population of {name}" if name else "The population of all data sets"
        told = [f"{name}: {line}" if name else upper_first(line) for line in together.sentences(of, of.symbols)]
        address = quote((folder / "population.html").relative_to(run_dir).as_posix())
        headlines.append((address, words, told, [together.population_figure(of)], of.cautions))
    if (run_dir / JOINT).exists():
        shared = load_joint(run_dir / JOINT)
        lines = [upper_first(line) for line in together.joint_lines(shared)]
        figures = [together.joint_figure(shared)]
        headlines.append(("joint.html", "All of them together", lines, figures, shared.cautions))
    return headlines


def _write_page(run_dir: Path, stem: str, copies: str | None, trail: Sequence[tuple[str, str]]) -> None:
    """The page of one data set of a campaign; ``copies``: prefix of its figures as PDF and PNG, None for none."""
    result = load_stored(run_dir / PACK / stem)
    folder = None if copies is None else inside(run_dir, "figures")
    write_text(inside(run_dir, f"pages/{stem}.html"), render_set(result, trail, folder, copies or ""))
