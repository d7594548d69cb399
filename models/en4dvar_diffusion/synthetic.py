"""Readings of a synthetic aquifer: ``python -m en4dvar_diffusion.synthetic configs/data/aquifer_heads.csv``.

A field drawn from the prior of ``configs/diffusion_field.yaml``, heads at wells at three instants, and independent
errors of 2 % of the largest head.
"""

import sys
from pathlib import Path

import numpy as np

from en4dvar.model.state import Array
from en4dvar.priors.field_prior import FieldPrior
from en4dvar_diffusion.aquifer import Aquifer

SHAPE, WELLS, TIMES, SHARE, SEED = (100, 100), 200, (4.0, 12.0, 32.0), 0.02, 20261


def truth() -> Array:
    """ln T (n,) that made the readings."""
    (field,) = (block for block in Aquifer(SHAPE).layout if block.name == "ln_T")
    return FieldPrior(field, std=1.0, kernel="gaussian", length=8.0).draw(SEED, 0)


def readings() -> str:
    """The data file."""
    rng = np.random.default_rng(SEED)
    wells = np.sort(rng.choice(SHAPE[0] * SHAPE[1], WELLS, replace=False))
    heads = Aquifer(SHAPE).heads(truth()[None], wells, np.array(TIMES))[0]
    error = SHARE * float(heads.max())
    heads = heads + error * rng.standard_normal(len(heads))
    lines = [
        "# SYNTHETIC data, no measurement: heads of an aquifer of 100 x 100 cells; cells counted from 0, row by row",
        f"# made by python -m en4dvar_diffusion.synthetic, seed {SEED}; error std {error:.6f}",
        "t,cell,head",
    ]
    rows = zip(np.repeat(TIMES, WELLS), np.tile(wells, len(TIMES)), heads, strict=True)
    return "\n".join([*lines, *(f"{t:g},{cell},{head:.6f}" for t, cell, head in rows)]) + "\n"


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(readings(), encoding="utf-8")
