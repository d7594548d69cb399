"""Heads of a confined aquifer on a grid: storage ∂h/∂t = ∇·(T ∇h) + recharge, h = 0 at the boundary and at first.

Cells have side 1; T = exp(ln_T), a field of the state that stays as it is. Finite volumes with harmonic means of T
between cells, implicit Euler steps, one factorisation a member. Source: Bear (1979), Hydraulics of Groundwater, § 5-1.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field as Setting
from scipy.sparse import csc_matrix, diags, identity
from scipy.sparse.linalg import splu

from en4dvar import Failure, Field, ForwardModel, Observable, Parameter, StateField, StateLayout, Trajectory
from en4dvar.plumbing.described import Described

Array = npt.NDArray[np.float64]
Side = Annotated[int, Setting(ge=2)]
SOURCE = "Bear (1979), Hydraulics of Groundwater, § 5-1"


class AquiferSettings(Described):
    """The grid, and the steps in time."""

    shape: tuple[Side, Side] = (100, 100)
    """Rows and columns of cells, each of side 1."""
    step: Annotated[float, Setting(gt=0)] = 2.0
    """Longest implicit step in time."""


class Aquifer(ForwardModel):
    """A confined aquifer on a grid: its heads, and the logarithm of its transmissivity, a field to estimate."""

    Settings = AquiferSettings
    parameters = (
        Parameter("recharge", "1", bounds=(-np.inf, np.inf), label="recharge", symbol="$q$", source=SOURCE),
        Parameter("storage", "1", "lognormal", (0.0, np.inf), "storage coefficient", "$S$", source=SOURCE),
    )
    defaults: Mapping[str, float] = {"recharge": 0.01, "storage": 0.1}
    observables = (Observable("head", "1", StateField("head"), "$h$", label="head"),)
    time_unit = "1"

    def __init__(self, shape: tuple[int, int], step: float = 2.0):
        self.shape, self.longest, self.size = shape, step, shape[0] * shape[1]
        self.places = np.indices(shape, dtype=float).reshape(2, -1).T
        head = Field("head", self.size, coordinates=self.places, symbol="$h$")
        ln_T = Field("ln_T", self.size, coordinates=self.places, label="log transmissivity", symbol=r"$\ln T$")
        self.layout = StateLayout((head, ln_T, Field("recharge"), Field("storage")))

    @classmethod
    def from_settings(cls, settings: AquiferSettings) -> "Aquifer":
        return cls(settings.shape, settings.step)

    def initial_state(self, theta: Mapping[str, float]) -> Array:
        """No head anywhere, T = 1."""
        return np.concatenate([np.zeros(2 * self.size), [theta["recharge"], theta["storage"]]])

    def step(self, x: Array, t0: float, t1: float) -> Array:
        x[: self.size] = next(iter(self._heads(x, [t1 - t0])))
        return x

    def trajectories(self, x: Array, times: Array) -> Sequence[Trajectory | Failure]:
        own = np.broadcast_to(times, (len(x), np.shape(times)[-1]))
        return [self._path(state, instants) for state, instants in zip(x, own, strict=True)]

    def heads(self, fields: Array, cells: npt.NDArray[np.intp], times: Array) -> Array:
        """Heads (M, K) at ``cells`` (W,) and ``times`` (T,), all cells at each time, of fields ln T (M, n)."""
        states = np.tile(self.initial_state(self.defaults), (len(fields), 1))
        states[:, self.layout["ln_T"]] = fields
        return np.array([self._path(state, times)["head"][:, cells].ravel() for state in states])

    def _path(self, state: Array, times: Array) -> Trajectory:
        states = np.tile(np.asarray(state, dtype=float), (len(times), 1))
        for row, head in zip(states, self._heads(state, np.diff(np.maximum(times, 0.0), prepend=0.0)), strict=True):
            row[: self.size] = head
        return Trajectory(np.asarray(times, dtype=float), states, self.layout)

    def _heads(self, state: Array, durations: Sequence[float] | Array) -> list[Array]:
        """Heads (n,) after each of the durations, one after the other."""
        head, (recharge, storage) = state[: self.size].copy(), state[-2:]
        flow, heads = self.conductances(state[self.layout["ln_T"]]), list[Array]()
        solvers: dict[float, Callable[[Array], Array]] = {}
        for duration in durations:
            steps = math.ceil(duration / self.longest - 1e-9)
            rate = float(f"{storage * steps / duration:.12g}") if steps else 0.0  # of times as they are rounded, one
            for _ in range(steps):
                if rate not in solvers:
                    system = (identity(self.size, format="csc") * rate + flow).tocsc()
                    solvers[rate] = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve
                head = solvers[rate](head * rate + recharge)
            heads.append(head)
        return heads

    def conductances(self, field: Array) -> csc_matrix:
        """−∇·(T ∇·) (n, n): symmetric, with the boundary, half a cell away, at head 0."""
        T = np.exp(field).reshape(self.shape)
        diagonal, beside = np.zeros(self.shape), np.zeros((2, *self.shape))  # and what is next along each axis
        for axis in (0, 1):
            own, along = np.moveaxis(T, axis, 0), np.moveaxis(diagonal, axis, 0)
            between = 2 * own[:-1] * own[1:] / (own[:-1] + own[1:])
            along[:-1] += between
            along[1:] += between
            along[0] += 2 * own[0]
            along[-1] += 2 * own[-1]
            np.moveaxis(beside[axis], axis, 0)[:-1] = -between
        bands, places = [diagonal.ravel()], [0]
        for values, step in zip(beside, (self.shape[1], 1), strict=True):
            bands += [values.ravel()[:-step]] * 2
            places += [step, -step]
        matrix = diags(bands, places, format="csc")
        matrix.eliminate_zeros()  # from the end of one row to the next
        return matrix
