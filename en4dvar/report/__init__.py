"""A run directory's netCDF → figures (PDF and PNG), ``summary.csv`` and one self-contained ``report.html``.

Nothing is recomputed: whatever is shown was stored by the run.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path

from en4dvar.campaign_file import failed_datasets
from en4dvar.errors import OutputError
from en4dvar.files import write_text
from en4dvar.honesty import Caution
from en4dvar.report.figures import all_figures
from en4dvar.report.page import Section, make_section, render
from en4dvar.report.style import save_figure
from en4dvar.store import ParameterSummary, load_result

Summarised = tuple[str, Iterable[ParameterSummary], Iterable[Caution]]
DETAILED = 24  # data sets with figures; a campaign's others are in summary.csv and datasets/


def write_report(run_dir: str | Path) -> Path:
    """Write the report of a run and return the path of ``report.html``.

    Reads ``datasets/*.nc`` where the run has several data sets, else ``posterior.nc``. Of more than :data:`DETAILED`
    data sets those with warnings are shown first. Raises :class:`~en4dvar.errors.OutputError` where there is nothing
    to read or the directory cannot be written.
    """
    run_dir = Path(run_dir)
    paths = sorted((run_dir / "datasets").glob("*.nc")) or [run_dir / "posterior.nc"]
    if not run_dir.is_dir():
        raise OutputError(f"{run_dir}: no such run directory")
    failures = failed_datasets(run_dir / "posterior.nc") if len(paths) > 1 or paths[0].parent != run_dir else {}
    warned: dict[Path, bool] = {}

    def summaries() -> Iterator[Summarised]:
        for path in paths:
            result = load_result(path)
            warned[path] = bool(result.warnings)
            yield result.name, result.summary(), result.cautions

    write_text(run_dir / "summary.csv", summary_csv(summaries(), failures))
    folder = run_dir / "figures"
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be created: {error.strerror}") from None
    sections: list[Section] = []
    for path in sorted(sorted(paths, key=lambda p: not warned[p])[:DETAILED]):
        result = load_result(path)
        prefix = f"{_slug(path.stem)}_" if len(paths) > 1 else ""
        figures = list(all_figures(result))
        for name, _, figure in figures:
            save_figure(figure, folder, f"{prefix}{name}")
        sections.append(make_section(result, f"d{len(sections)}", figures))
    return write_text(run_dir / "report.html", render(sections, failures, len(paths) - len(sections)))


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


def _slug(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)
