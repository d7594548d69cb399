"""Localised En4D-Var of a field of a million cells: peak memory over that of the ensemble, and CPU time.

    python benchmarks/field_memory.py [SIDE] [MEMBERS]
    python benchmarks/field_memory.py problem [SIDE] [MEMBERS]

Readings are means of 3 × 3 cells, so that the model costs nothing. ``problem``: by ES-MDA from an inverse problem, as
of a configuration, to its result file: prior drawn, model run, posterior written.
"""

from __future__ import annotations

import os

os.environ.update(OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import resource
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from en4dvar.data.noise import noise_of
from en4dvar.data.observations import Observations
from en4dvar.data.series import Places, Series
from en4dvar.descent.field import field_en4dvar, field_esmda
from en4dvar.descent.field_data import FieldData
from en4dvar.estimation.assimilate import assimilate
from en4dvar.model.forward import ForwardModel, Observable, StateField
from en4dvar.model.state import Field, Parameter, StateLayout
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.priors.prior import Prior
from en4dvar.problem import InverseProblem
from en4dvar.results.netcdf import to_bytes
from en4dvar.results.store import build_groups
from en4dvar.schemes.local_gain import ByDistance
from en4dvar.schemes.settings import AssimilationSettings, Localisation


class Still(ForwardModel):
    """A field that stays as it is."""

    parameters = (Parameter("offset", "1"),)
    observables = (Observable("u", "1", StateField("u")),)

    def __init__(self, side: int):
        places = np.indices((side, side), dtype=float).reshape(2, -1).T
        self.layout = StateLayout((Field("u", side**2, coordinates=places), Field("offset")))

    def initial_state(self, theta: Mapping[str, float]) -> np.ndarray:
        return np.append(np.zeros(self.layout.size - 1), theta["offset"])

    def step(self, x: np.ndarray, t0: float, t1: float) -> np.ndarray:
        return x


def problem(side: int, members: int) -> None:
    rng, model = np.random.default_rng(0), Still(side)
    corner = rng.integers(0, side - 3, (200, 2))
    cells = (corner[:, 0, None] + np.arange(3))[:, :, None] * side + (corner[:, 1, None] + np.arange(3))[:, None, :]
    places = Places(cells.reshape(200, 9), np.full((200, 9), 1 / 9), np.arange(200.0))
    series = Series(
        model.observables[0], np.ones(200), rng.standard_normal(200), noise_of(np.full(200, 0.3)), places=places
    )
    field = FieldPrior(model.layout.fields[0], 1.0, "gaussian", side / 100)
    asked = InverseProblem(
        model, model.observables[0], Observations.of_series([series]), Prior(()), {"offset": 0.0}, fields=(field,)
    )
    began = time.process_time()
    near = Localisation(side / 20)
    found = assimilate(asked, AssimilationSettings("es-mda", members=members, localisation=near), 0)
    told("assimilate, es-mda", found.fields[0].members.nbytes, side, members, began)
    with tempfile.TemporaryDirectory() as folder:
        to_bytes(build_groups(found, {})).write(Path(folder) / "posterior.nc")
        told("and its file", found.fields[0].members.nbytes, side, members, began)


def told(what: str, ensemble: int, side: int, members: int, began: float) -> None:
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(
        f"{what}: {side**2} cells, {members} members: peak {most / ensemble:.2f} times the ensemble's "
        f"{ensemble / 2**20:.0f} MiB (process and places included), {time.process_time() - began:.0f} s CPU",
        flush=True,
    )


def main() -> None:
    if sys.argv[1:2] == ["problem"]:
        problem(*(int(text) for text in (*sys.argv[2:], *("1000", "40")[len(sys.argv) - 2 :])))
        return
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
        told(run.__name__, ensemble.nbytes, side, members, began)


if __name__ == "__main__":
    main()
