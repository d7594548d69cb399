"""Figures of fields that were estimated cell by cell."""

import numpy as np
import pytest

from en4dvar.report.fields import maps
from en4dvar.storage.netcdf import Group, Variable
from en4dvar.storage.store import StoredResult


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
    (ax,) = maps(result).subfigs[0].axes
    lowest = [path.vertices[:, 1].min() for drawn in ax.collections for path in drawn.get_paths()]
    assert len(lowest) == 2
    assert (min(lowest) > 0) == positive
