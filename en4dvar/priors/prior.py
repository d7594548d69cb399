"""Priors: Gaussians in transformed space, physical values outside, never clipped.

Each parameter θ has a transform x = f(θ) to an unbounded coordinate in which its prior is N(mean, std²):

    normal     x = θ
    lognormal  x = ln θ                          θ > 0
    logit      x = ln((θ − a) / (b − θ))         a < θ < b
    uniform, half-normal, beta, bounded-…        x = Φ⁻¹(F(θ)), the Gaussian score (:mod:`en4dvar.priors.parameter_map`)

Parameters are independent but for those of a :class:`~en4dvar.priors.dependence.Dependence`, which are correlated in
transformed space.

Random numbers are counter-based (Philox; Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3"): the key is
(seed, parameter name), the counter is the member. Growing N leaves the first members' draws as they were, adding a
parameter leaves the others' draws as they were. Each data set of a run has a seed of its own, :func:`own_seed`.
"""

import hashlib
import math
import unicodedata
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Self

import numpy as np

from en4dvar.model.state import Array, Parameter, TransformName
from en4dvar.plumbing.errors import ConfigError
from en4dvar.priors import parameter_map
from en4dvar.priors.dependence import Dependence
from en4dvar.priors.parameter_map import QUANTILE_MAPS, Bounds, Numbers

Sampling = Literal["exact", "random"]
LARGEST = 1e150  # its square is a number still
LARGEST_LOG = 300.0  # std of a logarithm or logit: one std is 130 powers of ten
SHAPES = 0.1, 1e6  # smallest and largest α, β of a beta
UNREACHED = 8.0  # standard deviations from the mean, where a Gaussian has no probability to rounding
UNBOUNDED = 30.0  # the same, where a normal is cut on a side without a bound: scores are numbers up to there
RESOLVED = 1e-12  # of the mean: an ensemble that spreads by less has four digits at most


