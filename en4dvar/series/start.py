"""The ensemble of a series at time zero: parameters from their prior, the state around what the model says of it.

It is Gaussian in coordinates of its own: logarithms of what is positive, parameters as their prior. The analysis moves
members along straight lines; in these coordinates none leaves the range of a parameter.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from en4dvar.model.forward import ForwardModel, initial_states
from en4dvar.model.state import Array
from en4dvar.plumbing.errors import En4dvarError
from en4dvar.plumbing.user_code import reason_of
from en4dvar.priors.prior import Prior, PriorTerm, member_stream, whiten_sample


@dataclass(frozen=True)
class EnsembleCoordinates:
    """``terms``: columns of the state and priors of the parameters that they hold; ``logarithms``: columns that are
    positive, and the ``lowest`` values, which these do not reach.
    """

    terms: tuple[tuple[int, PriorTerm], ...] = ()
    logarithms: tuple[int, ...] = ()
    lowest: tuple[float, ...] = ()

    @classmethod
    def of(cls, model: ForwardModel, prior: Prior | None, positive: Sequence[str] = ()) -> "EnsembleCoordinates":
        """For the parameters of ``prior`` that the state has fields of; fields named in ``positive`` by logarithms, of
        what they exceed a lower bound by, where they have one.
        """
        held = [term for term in (prior.terms if prior else ()) if term.parameter.name in model.layout.names]
        low = {field.name: max(0.0, field.bounds[0]) for field in model.layout}
        columns = [(c, low[name]) for name in positive for c in range(*model.layout[name].indices(model.layout.size))]
        return cls(
            tuple((model.layout[t.parameter.name].start, t) for t in held if t.transform != "normal"),
            tuple(column for column, _ in columns),
            tuple(lowest for _, lowest in columns),
        )

    def to_physical(self, x: Array) -> Array:
        """States (…, n) of a model from those of the ensemble."""
        if not self.terms and not self.logarithms:
            return x
        physical = np.array(x)
        with np.errstate(over="ignore"):
            for column, term in self.terms:
                physical[..., column] = term.to_physical(x[..., column])
            physical[..., self.logarithms] = self.lowest + np.exp(x[..., self.logarithms])
        return physical

    def from_physical(self, states: Array, origin: Array) -> Array:
        """The other way, of paths (N, K, n) that began at ``origin`` (N, n): parameters are constant along a path.

        The logarithm of what is not positive is not finite.
        """
        if not self.terms and not self.logarithms:
            return states
        coordinates = np.array(states)
        for column, _ in self.terms:
            coordinates[..., column] = origin[:, None, column]
        with np.errstate(invalid="ignore", divide="ignore"):
            coordinates[..., self.logarithms] = np.log(states[..., self.logarithms] - np.array(self.lowest))
        return coordinates


@dataclass(frozen=True)
class InitialEnsemble:
    """The prior at time zero: the model's initial state plus N(0, ``initial_std``²), by field, and the parameters.

    ``prior`` draws parameters, ``fixed`` are the values of the others. In the ensemble's coordinates, where a positive
    field is its logarithm, of which ``initial_std`` then is the standard deviation.
    """

    model: ForwardModel
    initial_std: Mapping[str, float]
    prior: Prior | None = None
    fixed: Mapping[str, float] = field(default_factory=dict)
    coordinates: EnsembleCoordinates = field(default_factory=EnsembleCoordinates)

    @property
    def drawn_size(self) -> int:
        """How many numbers of a member are drawn, of the prior and of the state."""
        free = sum(field.size for field in self.model.layout if self.initial_std.get(field.name, 0.0) > 0)
        return free + len(self.prior.terms if self.prior else ())

    def members(self, n_members: int, seed: int, exact: bool = False) -> Array:
        """(N, n_state) in the ensemble's coordinates, each from its own stream.

        ``exact``: mean and covariance are those that are drawn from, where there are enough members for that.
        """
        return self.drawn([member_stream(seed, "initial state", i) for i in range(n_members)], exact)

    def drawn(self, streams: Sequence[np.random.Generator], exact: bool = False) -> Array:
        """(N, n_state), as :meth:`members`, from random numbers of ``streams`` (N). Raises :class:`En4dvarError`."""
        model, prior, n = self.model, self.prior or Prior(()), len(streams)
        std = np.concatenate([np.full(f.size, self.initial_std.get(f.name, 0.0)) for f in model.layout])
        of_prior = np.array([stream.standard_normal(len(prior.terms)) for stream in streams])
        of_state = np.array([stream.standard_normal(model.layout.size) for stream in streams])
        free, m = std > 0, len(prior.terms)
        if exact and n > self.drawn_size:
            whole = whiten_sample(np.hstack([of_prior, of_state[:, free]]))
            of_prior, of_state[:, free] = whole[:, :m], whole[:, m:]
        x = prior.from_white(of_prior)
        origin = np.zeros((n, model.layout.size))
        for column, term in self.coordinates.terms:
            origin[:, column] = x[:, prior.names.index(term.parameter.name)]
        states = self.coordinates.from_physical(self._initial(prior, x)[:, None], origin)[:, 0]
        return np.asarray(states + std * of_state)

    def _initial(self, prior: Prior, x: Array) -> Array:
        """The model's states (N, n_state) for control vectors (N, n) of the prior."""
        model, n_members = self.model, len(x)
        theta = {name: np.full(n_members, value) for name, value in self.fixed.items()}
        theta |= dict(zip(prior.names, prior.to_physical(x).T, strict=True))
        try:
            states = np.array(initial_states(model, theta, n_members), dtype=float)
        except BaseException as error:  # a model may fail in any way
            raise En4dvarError(f"the initial state cannot be made: {reason_of(error)}") from error
        if states.shape != (n_members, model.layout.size):
            raise En4dvarError(
                f"initial_state returned shape {states.shape[1:]}, but the layout has ({model.layout.size},)"
            )
        return states
