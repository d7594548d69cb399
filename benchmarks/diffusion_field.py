"""Conductivity of 10 000 cells from 200 heads at three instants: ``python benchmarks/diffusion_field.py``.

Localised En4D-Var and ES-MDA, and ES-MDA without localisation, against the truth that made the readings.
"""

from __future__ import annotations

import argparse

import numpy as np

from en4dvar.descent.field import field_en4dvar, field_esmda
from en4dvar.descent.field_data import FieldData
from en4dvar.model.state import Array
from en4dvar.priors.field_prior import FieldPrior
from en4dvar.schemes.local_gain import ByCorrelation, ByDistance
from en4dvar_diffusion import Aquifer

ERROR = 0.02  # of the largest head
TIMES = np.array([4.0, 12.0, 32.0])


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--side", type=int, default=100, help="cells along a side of the grid")
    asked.add_argument("--wells", type=int, default=200)
    asked.add_argument("--members", type=int, default=50)
    asked.add_argument("--length", type=float, default=8.0, help="correlation length of the field in cells")
    asked.add_argument("--radius", type=float, default=16.0, help="of the localisation in cells")
    asked.add_argument("--seed", type=int, default=1)
    given = asked.parse_args()
    rng, shape = np.random.default_rng(given.seed), (given.side, given.side)
    aquifer, wells = Aquifer(shape), np.sort(rng.choice(given.side**2, given.wells, replace=False))
    field = FieldPrior(aquifer.layout.fields[1], 1.0, "gaussian", given.length)
    truth, *prior = (field.draw(given.seed, i) for i in range(given.members + 1))

    def forward(fields: Array) -> Array:
        return aquifer.heads(fields, wells, TIMES)

    heads = forward(truth[None])[0]
    std = np.full(len(heads), ERROR * heads.max())
    data = FieldData(heads + std * rng.standard_normal(len(heads)), std, forward)
    near = ByDistance(aquifer.places, np.tile(aquifer.places[wells], (len(TIMES), 1)), given.radius)

    def tell(name: str, ensemble: np.ndarray, more: str = "") -> None:
        error = np.sqrt(np.mean((ensemble.mean(axis=0) - truth) ** 2))
        spread = np.sqrt(np.mean(ensemble.var(axis=0, ddof=1)))
        print(f"{name:28s} RMSE {error:.3f}, spread {spread:.3f}{more}", flush=True)

    tell("prior", np.array(prior))
    ensemble = np.array(prior)
    end = field_en4dvar(ensemble, data, near, seed=given.seed)
    ended = "converged" if end.converged else "not converged"
    costs = " → ".join(f"{cost:.0f}" for cost in end.costs)
    tell("En4D-Var by distance", ensemble, f"; J {costs}, {ended}, {end.forward_runs} runs")
    ensemble = np.array(prior)
    field_esmda(ensemble, data, near, seed=given.seed)
    tell("ES-MDA by distance", ensemble)
    ensemble = np.array(prior)
    field_esmda(ensemble, data, ByCorrelation(threshold=0.0), seed=given.seed)
    tell("ES-MDA without localisation", ensemble)


if __name__ == "__main__":
    main()
