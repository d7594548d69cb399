"""Charts as a page shows them, and on demand as files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from markupsafe import Markup

from en4dvar.plumbing.files import make_folder
from en4dvar.report.chart import Chart
from en4dvar.report.svg import svg

Captioned = tuple[str, str, Chart]  # name, caption
Drawing = tuple[str, str, Markup]  # name, caption, SVG


def draw(
    figures: Iterable[Captioned], identifiers: str = "", folder: Path | None = None, begin: str = ""
) -> list[Drawing]:
    """Each chart as an SVG element; ``identifiers`` begins the names of its elements.

    ``folder``: where they are kept as PDF and PNG too, if anywhere, under names with ``begin``. Raises
    :class:`OutputError`.
    """
    drawings = []
    for name, caption, chart in figures:
        if folder is not None:
            keep(chart, make_folder(folder), f"{begin}{name}")
        drawings.append((name, caption, svg(chart, f"{identifiers}{name}", caption)))
    return drawings


def keep(chart: Chart, folder: Path, name: str) -> None:
    """Write ``folder/name.pdf`` and ``folder/name.png``. Raises :class:`OutputError`."""
    from en4dvar.report.paper import save_chart  # matplotlib takes longer to import than a page to draw

    save_chart(chart, folder, name)
