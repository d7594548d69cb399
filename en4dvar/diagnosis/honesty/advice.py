"""What to do about a warning in this very configuration: options as they stand in YAML, values in the user's units.

The catalogue says what can be done in general. Here each advice leaves out what is done already, so that following it
does not bring the same words back.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from en4dvar.data.extrema import maxima
from en4dvar.data.noise import SMOOTHNESS
from en4dvar.diagnosis.analysis import Analysis
from en4dvar.diagnosis.diagnostics import active_members
from en4dvar.diagnosis.honesty.checks import moments, shown, sides_of_lost
from en4dvar.model.state import NOISE_SCALE, Parameter
from en4dvar.plumbing.caution import CATALOGUE, Caution
from en4dvar.plumbing.units import convert, unit_after
from en4dvar.schemes import MINIMISERS

MANY = 48  # members that start far enough apart
ENOUGH = 30  # iterations beyond which more of them seldom help
SHARP = 2000  # readings whose χ² tells apart errors of the same two digits
SHARE = 0.1  # of the members beyond a limit of the model, from when on the window is too long
CAUSES = ("rank-deficient", "ensemble-collapse", "not-converged", "at-bound")  # of residuals that are odd
FEW = 0.1  # of the members lost: so many others may lie where a cut of the prior is advised
SIGMA = "estimate their size (parameters.sigma: {prior: lognormal, median: 1, log_std: 0.5})"


@dataclass(frozen=True)
class Case:
    """One warning of an analysis, and the ``codes`` of all that it has; ``exact``: one of them asks for smaller errors
    of the times, or for other times, so that no other may ask for larger ones."""

    a: Analysis
    caution: Caution
    codes: frozenset[str]
    exact: bool = False

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(p for p in self.a.parameters if p.name in self.caution.parameters)

    @property
    def scatter(self) -> float:
        """Of the residuals over the stated errors, as one factor."""
        (chi2, dfs), used = self.a.fit, len(self.a.problem.observations.used)
        return math.sqrt(chi2 * used / max(1.0, used - dfs))

    @property
    def stated(self) -> float:
        """The error of a reading, the median of all, SI."""
        return float(np.median(self.a.own_std))

    @property
    def rescaled(self) -> str:
        """To state errors that scatter as much as the residuals do; of several series, in units of their own."""
        if len(self.a.observations.parts) > 1:
            return f"state errors about {self.scatter:.2g} times as large"
        right, now = (self.reading(factor * self.stated) for factor in (self.scatter, 1.0))
        return f"state an error of about {right} ({now} is stated)"

    @property
    def absurd(self) -> bool:
        """Whether the stated error is larger than half of what the readings span: hardly an error, perhaps its unit."""
        span = float(np.ptp(self.a.observations.values))
        single = len(self.a.observations.parts) < 2
        return single and 0 < span < 2 * self.stated and self.scatter < SHARE

    @property
    def may_be_robust(self) -> bool:
        noise = self.a.observations.noise
        return not noise.matrices() and not math.isfinite(noise.counts_within)  # also beside a discrepancy

    @property
    def cause(self) -> str:
        """What has to be settled before the residuals tell anything, "" where nothing has."""
        first = next((code for code in CAUSES if code in self.codes), "")
        return f"settle the warning {first} first, which may be the reason" if first else ""

    def with_scheme(self, option: str) -> str:
        """What only a scheme that minimises J takes, with such a scheme where there is another."""
        return option if self.a.settings.own.minimiser else f"{option}, with assimilation.scheme: {MINIMISERS[0]}"

    @property
    def or_cheap(self) -> str:
        """What else lets a posterior be sampled, behind ``refine: mcmc``; "" where nothing does."""
        settled = self.a.problem.model.cheap or self.a.settings.own.minimiser is None
        return "" if settled else ", or declare the model cheap, if ten thousand runs take seconds"

    @property
    def untapered(self) -> str:
        """To taper less, where the gain is localised by distance: what acts from farther away cannot be fitted."""
        local = self.a.settings.localisation
        if local is None or local.radius is None:
            return ""
        unit = next((estimate.prior.field.coordinate_unit for estimate in self.a.fields), "1")
        now = f"{local.radius:g}{unit_after(unit)}"
        return f"compare with a larger assimilation.localisation.radius (it is {now}), or leave localisation out"

    @property
    def structure(self) -> str:
        """The catalogue's advice about residuals with structure."""
        option = "data.error.discrepancy: estimated"
        return CATALOGUE["residual-structure"][1].replace(option, self.with_scheme(option))

    @property
    def changes(self) -> dict[str, str]:
        """What the model says may change unforeseen and is constant here, as ``model_error`` is told it."""
        varying, stds = {v.name for v in self.a.problem.varying}, self.a.problem.model.unforeseen
        return {name: f"{{at: maxima, std: {100 * std:.3g} %}}" for name, std in stds.items() if name not in varying}

    @property
    def changing(self) -> str:
        """How to let that change in a window with several maxima behind its first minimum; "" for another."""
        y = self.a.observations
        if not self.changes or y.parts or len(maxima(y.values)) < 2:
            return ""
        options = " ".join(f"--set model_error.{name}='{text}'" for name, text in self.changes.items())
        return f"let {' and '.join(self.changes)} change on the way ({options})"

    @property
    def timing(self) -> str:
        """How to state errors of the times where these explain the residuals better than what is stated; "" else."""
        if self.exact or not self.a.timing:
            return ""
        model, stated = self.a.problem.model, float(np.median(self.a.observations.noise.time_std))
        larger, now = (
            f"{convert(std, model.time_unit, model.time_display_unit):.2g}{unit_after(model.time_display_unit)}"
            for std in (self.a.timing, stated)
        )
        return (
            f"state that the times err by about {larger} (data.error.time_std; {now} is stated), which explains the "
            "residuals better"
        )

    @property
    def or_times(self) -> str:
        """What else residuals may be due to that the model does not explain, unless the times are ``exact``."""
        return "" if self.exact else "; where the times err, a larger data.error.time_std"

    def reading(self, value: float) -> str:
        """A size of readings in the unit in which their errors are stated, as sharp as so many of them tell it."""
        observable, digits = self.a.problem.observable, 2 if len(self.a.observations) < SHARP else 4
        unit = self.a.observations.error_unit or observable.display_unit
        return f"{convert(value, observable.unit, unit):.{digits}g} {unit}"


