"""Estimates of several data sets ⇄ files, with what each data set said alone: ``joint.nc`` (members of what is shared
and of each one's own, the fits), ``population.nc`` (draws of mean, spread and the next one, those of each given all).
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from en4dvar.diagnosis.diagnostics import member_quantiles
from en4dvar.estimation.joint.estimate import JointEstimate
from en4dvar.estimation.joint.problem import EVERYONE, JointProblem
from en4dvar.estimation.population.campaign import Combination, Draws, Population
from en4dvar.model.state import Array, Parameter
from en4dvar.plumbing.caution import Caution, parsed, worst_first
from en4dvar.plumbing.errors import OutputError
from en4dvar.plumbing.hints import free_name, natural
from en4dvar.plumbing.units import convert
from en4dvar.priors.prior import PriorTerm
from en4dvar.problem import InverseProblem
from en4dvar.results.checkpoint import digest
from en4dvar.results.declared import Names, Stored, parameter_of, text
from en4dvar.results.netcdf import Group, Variable, read_groups, to_bytes, understood, variable

JOINT, POPULATION = "joint.nc", "population.nc"
GROUPS = "groups"  # the folder of a run directory that holds one folder a group, each with its POPULATION
QUANTILES = (0.05, 0.5, 0.95)
DRAWS = ("chain", "draw")


def save_joint(path: Path, estimate: JointEstimate, alone: Sequence[Array], attributes: Mapping[str, Any]) -> Path:
    """Write the file. ``alone``: physical members (N_i, n_i) of each data set. Raises :class:`OutputError`."""
    names = [experiment.observations.name for experiment in estimate.joint.experiments]
    datasets = {"dataset": variable("dataset", text(names), "", "data set")}
    root = {
        **attributes,
        "converged": int(estimate.converged),
        "stop_reason": estimate.stop_reason,
        "log_evidence": estimate.log_evidence,
        "forward_runs": estimate.forward_runs,
        "effective_draws": estimate.members.effective,
        "warnings": _lines(estimate.cautions),
    }
    prior, of_each, of_shared = {}, {}, shared_names(estimate.joint)
    for key, term in zip(estimate.joint.shared, estimate.joint.terms, strict=True):
        own = [m if of.get(key[0]) == key[1] else None for m, of in zip(alone, estimate.joint.groups, strict=True)]
        of_each[of_shared[key]] = _alone(term.parameter, estimate.joint.experiments, own)
        quantiles = term.to_physical(term.mean + term.std * np.array([-1.6448536, 0.0, 1.6448536]))
        prior[of_shared[key]] = variable("quantile", quantiles, term.parameter.unit, "prior")
    groups = {
        "/": Group(attrs=root),
        "/posterior": Group(_shared(estimate, of_shared) | _own(estimate, names, of_shared), datasets),
        "/prior": Group(prior),
        "/alone": Group(of_each, datasets),
        "/fit": Group(_fit(estimate, names), datasets),
    }
    if estimate.without:
        rest, kept = estimate.rest, list(estimate.rest.joint.names)
        others, warned = {"dataset": variable("dataset", text(kept), "", "data set")}, _lines(rest.cautions)
        groups["/without"] = Group(_shared(rest, of_shared) | _own(rest, kept, of_shared), others, {"warnings": warned})
    return to_bytes(groups).write(path)


def _lines(cautions: Sequence[Caution]) -> str:
    return "\n".join(c.line for c in worst_first(cautions))


def shared_names(joint: JointProblem) -> dict[tuple[str, str], str]:
    """Variable of each shared quantity: its name, and its group where that is not everyone; a number tells apart groups
    that differ in signs alone.
    """
    names: dict[tuple[str, str], str] = {}
    for name, group in sorted(joint.shared, key=lambda key: key[1] != EVERYONE):
        plain = "".join(c if c.isalnum() else "_" for c in group)
        names[name, group] = free_name(f"{name}_{plain}" if plain else name, names.values())
    return names


def of_parameter(p: Parameter, dims: str | tuple[str, ...], values: Any, words: str = "", **more: Any) -> Variable:
    """A variable of a parameter, with how it is shown; ``words``: its meaning, by default the parameter's label."""
    return variable(dims, values, p.unit, words or p.label, symbol=p.symbol, display_units=p.display_unit, **more)


