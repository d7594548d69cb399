"""Figures as a page shows them, and on demand as files. A chart needs no matplotlib to be on a page."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup

from en4dvar.files import make_folder
from en4dvar.report.chart import Chart
from en4dvar.report.svg import svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Captioned = tuple[str, str, "Chart | Figure"]  # name, caption
Drawing = tuple[str, str, Markup]  # name, caption, SVG


def draw(
    figures: Iterable[Captioned], identifiers: str = "", folder: Path | None = None, begin: str = ""
) -> list[Drawing]:
    """Each figure as an SVG element; ``identifiers`` begins the names of its elements.

    ``folder``: where they are kept as PDF and PNG too, if anywhere, under names with ``begin``. Raises
    :class:`OutputError`.
    """
    drawings = []
    for name, caption, figure in figures:
        if folder is not None:
            _keep(figure, make_folder(folder), f"{begin}{name}")
        drawings.append((name, caption, _inline(figure, f"{identifiers}{name}", caption)))
    return drawings


# matplotlib takes longer to import than all charts of a page to draw


def _inline(figure: Chart | Figure, name: str, caption: str) -> Markup:
    if isinstance(figure, Chart):
        return svg(figure, name, caption)
    from en4dvar.report.style import inline_svg

    return inline_svg(figure, name, caption)


def _keep(figure: Chart | Figure, folder: Path, name: str) -> None:
    from en4dvar.report.paper import on_paper
    from en4dvar.report.style import save_figure

    save_figure(on_paper(figure) if isinstance(figure, Chart) else figure, folder, name)