@dataclass(frozen=True)
class PriorTerm:
    """The prior of one parameter; ``mean`` and ``std`` are those of the transformed coordinate.

    Use the constructors, which take physical values. ``bounds`` (a, b) belong to ``logit`` and to the kinds of
    :mod:`en4dvar.priors.parameter_map`, and are physical; ``shape`` holds the other numbers of the latter.

    Raises :class:`ConfigError`: a value that defines no proper prior (std ≤ 0, median outside the bounds, …).
    """

    parameter: Parameter
    transform: TransformName
    mean: float
    std: float
    bounds: Bounds = (-math.inf, math.inf)
    shape: Numbers = ()

    def __post_init__(self) -> None:
        self._require(math.isfinite(self.mean), "the mean must be finite")
        positive = math.isfinite(self.std) and self.std > 0
        self._require(positive, f"the standard deviation must be positive, not {self.std:g}")
        # The ensemble must spread by more than rounding, its squares and physical values must be numbers
        around = abs(self.mean) if self.transform == "normal" else max(1.0, abs(self.mean))
        resolved = self.std > max(1 / LARGEST, RESOLVED * around)
        self._require(resolved, f"the standard deviation {self.std:g} is too small to be told from rounding")
        largest = LARGEST if self.transform == "normal" else LARGEST_LOG
        self._require(self.std < largest, f"the standard deviation {self.std:g} is too large; less than {largest:g}")
        self._require(abs(self.mean) < LARGEST, f"{self.mean:g} is too large; less than {LARGEST:g}")
        if self.transform == "logit":
            low, high = self.bounds
            finite = -math.inf < low < high < math.inf
            self._require(finite, f"logit needs finite bounds, low < high, not {self.bounds}")

    def _require(self, condition: bool, message: str) -> None:
        _require(self.parameter, condition, message)

    @property
    def log_std(self) -> float:
        """The standard deviation of the logarithm where that is normal, else 0."""
        return self.std if self.transform == "lognormal" else 0.0

    @classmethod
    def normal(cls, parameter: Parameter, mean: float, std: float) -> Self:
        """θ ~ N(mean, std²), both in the parameter's unit."""
        return cls(parameter, "normal", mean, std)

    @classmethod
    def lognormal(cls, parameter: Parameter, median: float, log_std: float) -> Self:
        """ln θ ~ N(ln median, log_std²); ``median`` in the parameter's unit, ``log_std`` dimensionless."""
        return cls(parameter, "lognormal", _log(parameter, "median", median), log_std)

    @classmethod
    def lognormal_moments(cls, parameter: Parameter, mean: float, std: float) -> Self:
        """The lognormal whose physical mean and standard deviation are ``mean`` and ``std``.

        >>> term = PriorTerm.lognormal_moments(Parameter("G", "Pa"), mean=2.0, std=1.0)
        >>> float(np.exp(term.mean + term.std**2 / 2))
        2.0
        """
        log_mean = _log(parameter, "mean", mean)
        _require(parameter, std > 0, f"the standard deviation must be positive, not {std:g}")
        beside = f"a standard deviation of {std:g} beside a mean of {mean:g} is too large"
        _require(parameter, std < LARGEST * mean, beside)
        variance = math.log1p((std / mean) ** 2)
        return cls(parameter, "lognormal", log_mean - variance / 2, math.sqrt(variance))

    @classmethod
    def logit(cls, parameter: Parameter, bounds: Bounds, median: float, logit_std: float) -> Self:
        """logit((θ − a)/(b − a)) ~ N(logit of the median, logit_std²); ``bounds`` and ``median`` physical."""
        low, high = bounds
        inside = -math.inf < low < median < high < math.inf
        _require(parameter, inside, f"the median {median:g} must lie between finite bounds, not {bounds}")
        return cls(parameter, "logit", math.log((median - low) / (high - median)), logit_std, (low, high))

    @classmethod
    def uniform(cls, parameter: Parameter, bounds: Bounds) -> Self:
        """θ equally likely everywhere between finite physical ``bounds``."""
        return cls._by_quantiles(parameter, "uniform", bounds, ())

    @classmethod
    def half_normal(cls, parameter: Parameter, std: float, low: float = 0.0) -> Self:
        """θ = low + |N(0, std²)|, in the parameter's unit; ``std`` is that of the whole Gaussian."""
        term = cls._by_quantiles(parameter, "half-normal", (low, math.inf), (std,))
        around = max(abs(low), 1 / LARGEST)
        term._require(RESOLVED * around < std < LARGEST, f"a standard deviation of {std:g} beside {low:g}")
        return term

    @classmethod
    def beta(cls, parameter: Parameter, bounds: Bounds, alpha: float, beta: float) -> Self:
        """(θ − a)/(b − a) ~ Beta(alpha, beta) between finite physical ``bounds`` (a, b)."""
        for name, value in (("alpha", alpha), ("beta", beta)):
            words = f"{name} must lie between {SHAPES[0]:g} and {SHAPES[1]:g}, not {value:g}"
            _require(parameter, SHAPES[0] <= value <= SHAPES[1], words)
        return cls._by_quantiles(parameter, "beta", bounds, (alpha, beta))

    @classmethod
    def bounded(
        cls, parameter: Parameter, kind: Literal["normal", "lognormal"], mean: float, std: float, bounds: Bounds
    ) -> Self:
        """:meth:`normal` of ``mean`` and ``std``, or :meth:`lognormal` of median and log_std, between ``bounds``; of a
        normal either may be infinite, and the lower one of a lognormal 0, which it does not reach anyway."""
        whole = cls.normal(parameter, mean, std) if kind == "normal" else cls.lognormal(parameter, mean, std)
        low, high = bounds
        if kind == "lognormal" and low == 0:
            low = math.exp(whole.mean - (UNREACHED + 1) * std)
        if kind == "normal":
            low = mean - UNBOUNDED * std if low == -math.inf else low
            high = mean + UNBOUNDED * std if high == math.inf else high
        whole._require(low <= mean <= high and low < high, f"{mean:g} does not lie between the bounds {bounds}")
        whole._require(kind == "normal" or low > 0, f"the bounds of a logarithm must be positive, not {bounds}")
        a, b = (low, high) if kind == "normal" else (math.log(low), math.log(high))
        shape = ((a - whole.mean) / std, (b - whole.mean) / std, *((b - a,) if kind == "lognormal" else ()))
        wide = shape[1] - shape[0] > 1e-6 and shape[-1] < LARGEST_LOG
        whole._require(wide, f"the bounds {bounds} do not suit the standard deviation {std:g}; use a uniform prior")
        name: TransformName = "bounded-normal" if kind == "normal" else "bounded-lognormal"
        return cls._by_quantiles(parameter, name, (low, high), shape)

    @classmethod
    def _by_quantiles(cls, parameter: Parameter, kind: TransformName, bounds: Bounds, shape: Numbers) -> Self:
        (low, high), term = bounds, cls(parameter, kind, 0.0, 1.0, bounds, shape)
        finite = math.isfinite(low) and (math.isfinite(high) or not QUANTILE_MAPS[kind].upper)
        term._require(finite and low < high, f"{kind} needs finite bounds, low < high, not {bounds}")
        return term

    @property
    def range(self) -> tuple[float, float]:
        """Physical limits that θ does not reach, ±inf where there are none."""
        return (0.0, math.inf) if self.transform == "lognormal" else self.bounds

    @property
    def has_bound(self) -> bool:
        """True if the map, rather than the parameter, sets a limit at which the prior has probability."""
        return self.transform == "logit" or self.transform in QUANTILE_MAPS

    @property
    def unreached(self) -> tuple[bool, bool]:
        """True of the lower, the upper bound that has no prior probability beside it: zero is infinitely far from a
        logarithm that is not cut off below."""
        low, high = self.shape[:2] if self.transform in ("bounded-normal", "bounded-lognormal") else (0.0, 0.0)
        return self.transform == "lognormal" or low < -UNREACHED, high > UNREACHED

    def slope(self, x: float) -> float:
        """dθ/dx of the parameter map at a transformed value."""
        if self.transform in QUANTILE_MAPS:
            return parameter_map.slope(self.transform, x, self.bounds, self.shape)
        theta = float(self.to_physical(np.array(x)))
        if self.transform == "logit":
            low, high = self.bounds
            return (theta - low) * (high - theta) / (high - low)
        return theta if self.transform == "lognormal" else 1.0

    def to_physical(self, x: Array) -> Array:
        """θ for transformed values ``x`` of any shape; overflow gives inf, which no model accepts as a value. Between
        bounds: what would be rounded to one of them stays on this side of it.
        """
        x = np.asarray(x, dtype=float)
        if self.transform == "normal":
            return x
        if self.transform == "lognormal":
            with np.errstate(over="ignore"):
                return np.asarray(np.exp(x))
        low, high = self.bounds
        if self.transform in QUANTILE_MAPS:
            theta = parameter_map.value(self.transform, x, self.bounds, self.shape)
        else:  # from the nearer bound, so that values close to it keep their relative precision
            theta = np.where(x < 0, low + (high - low) * _sigmoid(x), high - (high - low) * _sigmoid(-x))
        return np.clip(theta, np.nextafter(low, high), np.nextafter(high, low) if high < math.inf else high)

    def from_physical(self, theta: Array) -> Array:
        """x for physical values ``theta`` of any shape. Raises ValueError: one beyond the range of the transform."""
        theta = np.asarray(theta, dtype=float)
        if self.transform == "normal":
            return theta
        low, high = self.range
        if not np.all((theta > low) & (theta < high)):
            raise ValueError(f"{self.parameter.name}: values must lie strictly between {low:g} and {high:g}")
        if self.transform in QUANTILE_MAPS:
            return parameter_map.score(self.transform, theta, self.bounds, self.shape)
        return np.asarray(np.log(theta) if self.transform == "lognormal" else np.log((theta - low) / (high - theta)))