def advised(a: Analysis, cautions: Sequence[Caution]) -> tuple[Caution, ...]:
    """The warnings with the advice of this configuration, where the catalogue's alone has been given."""
    codes = frozenset(c.code for c in cautions)
    smaller = any(c.code == "prior-conflict" and "data.error.time_std" in c.advice for c in cautions)
    exact = smaller or "lost-frame" in codes
    return tuple(
        replace(c, advice=ADVICE[c.code](Case(a, c, codes, exact)))
        if c.code in ADVICE and c.advice == CATALOGUE[c.code][1]
        else c
        for c in cautions
    )


def _not_converged(case: Case) -> str:
    sampled = case.a.settings.localisation is None  # by refine: mcmc, which is not read beside one
    if case.a.settings.own.minimiser is None:
        chain = ", or assimilation.refine: mcmc" if sampled else ""
        return f"set assimilation.scheme: {MINIMISERS[0]}, which minimises J{chain}"
    little = "no action is needed if this step is small enough for you; else " * (case.caution.severity == "note")
    now = getattr(case.a.settings.own, "max_iterations", ENOUGH)
    more = f"{little}set assimilation.max_iterations: {max(20, 2 * now)} (it is {now})"
    if case.untapered:
        return f"{more}, or {case.untapered}" if "limit" in case.a.stop_reason else f"{little}{case.untapered}"
    if now < ENOUGH:
        return more
    unsure = "narrow the priors of the parameters that the data hardly constrain"
    return f"{little}set assimilation.refine: mcmc, which needs no minimum, or {unsure}"


def _members(case: Case) -> str:
    settings, n = case.a.settings, len(case.a.parameters)
    wanted = [f"assimilation.members: {2 * n + 2} (there are {n} parameters)"] * (settings.members <= 2 * n)
    wanted += ["assimilation.sampling: exact"] * (settings.sampling != "exact")
    wanted += [f"assimilation.scheme: {MINIMISERS[0]}, which minimises J"] * (settings.own.minimiser is None)
    return f"do not quote the intervals; set {' and '.join(wanted or ['assimilation.refine: mcmc'])}"


def _misfit(case: Case) -> str:
    if cause := case.cause:
        return cause
    if case.timing:
        return case.timing
    if case.a.observations.noise.discrepant:
        return (
            "widen the prior of data.error.discrepancy.amplitude, choose another model, or a shorter window"
            f"{case.or_times}"
        )
    if "residual-structure" in case.codes:
        return _structure(case)
    if "odd-residuals" in case.codes and case.may_be_robust:
        return "see the advice about single readings; look at the residuals before a larger error is stated"
    farther = f"{case.untapered}, if readings tell of more than what is near them; else " * bool(case.untapered)
    return (
        f"{farther}look at the residuals; if the readings scatter as much as they do, {case.rescaled}, or "
        f"{case.with_scheme(SIGMA)}; if not, the model or the window must change"
    )


