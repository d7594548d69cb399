"""A run directory's netCDF → figures (PDF and PNG), ``summary.csv`` and self-contained HTML pages.

Nothing is recomputed: whatever is shown was stored by the run. One data set is one page, ``report.html``. A campaign's
``report.html`` is its table, with a page for each data set beside it in ``pages/``; of more than :data:`PAGES` sets
the worst warned of get theirs at once and the others when they are asked for by name.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from urllib.parse import quote

from en4dvar.caution import Caution
from en4dvar.errors import OutputError
from en4dvar.executor import ProcessesExecutor, SerialExecutor, WorkerLostError
from en4dvar.files import write_text
from en4dvar.hints import suggest
from en4dvar.report.figures import all_figures
from en4dvar.report.overview import Entry, overview_figures, render_overview
from en4dvar.report.page import make_section, render_set
from en4dvar.report.style import save_figure
from en4dvar.storage.campaign_file import failed_datasets
from en4dvar.storage.store import ParameterSummary, StoredResult, load_stored

Summarised = tuple[str, Iterable[ParameterSummary], Iterable[Caution]]
PAGES = 40  # data sets of a campaign with a page from the start
SHARE = 4  # pages that are worth the start of a process
COPIES = 12  # data sets of a campaign up to which figures are also kept as PDF and PNG


def write_pages(run_dir: str | Path, datasets: Sequence[str] = (), workers: int = 1) -> Path:
    """Write the report of a run and return the path of ``report.html``.

    Reads ``datasets/*.nc`` where the run has several data sets, else ``posterior.nc``. ``datasets`` are names of data
    sets of a campaign: their pages, with figures as PDF and PNG, are written and the overview links to them. Pages of a
    campaign are drawn by up to ``workers`` processes, each with its share of :data:`SHARE` or more.

    Raises
    ------
    OutputError: there is nothing to read, a name is unknown, or the directory cannot be written.
    """
    run_dir = Path(run_dir)
    if not run_dir.is_dir():
        raise OutputError(f"{run_dir}: no such run directory")
    paths = sorted((run_dir / "datasets").glob("*.nc"))
    if not paths:
        result = load_stored(run_dir / "posterior.nc")
        write_text(run_dir / "summary.csv", summary_csv([(result.name, result.summary(), result.cautions)], {}))
        return _write_set(run_dir / "report.html", result, copies="")
    entries = [Entry.of(load_stored(path), path.stem) for path in paths]
    failures = failed_datasets(run_dir / "posterior.nc")
    write_text(run_dir / "summary.csv", summary_csv(((e.name, e.summary, e.cautions) for e in entries), failures))
    return _write_campaign(run_dir, entries, failures, _asked(run_dir, entries, datasets), workers)


def summary_csv(summaries: Iterable[Summarised], failures: Mapping[str, str]) -> str:
    """One line a data set and parameter, in display units, every digit kept; one line a data set that failed.

    ``summaries``: (name of the data set, its rows, its warnings: column ``warnings`` holds their codes);
    ``failures``: name of the data set → reason, column ``failure``.
    """
    columns = [f.name for f in fields(ParameterSummary) if f.name not in ("label", "symbol")]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["dataset", *columns, "failure", "warnings"])
    for name, summary, cautions in summaries:
        codes = " ".join(dict.fromkeys(c.code for c in cautions))
        for row in summary:
            writer.writerow([name, *(getattr(row, column) for column in columns), "", codes])
    for name, reason in failures.items():
        writer.writerow([name, *("" for _ in columns), reason, ""])
    return text.getvalue()


def _asked(run_dir: Path, entries: Sequence[Entry], names: Sequence[str]) -> frozenset[str]:
    """Stems of the data sets asked for."""
    stems = {entry.name: entry.stem for entry in entries}
    for name in names:
        if name not in stems:
            raise OutputError(f"{run_dir}: no data set {name!r}{suggest(name, stems)}")
    return frozenset(stems[name] for name in names)


def _write_campaign(
    run_dir: Path, entries: Sequence[Entry], failures: Mapping[str, str], asked: frozenset[str], workers: int
) -> Path:
    folder = _folder(run_dir / "pages")
    first = {e.stem for e in sorted(entries, key=lambda e: -e.gravity)[:PAGES]}
    paged = [e for e in entries if e.stem in asked | first or (folder / f"{e.stem}.html").is_file()]
    calls: list[tuple[Path, str, str | None, list[tuple[str, str]]]] = []
    for before, entry, after in zip([None, *paged[:-1]], paged, [*paged[1:], None], strict=True):
        neighbours = (("← ", before), ("→ ", after))
        trail = [("All data sets", "../report.html")]
        trail += [(f"{arrow}{e.name}", quote(f"{e.stem}.html")) for arrow, e in neighbours if e is not None]
        copies = f"{entry.stem}_" if len(entries) <= COPIES or entry.stem in asked else None
        calls.append((run_dir, entry.stem, copies, trail))
    workers = min(workers, len(calls) // SHARE)
    with ProcessesExecutor(workers) if workers > 1 else SerialExecutor() as executor:
        for i, value in executor.map(_write_page, calls):
            if isinstance(value, WorkerLostError):
                _write_page(*calls[i])
            elif isinstance(value, Exception):
                raise value
    figures = overview_figures(entries)
    _folder(run_dir / "figures")
    for name, _, figure in figures:
        save_figure(figure, run_dir / "figures", name)
    pages = {e.stem: quote(f"pages/{e.stem}.html") for e in paged}
    return write_text(run_dir / "report.html", render_overview(entries, pages, failures, figures))


def _write_page(run_dir: Path, stem: str, copies: str | None, trail: Sequence[tuple[str, str]]) -> None:
    """The page of one data set of a campaign."""
    result = load_stored(run_dir / "datasets" / f"{stem}.nc")
    _write_set(run_dir / "pages" / f"{stem}.html", result, copies, trail)


def _write_set(path: Path, result: StoredResult, copies: str | None, trail: Sequence[tuple[str, str]] = ()) -> Path:
    """The page of one data set; ``copies``: prefix of its figures as PDF and PNG in ``figures/``, None for none."""
    figures = list(all_figures(result))
    if copies is not None:
        folder = _folder((path.parent if path.name == "report.html" else path.parent.parent) / "figures")
        for name, _, figure in figures:
            save_figure(figure, folder, f"{copies}{name}")
    return write_text(path, render_set(make_section(result, "d0", figures), trail, copies is not None))


def _folder(folder: Path) -> Path:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be created: {error.strerror}") from None
    return folder