@dataclass(frozen=True)
class Prior:
    """Prior terms, independent but for the parameters of ``blocks``; the control vector holds them in this order.

    ``mean`` and ``std`` are those of each coordinate by itself; white coordinates z ~ N(0, I): see :meth:`white`.
    """

    terms: tuple[PriorTerm, ...]
    blocks: tuple[Dependence, ...] = ()

    def __post_init__(self) -> None:
        if len(set(self.names)) != len(self.names):
            raise ConfigError(f"prior: a parameter is given twice in {', '.join(self.names)}")
        correlated = [name for block in self.blocks for name in block.names]
        if len(set(correlated)) != len(correlated):
            raise ConfigError("prior: a parameter is in two blocks of correlated ones")
        if missing := set(correlated) - set(self.names):
            raise ConfigError(f"prior: {', '.join(sorted(missing))} is correlated, but not estimated")

    def of(self, terms: tuple[PriorTerm, ...]) -> "Prior":
        """The prior of other ``terms``, with the correlations that this prior has between those it knows."""
        names = {term.parameter.name for term in terms}
        return Prior(terms, tuple(kept for block in self.blocks if (kept := block.among(tuple(names)))))

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The estimated parameters in the order of the control vector."""
        return tuple(term.parameter for term in self.terms)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the control vector."""
        return tuple(p.name for p in self.parameters)

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest physical values (n,) that the parameters allow."""
        return np.array([p.bounds[0] for p in self.parameters]), np.array([p.bounds[1] for p in self.parameters])

    @cached_property
    def mean(self) -> Array:
        """(n,) in transformed space."""
        return np.array([term.mean for term in self.terms])

    @cached_property
    def std(self) -> Array:
        """(n,) in transformed space."""
        return np.array([term.std for term in self.terms])

    def to_physical(self, x: Array) -> Array:
        """Physical values (…, n) of control vectors ``x`` (…, n)."""
        theta = np.array(x, dtype=float)
        for j, term in enumerate(self.terms):
            if term.transform != "normal":
                column = theta[..., j : j + 1]  # none of control vectors that are empty
                column[...] = term.to_physical(column)
        return theta

    def from_physical(self, theta: Array) -> Array:
        """Control vectors (…, n) of physical values ``theta`` (…, n). Raises ValueError outside a transform's range."""
        return np.stack([term.from_physical(theta[..., j]) for j, term in enumerate(self.terms)], axis=-1)

    @cached_property
    def _placed(self) -> tuple[tuple[list[int], Dependence], ...]:
        """Each block with the columns of its parameters."""
        columns = {name: j for j, name in enumerate(self.names)}
        return tuple(([columns[name] for name in block.names], block) for block in self.blocks)

    def white(self, x: Array) -> Array:
        """White coordinates z (…, n) of control vectors ``x`` (…, n): N(0, I) under the prior."""
        return self.white_change(x - self.mean)

    def white_change(self, dx: Array) -> Array:
        """Changes (…, n) of the white coordinates for changes ``dx`` (…, n) of control vectors."""
        z = np.asarray(dx / self.std)
        for columns, block in self._placed:
            z[..., columns] = block.whitened(z[..., columns])
        return z

    def from_white(self, z: Array) -> Array:
        """Control vectors (…, n) of white coordinates ``z`` (…, n)."""
        return np.asarray(self.mean + self.from_white_change(z))

    def from_white_change(self, dz: Array) -> Array:
        """Changes (…, n) of control vectors for changes ``dz`` (…, n) of the white coordinates."""
        if not self.blocks:
            return np.asarray(self.std * dz)
        y = np.array(dz, dtype=float)
        for columns, block in self._placed:
            y[..., columns] = y[..., columns] @ block.root.T
        return np.asarray(self.std * y)

    def white_covariance(self, covariance: Array) -> Array:
        """A covariance (n, n) of control vectors in white coordinates."""
        scaled = covariance / np.outer(self.std, self.std)
        for columns, block in self._placed:
            scaled[columns] = block.whitened(scaled[columns].T).T
            scaled[:, columns] = block.whitened(scaled[:, columns])
        return np.asarray(scaled)

    @cached_property
    def log_det_root(self) -> float:
        """½ ln det of the prior covariance in transformed space."""
        of_blocks = sum(float(np.sum(np.log(np.diag(block.root)))) for block in self.blocks)
        return float(np.sum(np.log(self.std))) + of_blocks

    def cost(self, x: Array) -> Array:
        """J_b (…,) of control vectors ``x`` (…, n): ½ ‖z‖² of their white coordinates z."""
        return np.asarray(0.5 * np.sum(self.white(x) ** 2, axis=-1))

    def log_density(self, x: Array) -> Array:
        """Normalised log density (…,) in transformed space of control vectors ``x`` (…, n)."""
        return -self.cost(x) - (self.log_det_root + 0.5 * len(self.terms) * math.log(2 * math.pi))

    def sample(self, n_members: int, seed: int, method: Sampling = "exact") -> Array:
        """Prior ensemble (N, n) in transformed space.

        ``random``: independent draws. ``exact``: the same draws, affinely corrected so that the sample mean and
        covariance are the prior's (second-order-exact). An ensemble that a block brings along takes the place of the
        draws of its parameters where it has N members. The correction is a Gram–Schmidt process in the order of the
        parameters: one added at the end leaves the others as they were, but growing N moves every member.

        Raises :class:`ConfigError`: fewer than 2 members, or ``exact`` with fewer than n + 1.
        """
        n = len(self.terms)
        needed = n + 1 if method == "exact" else 2
        if n_members < needed:
            raise ConfigError(f"sampling {method!r} of {n} parameters needs at least {needed} members, not {n_members}")
        z = np.column_stack([standard_normal(seed, name, n_members) for name in self.names])
        for columns, block in self._placed:
            if block.members is not None and len(block.members) == n_members:
                z[:, columns] = block.whitened(block.members)
        if method == "exact":
            z = whiten_sample(z)
        return self.from_white(z)