def _overstated(case: Case) -> str:
    if case.absurd:
        scatter = case.reading(case.scatter * case.stated)
        return (
            f"check the unit of data.error: {case.reading(case.stated)} is stated, the residuals scatter by {scatter}"
        )
    if "residual-structure" in case.codes and not case.a.problem.discrepancy:
        return case.structure
    also = "" if NOISE_SCALE.name in case.a.problem.prior.names else f", or {case.with_scheme(SIGMA)}"
    return f"{case.rescaled}{also}; intervals are too wide"


def _structure(case: Case) -> str:
    if case.absurd:
        return _overstated(case)
    if cause := case.cause:
        return cause
    if "discrepancy-found" in case.codes and case.changing:
        return "follow the advice of the warning discrepancy-found first"
    kernel = getattr(case.a.observations.noise, "kernel", None)
    if kernel is None:
        return case.structure
    smoother = sorted((nu, name) for name, nu in SMOOTHNESS.items() if nu > kernel.smoothness)
    other = f"kernel: {smoother[0][1]}" if smoother else "grows_beyond" if not kernel.grows else ""
    if other:
        return f"the discrepancy has another shape than its kernel: try data.error.discrepancy.{other}"
    return "no kernel has the shape of the discrepancy: end the window earlier (data.window), or choose another model"


def _missed(case: Case) -> str:
    if case.caution.severity == "note":
        return "no action is needed: the intervals contain it"
    if case.caution.severity != "serious":
        if case.timing:
            return case.timing
        steps = [case.changing]
        if case.a.what_if:
            steps += ["look at the what-if table"]
        elif case.a.problem.alternatives and not case.a.settings.what_if:
            steps += ["ask for the what-if table (--set assimilation.what_if=true)"]
        first = "".join(f"{step} and " for step in steps if step)
        general = CATALOGUE["discrepancy-found"][1].replace("compare", f"{first}compare", 1)
        return general.partition(", or a larger")[0] if case.exact else general
    return (
        "quote nothing of this fit: look at the prior over the readings (en4dvar validate --plot); check units and "
        "columns (data), how the history starts, the law and the medium (model), and values that are fixed (parameters)"
    )


MEANS = " (140 % of step where a reading is the mean of five)"  # n instants have the std √((n² − 1)/12) steps


def _odd(case: Case) -> str:
    single = case.caution.words.startswith("the reading")
    if case.timing:
        return f"{case.timing}{'; delete this reading only if you know that it is wrong' * single}"
    if not single:
        if case.absurd:
            return _structure(case)
        noise = case.a.observations.noise
        first = "state a larger" if noise.time_std.any() else "state how uncertain the times are with"
        other = _structure(case) if noise.discrepant else "the model errs where the observable changes fast"
        return other if case.exact else f"{first} data.error.time_std{MEANS}; if the times are right, {other}"
    if case.may_be_robust:
        option = case.with_scheme("data.error.robust: huber")
        return f"look at this reading; with {option} such readings count less{case.or_times}"
    return f"look at this reading; if it is wrong, delete its line from the data file and say so{case.or_times}"


def _validity(case: Case) -> str:
    a, used = case.a, case.a.observations.used
    left = np.quantile(a.beyond[active_members(a.posterior_failures)].min(axis=1), SHARE, method="lower")
    kept = used[a.observations.times[used] < left]
    if len(kept) <= len(a.parameters):
        return f"choose a model that is valid there: too few readings ({len(kept)}) come before for a shorter window"
    end = moments(a)[max(kept, key=a.observations.times.__getitem__)]
    return f"end the window before (data.window: {{to: {end}}}), or choose a model that is valid there"


def _bound(case: Case) -> str:
    prior = case.a.problem.prior
    own = [p.name for p in case.parameters if prior.terms[prior.names.index(p.name)].has_bound]
    if not own:
        return "quote a limit, not mean ± std: no action is needed, the model allows no values beyond"
    return (
        f"widen the bounds of the prior (parameters.{own[0]}) if physics allows it; else quote a limit, not mean ± std"
    )


