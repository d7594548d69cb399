"""Evidence of the data sets of a finished run by importance sampling, where the model is cheap."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from en4dvar.estimation.population.campaign import white_prior
from en4dvar.executor import choose_executor, one_blas_thread
from en4dvar.plumbing.errors import ConfigError, OutputError
from en4dvar.plumbing.user_code import RefusedError
from en4dvar.runs.finished import finished
from en4dvar.runs.trust import Ask
from en4dvar.sampling.evidence import TOO_FEW, sampled_evidence
from en4dvar.sampling.forward_runs import ForwardRuns


def sampled_evidences(
    run_dir: Path, workers: int | None, trust: bool, ask: Ask | None, tell: Callable[[str], None]
) -> Mapping[str, float]:
    """Data set → log-evidence, of those that enough draws stand behind.

    ``tell`` gets a line where there are none: a model that is not cheap, errors or priors that
    :class:`~en4dvar.sampling.forward_runs.ForwardRuns` cannot take, code that is not run unasked.
    """
    try:
        config, sets = finished([run_dir], trust, ask)
        if not all(s.problem.model.cheap for s in sets):
            raise ConfigError("its model is not cheap")
        with choose_executor(config.model, None, workers) as executor, one_blas_thread():
            runs = ForwardRuns([s.problem for s in sets], executor, white=True)
            evidence = sampled_evidence(runs, white_prior(sets[0].problem.prior.names), config.seed)
    except (ConfigError, OutputError, RefusedError) as error:
        tell(f"{run_dir}: evidence by Laplace's approximation, as stored: {error}")
        return {}
    logs = evidence.log - [s.problem.observations.log_normalisation() for s in sets]
    return {s.name: float(log) for s, log, n in zip(sets, logs, evidence.effective, strict=True) if n >= TOO_FEW}