def _shared(estimate: JointEstimate, names: Mapping[tuple[str, str], str]) -> dict[str, Variable]:
    variables = {}
    for j, (key, term) in enumerate(zip(estimate.joint.shared, estimate.joint.terms, strict=True)):
        label = ", ".join(filter(None, (term.parameter.label, key[1])))
        members, mode = estimate.shared[None, :, j], float(estimate.shared_mode[j])
        variables[names[key]] = of_parameter(term.parameter, DRAWS, members, label, mode=mode)
    return variables


def _alone(p: Parameter, problems: Sequence[InverseProblem], alone: Sequence[Array | None]) -> Variable:
    """Quantiles (dataset, quantile) of a parameter as each data set has it by itself; NaN of those without members."""
    rows = np.full((len(alone), len(QUANTILES)), np.nan)
    for row, problem, members in zip(rows, problems, alone, strict=True):
        if members is not None:
            row[:] = member_quantiles(members[:, problem.prior.names.index(p.name)], QUANTILES)
    return variable(("dataset", "quantile"), rows, p.unit, "5, 50 and 95 % of a data set alone")


def _own(estimate: JointEstimate, names: Sequence[str], shared: Mapping[tuple[str, str], str]) -> dict[str, Variable]:
    """(chain, draw, dataset) of the parameters that data sets have of their own, NaN where one has it not."""
    count = len(estimate.members.border)
    values: dict[str, Array] = {}
    parameters: dict[str, Parameter] = {}
    for e, experiment in enumerate(estimate.joint.experiments):
        members = estimate.control(e)[:-1]
        for j in estimate.joint.columns(e)[1]:
            p = experiment.prior.parameters[j]
            values.setdefault(p.name, np.full((1, count, len(names)), np.nan))[0, :, e] = members[:, j]
            parameters[p.name] = p
    taken = set(shared.values())
    return {
        f"{name}_own" if name in taken else name: of_parameter(parameters[name], (*DRAWS, "dataset"), array)
        for name, array in values.items()
    }


def _fit(estimate: JointEstimate, names: Sequence[str]) -> dict[str, Variable]:
    """Observations and bands of each data set, padded with NaN, in display units; and each against all others. Bands
    are those without the odd data sets, but of these.
    """
    experiments, agreed = estimate.joint.experiments, estimate.agreement
    most = max(len(experiment.observations) for experiment in experiments)
    times, values = np.full((2, len(experiments), most), np.nan)
    bands = np.full((len(experiments), max(map(len, estimate.grids)), 4), np.nan)
    runs = dict(zip(names, estimate.forecasts, strict=True))
    runs |= zip(estimate.rest.joint.names, estimate.rest.forecasts, strict=True)
    for e, (experiment, run, grid) in enumerate(zip(experiments, runs.values(), estimate.grids, strict=True)):
        to_time = (experiment.model.time_unit, experiment.model.time_display_unit)
        to_value = (experiment.observable.unit, experiment.observable.display_unit)
        k = len(experiment.observations)
        times[e, :k] = convert(experiment.observations.times, *to_time)
        values[e, :k] = convert(experiment.observations.values, *to_value)
        bands[e, : len(grid), 0] = convert(grid, *to_time)
        alive = run.path[:-1][run.active[:-1]]
        bands[e, : len(grid), 1:] = convert(member_quantiles(alive, QUANTILES, axis=0).T, *to_value)
    observables = [experiment.observable for experiment in experiments]
    chi2 = "misfit per observation at the mode, without the odd data sets but of these"
    apart = "from the value of all others, in standard deviations"
    odd = [int(name in estimate.odd) for name in names]
    return {
        "chi2_per_observation": variable("dataset", estimate.chi2, "1", chi2),
        "alive": variable("dataset", [run.active[:-1].sum() for run in runs.values()], "1", "members that ran"),
        "observable": variable("dataset", text(o.label for o in observables), "", "what was observed"),
        "unit": variable("dataset", text(o.display_unit for o in observables), "", "unit of values and bands"),
        "time_unit": variable("dataset", text(e.model.time_display_unit for e in experiments), "", "unit of times"),
        "time": variable(("dataset", "observation"), times, "1", "times of the observations"),
        "value": variable(("dataset", "observation"), values, "1", "observations"),
        "band": variable(("dataset", "point", "what"), bands, "1", "time; 5, 50 and 95 % of the members there"),
        "distance": variable("dataset", np.sqrt(agreed.squares), "1", apart),
        "chance": variable("dataset", agreed.chances, "1", "probability of a larger distance if all share one value"),
        "odd": variable("dataset", odd, "1", "1: left out in the group without"),
    }


