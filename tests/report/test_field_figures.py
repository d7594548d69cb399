"""Figures of fields that were estimated cell by cell."""

import numpy as np
import pytest

from en4dvar.plumbing.errors import OutputError
from en4dvar.report.chart import VIRIDIS
from en4dvar.report.figures import maps
from en4dvar.report.result import Result
from en4dvar.results.netcdf import Group, Variable
from en4dvar.results.store import StoredResult


@pytest.mark.parametrize("positive", [True, False])
def test_no_band_of_a_positive_field_is_negative(positive):
    """A field on a line whose spread exceeds its mean."""
    members = np.random.default_rng(1).lognormal(sigma=2, size=(40, 5))
    members -= 0 if positive else 0.2
    mean, std = members.mean(axis=0), members.std(axis=0)
    assert (mean < std).all()
    assert (members.min() > 0) == positive
    about = {"units": "1", "display_units": "1", "symbol": "K"}
    cells = {f"K{kind}": Variable(("K_cell",), values, about) for kind, values in {"_mean": mean, "_std": std}.items()}
    cells |= {f"K_prior{name.removeprefix('K')}": value for name, value in cells.items()}
    cells |= {"K": Variable(("draw", "K_cell"), members, about)}
    cells |= {"K_at": Variable(("K_cell", "K_axis"), np.arange(5.0)[:, None], {"units": "m"})}
    result = StoredResult({"/fields": Group(cells)})
    ((panel,),) = (row.panels for row in maps(result).rows)
    lowest = [mark.y.min() for mark in panel.marks if mark.kind == "band"]
    assert len(lowest) == 2
    assert (min(lowest) > 0) == positive


@pytest.mark.parametrize("regular", [True, False])
def test_every_cell_of_a_map_has_the_colour_of_its_value(regular):
    rows, columns = np.divmod(np.arange(12), 4)
    at = np.column_stack([2.0 * rows, 3.0 * columns]) + (
        0 if regular else np.random.default_rng(2).normal(size=(12, 2))
    )
    mean = np.linspace(-1.0, 4.0, 12)
    about = {"units": "1", "display_units": "1", "symbol": "K"}
    cells = {f"K_{kind}": Variable(("K_cell",), mean, about) for kind in ("mean", "prior_mean")}
    cells |= {f"K_{kind}": Variable(("K_cell",), np.linspace(1, 2, 12), about) for kind in ("std", "prior_std")}
    cells |= {"K": Variable(("draw", "K_cell"), np.stack([mean, mean]), about)}
    cells |= {"K_at": Variable(("K_cell", "K_axis"), at, {"units": "m"})}
    maps_, _ = maps(StoredResult({"/fields": Group(cells)})).rows
    marks = maps_.panels[0].marks
    assert {mark.kind for mark in marks} == {"tiles" if regular else "dots"}
    colour = {(x, y): mark.colour for mark in marks for x, y in zip(mark.x, mark.y, strict=True)}
    drawn = [colour[x, y] for y, x in at]
    assert drawn[0] == VIRIDIS[0]
    assert drawn[-1] == VIRIDIS[-1]
    assert len(set(drawn)) == 12
    assert len({mark.colour for mark in maps_.panels[1].marks}) == 1  # posterior as wide as the prior


@pytest.mark.parametrize("figure", ["plot_histograms", "plot_pairs"])
def test_fields_alone_are_no_parameters_to_draw(figure, monkeypatch):
    monkeypatch.setattr(Result, "rows", ())
    with pytest.raises(OutputError, match="only fields"):
        getattr(Result({}), figure)()
