"""`psa.sample`: the whole posterior of a stack's parameters, given its records."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from psa_casadi.errors import InputError, Problems
from psa_casadi.interruption import interruptible_work
from psa_casadi.model.compose import Model
from psa_casadi.posterior.chains import (
    chains_of,
    data_tree,
    predictive,
    prior_draws,
    sampler_and_arviz,
)
from psa_casadi.posterior.result import Posterior, figures_of, warnings_of
from psa_casadi.posterior.task import task_of
from psa_casadi.records.read.reading import Records, records_given
from psa_casadi.simulation.one_thread import one_thread_of_algebra
from psa_casadi.simulation.side_by_side import one_thread
from psa_casadi.simulation.ways import output_of

Progress = Callable[[str], None]

#: Draws that are predicted, and draws of the prior.
_PREDICTED = 100


@interruptible_work()
@one_thread_of_algebra()
def sample(
    model: Model,
    records: Records,
    *,
    free: Sequence[str] | None = None,
    prior: Mapping[str, float] | None = None,
    widths: Mapping[str, float] | None = None,
    chains: int = 4,
    draws: int = 1000,
    tune: int = 500,
    seed: int = 0,
    cores: int | None = None,
    progress: Progress = lambda _: None,
) -> Posterior:
    """Draw parameters, initial states and offsets of a stack's model from their posterior.

    p(theta | y) is proportional to prod_r |y_r - x_r(theta)|^-(n_r / c_r) times the weak priors of
    an identification, theta_k / w_k normal about 0 within the parameters' bounds: the noise level
    of every record has the prior 1 / sigma and is integrated out, and c_r samples count as one
    where residuals are correlated (their long-run variance over their variance, at the fit). The
    chains start around the fit that is found from the model's values, in coordinates that its
    covariance whitens; the gradient is exact, from the sensitivities.

    Args:
        model: A stack's model, as `psa.identify` returns it or `psa.stack_model`.
        records: Those of one device, as `psa.identify` takes them.
        free: Names of the parameters that are sampled; by default those that the model was fitted
            in, else those that voltage and displacement can tell.
        prior: Values that the priors are centred at, in SI units; by default those of a stack of
            the records' size, as a search begins with, and declared ones of effects.
        widths: Standard deviations of the priors: of ln(value) for parameters that span decades, in
            ordinary changes for others; by default 3 and 10, and 1 for lags.
        chains: Number of chains.
        draws: Draws of each chain that are kept.
        tune: Draws of each chain before, to adapt step and metric.
        seed: Seed of all that is random.
        cores: Chains at a time; by default one for each core.
        progress: Is told what is being done.

    Raises:
        InputError: The extra `sample` is not installed, the model is no stack's, a name is unknown.
        SimulationError: The model cannot be simulated at its values.
    """
    sampler_and_arviz()
    _refuse(model, chains, draws, tune)
    progress("fitting")
    task = task_of(model, records_given(records), free=free, prior=prior, widths=widths)
    rng = np.random.default_rng(seed)
    with one_thread():
        found = chains_of(
            task.density, chains=chains, draws=draws, tune=tune, seed=seed, cores=cores,
            progress=progress,
        )  # fmt: skip
        theta = np.apply_along_axis(task.density.theta, 2, found.u)
        progress("predicting")
        before = predictive(task, prior_draws(task, _PREDICTED, rng), rng, fit_offset=True)
        flat = theta.reshape(-1, theta.shape[2])
        some = rng.choice(len(flat), min(_PREDICTED, len(flat)), replace=False)
        after = predictive(task, flat[some], rng, fit_offset=False)
    tree = data_tree(task, found, theta, before, after)
    figures = figures_of(task, tree)
    failed = (
        (f"{before.failed} of {_PREDICTED} draws of the prior cannot be simulated; they are left"
        " out of the prior's groups.",) if before.failed else ()
    )  # fmt: skip
    return Posterior(
        model=task.model.with_values(task.unknowns.values(task.theta)),
        tree=tree,
        figures=figures,
        divergences=found.divergences,
        chains=chains,
        draws=draws,
        seed=seed,
        task=task,
        warnings=warnings_of(task, found, figures),
        sentences=(*task.sentences, *failed),
    )


def _refuse(model: Model, chains: int, draws: int, tune: int) -> None:
    """Refuse a model that is no stack's, and too few draws. Raises InputError."""
    problems = Problems()
    if "voltage" not in model.input_names or output_of(model) is None:
        problems.add(
            f"The model '{model.name}' has no voltage or no displacement, so it is no stack; a"
            " posterior is drawn of a stack's parameters. `psa.identify` fits any model."
        )
    if chains < 1 or draws < 4 or tune < 1:
        problems.add(
            f"{chains} chains of {draws} draws after {tune} give no posterior; take one chain, four"
            " draws and one tuning draw at least."
        )
    if problems:
        raise InputError(problems.sentences())