class StoredGroups(Stored):
    """A file about several data sets together."""

    what: ClassVar[str]
    needed: ClassVar[tuple[str, ...]]  # groups
    read: ClassVar[tuple[str, ...]]  # what is looked at as the file is read

    @property
    def datasets(self) -> tuple[str, ...]:
        return tuple(map(str, self.group("alone")["dataset"].values))

    @property
    def doubts(self) -> tuple[Caution, ...]:
        """Warnings of what is to be quoted, the worst first."""
        return self.cautions

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read the file into memory. Raises :class:`OutputError`: it is none, cut short or altered."""
        held = read_groups(path)
        if {f"/{group}" for group in cls.needed} - set(held):
            raise OutputError(f"{path}: not {cls.what}")
        with understood(path):
            stored = cls(held)
            for key in ("datasets", "cautions", *cls.read):
                getattr(stored, key)
        return stored


class StoredJoint(StoredGroups):
    """A file of :func:`save_joint`: the groups ``needed`` and, without odd data sets, ``without``."""

    what = "a joint estimate"
    needed = ("posterior", "prior", "alone", "fit")
    read = ("odd",)

    @property
    def shared(self) -> tuple[str, ...]:
        """Names of the variables of what is shared."""
        return tuple(self.group("prior").variables)

    @property
    def odd(self) -> tuple[str, ...]:
        """Names of the data sets that do not share the values of the others."""
        fit = self.group("fit")  # of which a file of an earlier version has no such column
        odd = fit["odd"].values if "odd" in fit else np.zeros(len(self.datasets))
        return tuple(name for name, is_odd in zip(self.datasets, odd, strict=True) if is_odd)

    @property
    def rest(self) -> Group:
        """The posterior, without the odd data sets where there are any."""
        return self.group("without" if self.odd else "posterior")

    @property
    def doubts(self) -> tuple[Caution, ...]:
        """Warnings of the estimate without the odd data sets, the worst first."""
        return parsed(self.rest.attrs["warnings"]) if self.odd else self.cautions


load_joint = StoredJoint.load


WORDS = {
    "median": "median of the population",
    "mean": "mean of the population",
    "between": "standard deviation between data sets",
    "next": "the next one",
}
HEADLINE = "median"


def save_population(
    path: Path, population: Population, alone: Sequence[Array], cautions: Sequence[Caution],
    attributes: Mapping[str, Any],
) -> Path:  # fmt: skip
    """Write the file. ``alone``: physical members (N_i, n) of each data set. Raises :class:`OutputError`."""
    observed = [problem.observations for problem in population.problems]
    datasets = {"dataset": variable("dataset", text(o.name for o in observed), "", "data set")}
    free, effective = population.without_hyperprior(int(attributes["seed"]))
    combinations = (  # "0.05 G 1 alpha 0.98": the standard deviation, then names and exponents
        " ".join([f"{c.std:.17g}", *(f"{name} {exponent:.17g}" for name, exponent in c.parts)])
        for c in population.combinations()
    )
    root = {
        **attributes,
        "parameters": " ".join(population.names),
        "hyperprior_mean_std": population.hyper.mean_std,
        "hyperprior_spread": population.hyper.spread,
        "hyperprior_odd": population.hyper.odd,
        "common": " ".join(population.common),
        "effective_draws": population.size,
        "effective_draws_without_hyperprior": effective,
        "log_evidence": population.log_evidence - sum(o.log_normalisation() for o in observed),
        "forward_runs": population.forward_runs,
        "combinations": "\n".join(combinations),
        "warnings": _lines(cautions),
    }
    beside = {p.name: _alone(p, population.problems, alone) for p in (term.parameter for term in population.terms)}
    if len(population.belongs):
        words = "probability that the data set is of the population"
        beside["belongs"] = variable("dataset", population.belongs, "1", words)
        words = "probability that it is not, before its data are seen"
        beside["odd_before"] = variable("dataset", population.odd_before, "1", words)
    digests = text(digest(o.times.tobytes() + o.values.tobytes()) for o in observed)  # of the same readings the same
    beside["readings"] = variable("dataset", digests, "", "SHA-256 of times and values of the readings")
    groups = {
        "/": Group(attrs=root),
        "/posterior": Group(_draws(population, population.posterior) | _sets(population), datasets),
        "/prior": Group(_draws(population, population.prior)),
        "/without_hyperprior": Group(_draws(population, free)),
        "/white": Group(_white(population)),
        "/alone": Group(beside, datasets),
        "/empirical": Group(_empirical(population)),
    }
    return to_bytes(groups).write(path)


def _draws(population: Population, draws: Draws) -> dict[str, Variable]:
    of_centre, of_spread = population.learned
    learned = {"median": of_centre, "mean": of_centre, "between": of_spread}
    result = {}
    for j, term in enumerate(population.terms):
        p = term.parameter
        for what, words in WORDS.items():
            more: dict[str, Any] = {"label": p.label, "transform": term.transform}
            if what in learned:
                more["learned"] = float(learned[what][j])
            if what == HEADLINE and draws is population.posterior:
                more["std_between"], more["std_common"] = (float(part[j]) for part in population.parts)
            values, words = getattr(draws, what)[None, :, j], f"{p.label}: {words}"
            result[f"{p.name}_{what}"] = of_parameter(p, DRAWS, values, words, **more)
    return result


def _white(population: Population) -> dict[str, Variable]:
    """(chain, draw) of the centres and of what is common in units of their priors, as the draws of ``posterior``."""
    first, draws = population.problems[0].prior, (population.posterior.nu, population.theta)
    columns = np.hstack([part for part in draws if part.size])
    white = {}
    for j, name in enumerate((*population.names, *population.common)):
        term = first.terms[first.names.index(name)]
        prior = json.dumps([term.transform, term.mean, term.std, [*term.bounds], [*term.shape]])
        white[name] = variable(DRAWS, columns[None, :, j], "1", f"{name} in units of its prior", prior=prior)
    return white


def _empirical(population: Population) -> dict[str, Variable]:
    """(quantile,) of the median over the data sets one by one."""
    result = {}
    for term, median in zip(population.terms, population.empirical, strict=True):
        p = term.parameter
        words = f"{p.label}: 5, 50 and 95 % of the median of the data sets one by one"
        parts = {"label": p.label, "std_between": median.between, "std_common": median.common}
        result[p.name] = of_parameter(p, "quantile", median.quantiles, words, **parts)
    return result


def _sets(population: Population) -> dict[str, Variable]:
    """(chain, draw, dataset) of every parameter, given all data."""
    terms: tuple[PriorTerm, ...] = population.problems[0].constant.prior.terms
    return {
        p.name: of_parameter(p, (*DRAWS, "dataset"), population.sets[None, :, :, j], label=p.label)
        for j, p in enumerate(term.parameter for term in terms)
    }


class StoredPopulation(StoredGroups):
    """A file of :func:`save_population`."""

    what = "a population"
    needed = ("posterior", "prior", "without_hyperprior", "alone")
    read = ("names", "combinations")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(str(self.attributes["parameters"]).split())

    @property
    def symbols(self) -> Names:
        """Parameter or common quantity → how it is written in a figure."""
        variables = self.group("posterior").variables.items()
        return Names((name, str(values.attrs["symbol"])) for name, values in variables)

    @property
    def headline(self) -> str:
        """What stands for the population: its median; in files of version 1.0 the mean, for they hold no other."""
        return HEADLINE if f"{self.names[0]}_{HEADLINE}" in self.group("posterior") else "mean"

    @property
    def words(self) -> dict[str, str]:
        """What is stored of a population → in words."""
        return {what: words for what, words in WORDS.items() if what in (self.headline, "mean", "between", "next")}

    @property
    def reference(self) -> dict[str, tuple[float, float]]:
        """Parameter → a value of others to compare with and its std (NaN if not stated), in the parameter's unit."""
        return self._values("reference")

    @property
    def known(self) -> dict[str, tuple[float, float]]:
        """Parameter → its median and std as known from elsewhere, in the parameter's unit."""
        return self._values("known")

    def _values(self, attribute: str) -> dict[str, tuple[float, float]]:
        lines = (line.split() for line in str(self.attributes.get(attribute, "")).splitlines())
        return {name: (float(value), float(std)) for name, value, std in lines}

    @property
    def common(self) -> tuple[str, ...]:
        """Quantities that have one value in all data sets."""
        return tuple(str(self.attributes.get("common", "")).split())

    @property
    def belongs(self) -> dict[str, float]:
        """Data set → probability that it is of the population; empty in files of version 1.0."""
        alone = self.group("alone")
        return dict(zip(self.datasets, map(float, alone["belongs"].values), strict=True)) if "belongs" in alone else {}

    @property
    def odd_before(self) -> Array:
        """(S,) probabilities that data sets are not of the population, before their data are seen."""
        usual = np.full(len(self.datasets), float(self.attributes.get("hyperprior_odd", 0)))
        alone = self.group("alone")
        return np.asarray(alone["odd_before"].values, dtype=float) if "odd_before" in alone else usual

    @property
    def doubted(self) -> tuple[str, ...]:
        """The data sets that are odd more probably than others, before their data are seen."""
        odd = self.odd_before
        return tuple(name for name, own in zip(self.datasets, odd, strict=True) if own > odd.min())

    @property
    def readings(self) -> dict[str, str]:
        """Digest of its readings → data set; empty in files of version 1.0."""
        alone = self.group("alone")
        return dict(zip(map(str, alone["readings"].values), self.datasets, strict=True)) if "readings" in alone else {}

    def white(self, name: str) -> Array:
        """Draws (M,) of a centre or of what is common, in units of its prior."""
        return np.asarray(self.group("white")[name].values, dtype=float).ravel()

    def prior_of(self, name: str) -> PriorTerm:
        """The prior of a parameter of the population, or of what is common."""
        transform, mean, std, bounds, shape = json.loads(self.group("white")[name].attrs["prior"])
        p = parameter_of(name, self.group("posterior")[name].attrs)
        return PriorTerm(p, transform, mean, std, tuple(bounds), tuple(shape))

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """What the data determine together and not one by one."""
        combinations = []
        for line in str(self.attributes["combinations"]).splitlines():
            std, *rest = line.split()
            parts = tuple((name, float(a)) for name, a in zip(rest[::2], rest[1::2], strict=True))
            combinations.append(Combination(parts, float(std)))
        return tuple(combinations)


load_population = StoredPopulation.load


def group_folders(run_dir: Path) -> list[Path]:
    """The folders of the populations of groups of data sets, as configured."""
    return sorted((file.parent for file in (run_dir / GROUPS).glob(f"*/{POPULATION}")), key=natural)


def load_groups_of(run_dir: Path) -> dict[str, tuple[Path, StoredPopulation]]:
    """Group of data sets → the folder of its population, and this, as configured. Raises :class:`OutputError`."""
    stored = [(folder, load_population(folder / POPULATION)) for folder in group_folders(run_dir)]
    return {str(of.attributes.get("group", folder.name)): (folder, of) for folder, of in stored}


def populations_of(run_dir: Path) -> dict[str, tuple[Path, StoredPopulation]]:
    """As :func:`load_groups_of`, and under the name "" the population of all data sets, where there is one."""
    whole = {"": (run_dir, load_population(run_dir / POPULATION))} if (run_dir / POPULATION).exists() else {}
    return load_groups_of(run_dir) | whole
