"""Evidence of the data sets of a finished run by importance sampling, where the model is cheap."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from en4dvar.errors import ConfigError, OutputError
from en4dvar.executor import choose_executor, one_blas_thread
from en4dvar.population.campaign import white_prior
from en4dvar.runs.finished import finished
from en4dvar.runs.trust import Ask
from en4dvar.sampling.evidence import TOO_FEW, sampled_evidence
from en4dvar.sampling.forward_runs import ForwardRuns
from en4dvar.user_code import RefusedError


def sampled_evidences(
    run_dir: Path, workers: int | None, trust: bool, ask: Ask | None, tell: Callable[[str], None]
) -> Mapping[str, float]:
    """Data set → log-evidence, of those that enough draws stand behind.

    ``tell`` gets a line where there are none: a model that is not cheap, errors or priors that
    :class:`~en4dvar.sampling.forward_runs.ForwardRuns` cannot take, code that is not run unasked.
    """
    try:
        config, sets = finished([run_dir], trust, ask)
        if not all(one.problem.model.cheap for one in sets):
            raise ConfigError("its model is not cheap")
        with choose_executor(config.model, None, workers) as executor, one_blas_thread():
            runs = ForwardRuns([one.problem for one in sets], executor, white=True)
            found = sampled_evidence(runs, white_prior(sets[0].problem.prior), config.seed)
    except (ConfigError, OutputError, RefusedError) as error:
        tell(f"{run_dir}: evidence by Laplace's approximation, as stored: {error}")
        return {}
    logs = found.log - [one.problem.observations.log_normalisation() for one in sets]
    return {one.name: float(log) for one, log, n in zip(sets, logs, found.effective, strict=True) if n >= TOO_FEW}