def own_seed(seed: int, name: str) -> int:
    """The seed of the data set ``name`` in a run of ``seed``: the same alone, among others, in any order.

    With one seed for all sets of a campaign the errors of N draws (their quantiles, say) would be common to all, and no
    number of sets would average them out.
    """
    named = f"{seed}/data set {unicodedata.normalize('NFC', name)}"  # however the file system encodes an accent
    return int.from_bytes(hashlib.blake2b(named.encode(), digest_size=6).digest(), "little")


def standard_normal(seed: int, name: str, n_members: int) -> Array:
    """One N(0, 1) number per member (N,), the first of :func:`member_stream` of (seed, name, member)."""
    stream = member_stream(seed, name)
    bits = stream.bit_generator
    state, draws = bits.state, np.empty(n_members)
    for member in range(n_members):  # to move a generator takes a fifth of the time of making one
        state["state"]["counter"][3] = member
        bits.state = state
        draws[member] = stream.standard_normal()
    return draws


def member_stream(seed: int, name: str, member: int = 0) -> np.random.Generator:
    """The stream of random numbers that belongs to (seed, name, member) and to nothing else."""
    digest = hashlib.blake2b(f"{seed}/{name}".encode(), digest_size=16).digest()
    key = np.frombuffer(digest, dtype="<u8").astype(np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=np.array([0, 0, 0, member], dtype=np.uint64)))


def whiten_sample(z: Array) -> Array:
    """Members (N, n) with zero mean and unit sample covariance, column j made from columns 0…j."""
    q, r = np.linalg.qr(z - z.mean(axis=0))
    q = q * np.sign(np.diag(r))
    return np.asarray(math.sqrt(len(z) - 1) * (q - q.mean(axis=0)))


def _sigmoid(x: Array) -> Array:
    return np.asarray(np.exp(-np.logaddexp(0.0, -x)))


def _log(parameter: Parameter, what: str, value: float) -> float:
    _require(parameter, value > 0, f"the {what} of a lognormal must be positive, not {value:g}")
    return math.log(value)


def _require(parameter: Parameter, condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(f"prior of {parameter.name}: {message}")
