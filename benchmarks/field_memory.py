"""Localised En4D-Var of a field of a million cells: peak memory over that of the ensemble, and CPU time.

    python benchmarks/field_memory.py [SIDE] [MEMBERS]

Readings are means of 3 × 3 cells, so that the model costs nothing.
"""

from __future__ import annotations

import os

os.environ.update(OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import resource
import sys
import time

import numpy as np

from en4dvar.descent.field import field_en4dvar, field_esmda
from en4dvar.descent.field_data import FieldData
from en4dvar.schemes.local_gain import ByDistance


def main() -> None:
    side, members = (int(text) for text in (*sys.argv[1:], *("1000", "40")[len(sys.argv) - 1 :]))
    rng = np.random.default_rng(0)
    ensemble = rng.standard_normal((members, side**2))
    places = np.indices((side, side), dtype=float).reshape(2, -1).T
    corner = rng.integers(0, side - 3, (200, 2))
    cells = (corner[:, 0, None] + np.arange(3))[:, :, None] * side + (corner[:, 1, None] + np.arange(3))[:, None, :]
    cells = cells.reshape(200, 9)
    data = FieldData(rng.standard_normal(200), np.full(200, 0.3), lambda x: x[:, cells].mean(axis=2), at_once=2)
    near = ByDistance(places, corner + 1.0, side / 20)
    for run in (field_esmda, field_en4dvar):
        began = time.process_time()
        run(ensemble, data, near)
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        print(
            f"{run.__name__}: {side**2} cells, {members} members: peak {most / ensemble.nbytes:.2f} times the "
            f"ensemble's {ensemble.nbytes / 2**20:.0f} MiB (process and places included), "
            f"{time.process_time() - began:.0f} s CPU",
            flush=True,
        )


if __name__ == "__main__":
    main()
