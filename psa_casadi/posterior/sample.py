"""`psa.sample`: the whole posterior of a model's parameters from its records."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from psa_casadi.common.display import Reported, frame
from psa_casadi.common.errors import Problems
from psa_casadi.common.files import atomic_write, temporary_folder
from psa_casadi.common.interruption import interruptible_work
from psa_casadi.common.notes import Note, note, texts
from psa_casadi.common.progress import Progress, on_a_terminal, silent
from psa_casadi.model.compose import Model
from psa_casadi.posterior.chains import (
    Chains,
    chains_of,
    column_of,
    data_tree,
    predictive,
    prior_draws,
    sampler_and_arviz,
)
from psa_casadi.posterior.task import Task, own_task_of, task_of
from psa_casadi.records.read.reading import records_given
from psa_casadi.records.split import DISPLACEMENT
from psa_casadi.simulation.side_by_side import one_thread, one_thread_of_algebra
from psa_casadi.simulation.start import is_stack

#: Share of the highest density interval, and its ends.
HDI = 0.94
#: The chains disagree above this r-hat (Vehtari and others, Bayesian Analysis 16, 2021), and are
#: too short below this many effective draws per chain.
MOST_RHAT, LEAST_ESS = 1.01, 100.0
#: A posterior wider than this share of its prior depends on the prior.
_PRIOR_SHARE = 0.5
#: Residuals count as coloured from this autocorrelation time, in samples, on.
_COLOURED = 1.5


@dataclass(frozen=True)
class Figures:
    """A parameter's posterior, in its `unit`: mean, sd, 94 % HDI, effective draws, r-hat.

    `mc_error` is the standard error of the mean by the chains' length; `prior_share` the posterior
    standard deviation over the prior's, nan where the prior is not that of a parameter alone.
    """

    name: str
    unit: str
    mean: float
    sd: float
    low: float
    high: float
    mc_error: float
    ess: float
    r_hat: float
    prior_share: float


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(Reported):
    """Draws of parameters, starts and offsets from records, with their task and chains.

    `model` has the values of the fit that the chains start at; `tree` is an
    `arviz.InferenceData` with the groups posterior, sample_stats, prior, prior_predictive,
    posterior_predictive, observed_data and constant_data, in SI units, which variables name.
    """

    model: Model
    tree: Any
    figures: tuple[Figures, ...]
    divergences: int
    chains: int
    draws: int
    seed: int
    task: Task
    doubts: tuple[Note, ...]
    notes: tuple[Note | str, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is to be doubted, in words."""
        return texts(self.doubts)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was done to the records and the prior's draws, in words."""
        return texts(self.notes)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the data tree as netCDF 4, whole or not at all; `arviz.from_netcdf` reads it.

        Raises InputError when `path` cannot be written to.
        """
        with temporary_folder() as folder:
            whole = folder / "posterior.nc"
            self.tree.to_netcdf(str(whole), engine="h5netcdf")
            atomic_write(path, whole.read_bytes())

    def to_frame(self) -> Any:
        """Return the figures of every parameter as a pandas data frame."""
        rows = self.figures
        columns = {
            name: [getattr(f, name) for f in rows]
            for name in ("name", "unit", "mean", "sd", "low", "high", "mc_error", "ess", "r_hat")
        }
        return frame(columns)


def figures_of(task: Task, tree: Any) -> tuple[Figures, ...]:
    """Return the figures of every parameter."""
    _, arviz = sampler_and_arviz()
    table = arviz.summary(
        tree, var_names=list(task.unknowns.names), hdi_prob=HDI, round_to="none", kind="all"
    )
    edge, u = 50.0 * (1.0 - HDI), task.unknowns
    figures = []
    for k, name in enumerate(u.names):
        row, values = table.loc[name], tree.posterior[name].to_numpy()
        if u.loop is not None and k in u.loop:
            spread = float(tree.prior[name].std())
            share = float(np.std(values) / spread) if spread > 0.0 else float("nan")
        else:  # in ln units where these are searched
            moved = np.log(values) if u.log[k] else values / u.scale[k]
            share = float(np.std(moved) / u.prior[k])
        figures.append(
            Figures(
                name=name,
                unit=task.model.parameter(name).unit,
                mean=float(row["mean"]),
                sd=float(row["sd"]),
                low=float(row[f"hdi_{edge:g}%"]),
                high=float(row[f"hdi_{100.0 - edge:g}%"]),
                mc_error=float(row["mcse_mean"]),
                ess=float(min(row["ess_bulk"], row["ess_tail"])),
                r_hat=float(row["r_hat"]),
                prior_share=share,
            )
        )
    return tuple(figures)


def doubts_of(task: Task, chains: Chains, figures: tuple[Figures, ...]) -> tuple[Note, ...]:
    """Return what of the chains, the records and the priors is to be doubted."""
    count, draws, _ = chains.u.shape
    doubts = []
    if chains.divergences:
        doubts.append(note("diverged", count=chains.divergences, transitions=count * draws))
    apart = [f.name for f in figures if count > 1 and not f.r_hat <= MOST_RHAT]
    if apart:
        doubts.append(note("chains_disagree", names=apart, limit=MOST_RHAT))
    few = [f.name for f in figures if f.ess < LEAST_ESS * count]
    if few:
        doubts.append(note("few_draws", names=few, limit=LEAST_ESS))
    if not task.fit.converged:
        doubts.append(note("start_cut_off"))
    for b in task.density.blocks:
        if b.correlation_time > _COLOURED:
            named = column_of(task, b) if task.channel(b) != DISPLACEMENT else None
            record = task.experiments[b.record].record.name
            doubts.append(note("coloured", record=record, worth=b.correlation_time, output=named))
    held = [f.name for f in figures if f.prior_share > _PRIOR_SHARE]
    if held:
        doubts.append(note("of_the_prior", names=held))
    return tuple(doubts)


#: Draws that are predicted, and draws of the prior.
_PREDICTED = 100


@on_a_terminal
@interruptible_work()
@one_thread_of_algebra()
def sample(
    model: Model,
    records: Any,
    *,
    free: Sequence[str] | None = None,
    prior: Mapping[str, float] | None = None,
    widths: Mapping[str, float] | None = None,
    chains: int = 4,
    draws: int = 1000,
    tune: int = 500,
    seed: int = 0,
    cores: int | None = None,
    progress: Progress = silent,
    **words: Any,
) -> Posterior:
    """Draw parameters, initial states and offsets of a model from their posterior.

    p(theta | y) is proportional to prod_r |y_r - x_r(theta)|^-(n_r / c_r) times the weak priors of
    an identification, theta_k / w_k normal about 0 within the parameters' bounds: the noise level
    of every output in every record r has the prior 1 / sigma and is integrated out (but those of a
    stack's further columns, which are known), and c_r samples count as one where
    residuals are correlated (their long-run variance over their variance, at the fit). The chains
    start around the fit from the model's values (of any model but a stack from several starts), in
    coordinates that its covariance whitens; the gradient is exact, from the
    sensitivities.

    Args:
        model: A stack's model, as `psa.identify` returns it or `psa.stack_model`, or any other.
        records: Those of one device, as `psa.identify` takes them.
        free: Names of the parameters that are sampled; by default those that the model was fitted
            in, else those that voltage and displacement determine; of other models those that are
            `fitted`.
        prior: Values that the priors are centred at, in the parameters' units; by default those of
            a stack of the records' size, as a search starts with, and declared ones of effects and
            of other models.
        widths: Standard deviations of the priors: of ln(value) for parameters that span decades, in
            ordinary changes for others; by default 3 and 10, and 1 for lags.
        chains: Number of chains.
        draws: Draws of each chain that are kept.
        tune: Draws of each chain before, to adapt step and metric.
        seed: Seed of all that is random.
        cores: Chains at a time; by default one for each core.
        progress: Gets what is being done, in words.
        words: Of models other than a stack's those of `psa.identify`: `starts`, `zeros`,
            `known_start`, `hold`.

    Raises:
        InputError: The extra `sample` is not installed, a name is unknown.
        SimulationError: The model cannot be simulated at its values.
    """
    sampler_and_arviz()
    _refuse(model, chains, draws, tune, words)
    progress("fitting")
    if is_stack(model):
        task = task_of(model, records_given(records), free=free, prior=prior, widths=widths)
    else:
        task = own_task_of(model, records, free=free, prior=prior, widths=widths, **words)
    rng = np.random.default_rng(seed)
    with one_thread():
        result = chains_of(
            task.density, chains=chains, draws=draws, tune=tune, seed=seed, cores=cores,
            progress=progress,
        )  # fmt: skip
        theta = np.apply_along_axis(task.density.theta, 2, result.u)
        progress("predicting")
        before = predictive(task, prior_draws(task, _PREDICTED, rng), rng, fit_offset=True)
        flat = theta.reshape(-1, theta.shape[2])
        some = rng.choice(len(flat), min(_PREDICTED, len(flat)), replace=False)
        after = predictive(task, flat[some], rng, fit_offset=False)
    tree = data_tree(task, result, theta, before, after)
    figures = figures_of(task, tree)
    failed = [note("prior_fails", count=before.failed, draws=_PREDICTED)] if before.failed else []
    return Posterior(
        model=task.model.with_values(task.unknowns.values(task.fit.theta)),
        tree=tree,
        figures=figures,
        divergences=result.divergences,
        chains=chains,
        draws=draws,
        seed=seed,
        task=task,
        doubts=doubts_of(task, result, figures),
        notes=(*task.sentences, *failed),
    )


#: The options for records and search of models other than a stack's.
_OWN = ("starts", "zeros", "known_start", "hold")


def _refuse(model: Model, chains: int, draws: int, tune: int, words: Iterable[str]) -> None:
    """Refuse too few draws, and words that the model does not take. Raises InputError."""
    problems = Problems()
    for word in words:
        if word not in _OWN or is_stack(model):
            problems.add(
                f"'{word}' is not among the arguments for '{model.name}'; an ODE model"
                f" also takes {', '.join(_OWN)}."
            )
    if chains < 1 or draws < 4 or tune < 1:
        problems.add(
            f"{chains} chains of {draws} draws after {tune} give no posterior; take one chain, four"
            " draws and one tuning draw at least."
        )
    problems.raise_if_any()
