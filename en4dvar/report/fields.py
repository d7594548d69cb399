"""Fields that were estimated cell by cell: maps of what they are and of how much the data narrowed them."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from en4dvar.field_prior import regular_grid
from en4dvar.report.style import COLUMN, LIGHT, band, styled
from en4dvar.report.text import shown, with_unit
from en4dvar.state import Array
from en4dvar.storage.netcdf import Group
from en4dvar.storage.store import StoredResult

CAPTION = (
    "Fields of the initial state: posterior mean, and posterior over prior standard deviation (1: the data say nothing "
    "about the cell); for a field along a line, mean and std of the posterior (blue) over those of the prior (grey)."
)


def stored_fields(result: StoredResult) -> tuple[Group, list[str]]:
    """The group of the fields, and their names; none of a result without."""
    data = result.groups.get("/fields", Group())
    return data, [name.removesuffix("_at") for name in data.variables if name.endswith("_at")]


@styled
def maps(result: StoredResult) -> Figure:
    """Each field: a line with its band, or two maps."""
    data, names = stored_fields(result)
    figure = Figure(figsize=(COLUMN, 5.6 * len(names) / 2.54), layout="constrained")
    for rows, name in zip(figure.subfigures(len(names), 1, squeeze=False)[:, 0], names, strict=True):
        at = data[f"{name}_at"].values
        if at.shape[1] == 1:
            _line(rows.subplots(), data, name, at[:, 0])
            continue
        mean, kept = rows.subplots(1, 2)
        _map(rows, mean, at, shown(data[f"{name}_mean"]), _label(data, name))
        share = data[f"{name}_std"].values / data[f"{name}_prior_std"].values
        _map(rows, kept, at, share, "posterior / prior std", vmin=0, vmax=1, cmap="Greys")
    return figure


def _label(data: Group, name: str) -> str:
    about = data[name].attrs
    return with_unit(str(about["symbol"]), str(about["display_units"]))


def _line(ax: Axes, data: Group, name: str, at: Array) -> None:
    order = np.argsort(at)
    positive = not np.any(data[name].values <= 0)
    for kind, colour in (("prior_", "prior"), ("", "posterior")):
        mean, std = (shown(data[f"{name}_{kind}{what}"])[order] for what in ("mean", "std"))
        ax.fill_between(at[order], *band(mean, std, 1, positive), color=LIGHT[colour], alpha=0.3, lw=0)
        ax.plot(at[order], mean, color=LIGHT[colour])
    ax.set(xlabel=with_unit("place", str(data[f"{name}_at"].attrs["units"])), ylabel=_label(data, name))


def _map(figure: Any, ax: Axes, at: Array, values: Array, label: str, **style: Any) -> None:
    """Values (n,) at the first two coordinates of places ``at`` (n, D), the first of them downwards."""
    grid = regular_grid(at[:, :2])
    if grid is not None:
        (rows, columns), (down, across) = grid
        box = (at[0, 1] - across / 2, at[-1, 1] + across / 2, at[-1, 0] + down / 2, at[0, 0] - down / 2)
        drawn: Any = ax.imshow(values.reshape(rows, columns), extent=box, interpolation="nearest", **style)
    else:
        drawn = ax.scatter(at[:, 1], at[:, 0], c=values, s=4, rasterized=True, **style)
        ax.invert_yaxis()
    ax.set_aspect("equal")
    figure.colorbar(drawn, ax=ax, label=label, location="bottom")
