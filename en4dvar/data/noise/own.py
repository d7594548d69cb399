"""Kinds of errors that somebody else wrote: what :class:`Noise` promises is tried on a few residuals before it is used.

A wrong ``influence``, norm or width would give a wrong posterior without a word.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from en4dvar.data.noise.gaussian import GRID, WIDTHS, Linearisation, Noise, Predicted
from en4dvar.model.state import Array, floats
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.plumbing.hints import shown
from en4dvar.plumbing.user_code import line_of, reason_of

RESIDUALS = (0.31, -0.77, 1.43, -2.9, 0.11, 5.3, -1.9)  # whitened, at which it is tried
STEP, CLOSE = 1e-4, 1e-3  # of a finite difference, and how well it is the slope
APART = 0.02  # by which an integral may differ
DRAWS, MOST = 4000, 2000  # numbers that are drawn; readings over whose densities is integrated


def require_sound(noise: Noise, weights: Array) -> None:
    """Raise :class:`ValueError` where a kind of errors of somebody else's is not what :class:`Noise` promises."""
    if not type(noise).__module__.startswith("en4dvar.data.noise"):
        _Trial(noise, weights)()


class _Trial:
    def __init__(self, noise: Noise, weights: Array):
        self.noise, self.weights, self.who = noise, weights, type(noise).__name__
        self.v = np.resize(RESIDUALS, len(weights))
        self.m = -noise.std * self.v  # predictions, of readings that are zero
        self.y = np.zeros_like(self.v)

    def __call__(self) -> None:
        if not isinstance(self.noise.words, str):
            raise ValueError(f"{self.who}: words is {shown(self.noise.words)}; it is a text")
        for name in ("counts_within", "scale_information"):
            number = self.called(name, partial(getattr, self.noise, name))
            if not isinstance(number, int | float):
                raise ValueError(f"{self.who}: {name} is {shown(number)}; it is a number, or a property that gives one")
        for method in ("influence", "_loss"):
            self.numbers(method, (2, len(self.v)), np.stack([self.v, -self.v]))
        frozen = self.called("frozen", lambda: self.noise.frozen(Predicted(self.m)))
        if not isinstance(frozen, Noise):
            raise ValueError(f"{self.who}: frozen gives {shown(frozen)}; it gives a Noise")
        self.require_slope()
        if self.noise.quadratic:
            self.require_parabola()
        if self.noise.independent and type(self.noise).log_likelihood is Noise.log_likelihood and len(self.v) <= MOST:
            self.require_density()
        self.require_draws()

    def called(self, method: str, call: Callable[[], Any]) -> Any:
        """What a call of a method gives. Raises :class:`ValueError`, and errors of ours as they are."""
        try:
            return call()
        except En4dvarError:
            raise
        except BaseException as error:
            raise ValueError(f"{self.who}: {method} raises {reason_of(error)}{line_of(error)}") from error

    def numbers(self, method: str, shape: tuple[int, ...], *arguments: Any) -> Array:
        """Real numbers of a ``shape`` that a method gives."""
        raw = self.called(method, lambda: getattr(self.noise, method)(*arguments))
        values = self.called(method, lambda: floats(raw))
        if values.shape != shape or not np.isfinite(values).all():
            came = f"shape {values.shape}" if values.shape != shape and raw is not None else shown(raw)
            raise ValueError(f"{self.who}: {method} gives {came}; it gives finite numbers of shape {shape}")
        return np.asarray(values)

    def costs(self, *steps: float) -> Array:
        along = self.m + np.multiply.outer(np.array(steps), self.noise.std)
        return self.numbers("cost", (len(steps),), self.y, self.weights, Predicted(along))

    def require_slope(self) -> None:
        """∇J_o = −Sᵀd, of predictions that move by one standard deviation each."""
        at = Linearisation(Predicted(self.m), self.noise.std[None])
        d, rows = self.called("whiten", lambda: self.noise.whiten(self.y, self.weights, at))
        low, high = self.costs(-STEP, STEP)
        by_cost, by_rows = (high - low) / (2 * STEP), -float(rows[:, 0] @ d)
        if abs(by_cost - by_rows) > CLOSE * np.sum(self.weights * np.abs(self.v)):
            why = "influence(v) is ρ′(v)/v of the ρ(v) that _loss gives"
            raise ValueError(f"{self.who}: its cost has the slope {by_cost:.4g}, its whiten says {by_rows:.4g}; {why}")

    def require_parabola(self) -> None:
        costs = self.costs(0, 1, 2, 3)
        if abs(costs @ (-1, 3, -3, 1)) > CLOSE * np.ptp(costs):
            why = "counts_within is the |v| up to which influence is 1, and inf for ½ v² alone"
            raise ValueError(f"{self.who}: it says that its cost is quadratic, which it is not; {why}")

    def require_density(self) -> None:
        """The density of each reading integrates to one."""
        shape, at = (len(GRID), len(self.v)), Predicted(np.multiply.outer(GRID, self.noise.std))
        density = np.exp(self.numbers("log_likelihood", shape, self.y, at)) * self.noise.std
        whole = WIDTHS @ density
        if np.max(np.abs(whole - 1)) > APART:
            why = "_log_norm is ln ∫ exp(−ρ(v)) dv"
            raise ValueError(f"{self.who}: its density integrates to {whole[np.argmax(np.abs(whole - 1))]:.4g}; {why}")

    def require_draws(self) -> None:
        """E[v ρ′] = 1 over readings that are drawn, and E[(v ρ′ − 1)²] is what it says."""
        try:
            shape = (-(-DRAWS // len(self.v)), len(self.v))
            at = Predicted(np.zeros(shape))
            drawn = self.numbers("drawn", shape, at, np.random.default_rng(0))
        except En4dvarError:  # it says that it cannot be drawn
            return
        squares = self.numbers("squares", shape, drawn, at)
        mean, width = float(squares.mean()), float(squares.std() / np.sqrt(squares.size))
        if abs(mean - 1) > 5 * width + APART:
            why = "_white draws v from the density exp(−ρ(v))"
            raise ValueError(f"{self.who}: v ρ′(v) is {mean:.4g} on average over what drawn gives, not 1; {why}")
        said, by_draws = float(self.noise.scale_information), float(np.mean((squares - 1) ** 2))
        error = float(np.std((squares - 1) ** 2) / np.sqrt(squares.size))
        if self.noise.independent and abs(said - by_draws) > 5 * error + APART:
            why = "it is E[(v ρ′(v) − 1)²]"
            raise ValueError(f"{self.who}: scale_information is {said:.4g}, by draws {by_draws:.4g}; {why}")