def _modes(case: Case) -> str:
    name = case.caution.parameters[0] if case.caution.parameters else case.a.parameters[0].name
    apart = f"prior knowledge, as bounds of the prior (parameters.{name}), can separate them"
    if case.caution.severity == "serious" and case.a.settings.refine != "mcmc":
        return f"set assimilation.refine: mcmc, which draws from all of them; {apart}"
    return f"quote the quantiles or each mode by itself, not mean ± std; {apart}"


def _starts(case: Case) -> str:
    """Descents start from no more members than go side by side."""
    starts, members = int(getattr(case.a.settings.own, "starts", 1)), case.a.settings.members
    if members < MANY:
        return f"set assimilation.members: {MANY} and assimilation.starts: {2 * max(starts, 2)}"
    tried = len(case.a.descents.members) if case.a.descents else 0
    if max(tried, starts) < members // (len(case.a.parameters) + 1):
        return f"set assimilation.starts: {2 * max(starts, 2)} (it is {starts}), or narrow the priors"
    return f"set assimilation.members: {4 * members}, of which more start a descent, or narrow the priors"


def _one_descent(case: Case) -> str:
    own, n = case.a.settings.own, len(case.a.parameters)
    wanted = ["assimilation.starts: 2"] * (getattr(own, "starts", 2) < 2)
    wanted += ["assimilation.start: best-member"] * (not isinstance(getattr(own, "start", ""), str))
    noisy = case.a.settings.stochastic_model  # which takes no bundle
    wanted += ["assimilation.linearisation: bundle"] * (getattr(own, "linearisation", "") == "transform" and not noisy)
    wanted += [f"assimilation.members: {2 * n + 2}"] * (case.a.settings.members <= n + 1)
    return f"set {' and '.join(wanted)}" if wanted else "compare with another seed"


def _gaussian(case: Case) -> str:
    if case.a.settings.own.approximate:
        return f"set assimilation.scheme: {MINIMISERS[0]}, whose ensemble is the posterior"
    return f"{CATALOGUE['non-gaussian'][1]}{case.or_cheap}"


def _lost(case: Case) -> str:
    """A cut of the prior is advised where it takes no values that the model allows: where the model fails along a
    curve, no parameter alone has such an edge.
    """
    a, lost = case.a, ~active_members(case.a.prior_failures)
    edges = [(a.parameters[s.j], s) for s in sides_of_lost(a.prior, lost) if s.others <= FEW * lost.sum()]
    ways = ["find out why it fails"]
    for p, side in edges[:1]:
        key = f"parameters.{p.name}.{'upper' if side.higher else 'lower'}"
        ways.append(f"cut the prior at {p.name} = {shown(side.edge, p)}, beyond which hardly any member runs ({key})")
    if a.settings.localisation is None and a.settings.refine != "mcmc" and "readings-missing" not in case.codes:
        cheap = case.or_cheap if "non-gaussian" in case.codes else ""
        ways.append(f"set assimilation.refine: mcmc{cheap}, which samples the posterior given that the model runs")
    return f"the posterior holds only where the model runs: {', or '.join(ways)}"


def _chain(case: Case) -> str:
    guided = case.a.settings.emulator == "on" or "mcmc_steps" not in case.a.refinement
    on = "set assimilation.emulator: on, which guides the chain, or " * (not guided)
    return f"do not quote these intervals; {on}run again with more data or narrower priors"


def _future(case: Case) -> str:
    problem = case.a.problem
    if not (end := problem.observations.next_end):
        return CATALOGUE["future-missed"][1]
    changes = ", ".join(f"{name}: {text}" for name, text in case.changes.items())
    also = f", with what may change on the way (model_error: {{{changes}}})" if changes else ""
    return (
        "look at the figure of the readings after the window: if they are of the same system, let the model "
        f"explain them too, one minimum at a time (data.window.to: {end}){also}"
    )


def _silent(case: Case) -> str:
    p = case.parameters[0]
    return f"do not quote {p.name} as measured: fix it (parameters.{p.name}: a value), or add data that depend on it"


ADVICE: dict[str, Callable[[Case], str]] = {
    "not-converged": _not_converged,
    "ensemble-collapse": _members,
    "rank-deficient": _members,
    "future-missed": _future,
    "misfit": _misfit,
    "discrepancy-found": _missed,
    "overstated-error": _overstated,
    "residual-structure": _structure,
    "odd-residuals": _odd,
    "model-validity": _validity,
    "chain-not-converged": _chain,
    "non-gaussian": _gaussian,
    "at-bound": _bound,
    "several-modes": _modes,
    "starts-disagree": _starts,
    "members-lost": _lost,
    "one-descent": _one_descent,
    "not-informed": _silent,
}
