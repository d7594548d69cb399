"""A result as a notebook shows it: the posterior as a table, how the fit ended, warnings."""

from __future__ import annotations

from markupsafe import Markup

from en4dvar.estimation.summary import estimate_cells
from en4dvar.results.store import StoredResult

HEADER = ("", "unit", "mean", "std", "5 %", "50 %", "95 %", "DFS")


def cell_html(result: StoredResult) -> str:
    """The result as a piece of HTML; everything in it is escaped."""
    rows = [(row.label, row.unit, *estimate_cells(row), f"{row.dfs:.2f}") for row in result.rows]
    head = Markup("").join(Markup("<th>{}</th>").format(cell) for cell in HEADER)
    body = Markup("").join(
        Markup("<tr>{}</tr>").format(Markup("").join(Markup("<td>{}</td>").format(cell) for cell in row))
        for row in rows
    )
    warned = Markup("").join(Markup("<li>{}: {}</li>").format(c.kind, c.words) for c in result.cautions)
    return str(
        Markup("<div><b>{}</b><table><thead><tr>{}</tr></thead><tbody>{}</tbody></table><p>{}</p>{}</div>").format(
            result.name, head, body, result.ended, Markup("<ul>{}</ul>").format(warned) if warned else ""
        )
    )
