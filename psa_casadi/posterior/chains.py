"""Chains of the No-U-Turn sampler, what they predict, and the data tree of both."""

import warnings
from collections.abc import Callable
from contextlib import suppress
from contextvars import copy_context
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.interruption import current_work, raise_if_stopped
from psa_casadi.common.progress import Progress, silent
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.prediction import predict
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.posterior.task import Block, Task
from psa_casadi.records.split import DISPLACEMENT, Channel
from psa_casadi.version import __version__


def sampler_and_arviz() -> tuple[Any, Any]:
    """Return the modules nutpie and arviz. Raises InputError where one is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # arviz announces its next version
            return import_module("nutpie"), import_module("arviz")
    except ImportError as error:
        raise InputError(
            f"A posterior needs nutpie and ArviZ ({error.name} is not installed); run"
            " `pip install 'psa-casadi[sample]'`. `psa identify` gives intervals without them."
        ) from error


@dataclass(frozen=True, eq=False)
class Predictive:
    """Draws that were predicted: `theta` (draws, size), and of every block readings and noise.

    `readings` (draws, samples of the record) hold noise of the level `noise` (draws,), both in the
    channel's unit. `failed` of the draws could not be simulated and are left out.
    """

    theta: FloatArray
    readings: tuple[FloatArray, ...]
    noise: tuple[FloatArray, ...]
    failed: int


def prior_draws(task: Task, count: int, rng: np.random.Generator) -> FloatArray:
    """Return draws of the priors (count, size): normal about their centre, cut at the bounds.

    Offsets have flat priors and stay 0.
    """
    known = np.isfinite(task.unknowns.prior)
    width, values = task.unknowns.prior[known], np.zeros((count, task.unknowns.size))
    low, high = (edge[known] / width for edge in task.unknowns.bounds())
    values[:, known] = width * scipy.stats.truncnorm.rvs(
        low, high, size=(count, int(known.sum())), random_state=rng
    )
    return values


def predictive(
    task: Task, draws: FloatArray, rng: np.random.Generator, *, fit_offset: bool
) -> Predictive:
    """Predict all records at draws of theta (n, size), with white noise at the blocks' levels.

    The level is drawn from its conditional posterior, sigma^2 = S / (c chi^2) with the sum of
    squares S at the draw, c samples counting as one, and the block's degrees of freedom; so is an
    offset that was projected out. With `fit_offset`, for draws of the prior, whose offsets are
    flat, a sensor's offset is the one that fits best, and the level is that of the fit.
    """
    kept, readings, noise, blocks = [], [], [], task.density.blocks
    for theta in draws:
        try:
            parts = predict(
                task.model, task.experiments, task.unknowns, theta,
                way=task.fit.way, everything=True, differentiated=False,
                further=any(b.channel for b in blocks),
            )  # fmt: skip
        except PsaError:
            continue
        clean, levels = [], []
        for b in blocks:
            e, part, channel = task.experiments[b.record], parts[b.record], task.channel(b)
            y = part.further[channel.outputs[0]][0] if b.channel else part.displacement
            left, free = (e.measured(b.channel) - y)[e.at(b.channel)], channel.offset
            if free and (fit_offset or b.channel):
                y, left = y + np.mean(left), left - np.mean(left)
            level = b.level
            if not fit_offset:
                level = float(np.sqrt(left @ left / b.correlation_time / rng.chisquare(b.count)))
                if free and b.channel:
                    y = y + level * rng.standard_normal() / np.sqrt(len(left) / b.correlation_time)
            clean.append(y)
            levels.append(level)
        kept.append(theta)
        noise.append(levels)
        readings.append(
            [y + s * rng.standard_normal(len(y)) for y, s in zip(clean, levels, strict=True)]
        )
    sizes = [task.experiments[b.record].record.n for b in blocks]
    return Predictive(
        theta=np.array(kept).reshape(len(kept), draws.shape[1]),
        readings=tuple(
            np.array([y[k] for y in readings]).reshape(len(kept), n) for k, n in enumerate(sizes)
        ),
        noise=tuple(np.array([s[k] for s in noise]) for k, _ in enumerate(blocks)),
        failed=len(draws) - len(kept),
    )


#: Spread of the chains' starts, in standard deviations of the fit.
_SPREAD = 1.0
#: Share of proposals that the step is tuned to accept.
_ACCEPT = 0.9
#: Time [s] between two looks at the chains.
_LOOK = 0.5
#: What of the sampler's figures is kept, by ArviZ's names.
_STATISTICS = {
    "diverging": "diverging",
    "energy": "energy",
    "logp": "lp",
    "n_steps": "n_steps",
    "depth": "tree_depth",
    "step_size": "step_size",
    "mean_tree_accept": "acceptance_rate",
}


class Sampled(Protocol):
    """A log density on R^n with its gradient; -inf where it cannot be had."""

    @property
    def size(self) -> int:
        """Number of coordinates."""

    def __call__(self, u: FloatArray, /) -> tuple[float, FloatArray]:
        """Return ln p and its gradient (size,)."""


@dataclass(frozen=True, eq=False)
class Chains:
    """Draws `u` (chains, draws, size) and the sampler's figures, each (chains, draws)."""

    u: FloatArray
    statistics: dict[str, npt.NDArray[Any]]

    @property
    def divergences(self) -> int:
        """Number of divergent transitions."""
        return int(self.statistics["diverging"].sum())


def chains_of(
    density: Sampled,
    *,
    chains: int = 4,
    draws: int = 1000,
    tune: int = 500,
    seed: int = 0,
    cores: int | None = None,
    progress: Progress = silent,
) -> Chains:
    """Draw from a density, `tune` draws to adapt step and metric first, which are thrown away.

    The chains start around u = 0. The No-U-Turn sampler (Hoffman and Gelman, JMLR 15, 2014) is
    nutpie's, whose diagonal metric follows draws and gradients (Seyboldt, Carlson and Carpenter,
    2026). Raises InputError where nutpie is not installed, KeyboardInterrupt.
    """
    nutpie, _ = sampler_and_arviz()
    size, context = density.size, copy_context()

    def make() -> Callable[..., Any]:  # a density for each chain's thread, in the caller's context
        paths = context.copy()

        def value(u: npt.ArrayLike) -> tuple[float, FloatArray]:
            try:
                return paths.run(density, np.asarray(u))
            except KeyboardInterrupt:  # in the sampler's thread; the caller's raises it
                return -np.inf, np.zeros(size)

        return value

    model = nutpie.compiled_pyfunc.from_pyfunc(
        ndim=size,
        make_logp_fn=make,
        make_expand_fn=lambda *_: lambda u: {"u": np.array(u)},
        expanded_dtypes=[np.dtype("float64")],
        expanded_shapes=[(size,)],
        expanded_names=["u"],
        make_initial_point_fn=lambda paths: (
            _SPREAD * np.random.default_rng(paths).standard_normal(size)
        ),
    )
    running = nutpie.sample(
        model, draws=draws, tune=tune, chains=chains, cores=cores, seed=seed,
        target_accept=_ACCEPT, progress_bar=False, save_warmup=False, blocking=False,
    )  # fmt: skip
    progress("sampling")
    table = None
    try:
        while table is None:
            with suppress(TimeoutError):
                table = running.wait(timeout=_LOOK)
            raise_if_stopped()
    except BaseException as error:  # a chain may end at the interrupt before this thread knows
        if isinstance(error, KeyboardInterrupt):
            current_work().stop()
        with suppress(Exception):
            running.cancel()
        raise_if_stopped()
        raise
    statistics = {
        ours: table.sample_stats[theirs].to_numpy()
        for theirs, ours in _STATISTICS.items()
        if theirs in table.sample_stats
    }
    return Chains(table.posterior["u"].to_numpy(), statistics)


_RECORD = "record"


def column_of(task: Task, block: Block) -> str:
    """Return the name of a block's readings in the tree."""
    name = task.channel(block).column
    return name if len(task.experiments) == 1 else f"{name}_{block.record + 1}"


def _of(what: str, channel: Channel) -> str:
    """Return the name of what every record has of a channel; plain for a displacement's."""
    return what if channel == DISPLACEMENT else f"{what}_{channel.column}"


def data_tree(
    task: Task, chains: Chains, theta: FloatArray, prior: Predictive, posterior: Predictive
) -> Any:
    """Return an `arviz.InferenceData` of all groups; `theta` is (chains, draws, size)."""
    _, arviz = sampler_and_arviz()
    draws, before = quantities(task, theta), quantities(task, prior.theta[None])
    observed, applied, times = _recorded(task)
    units, blocks = _units(task), task.density.blocks
    dims = {n: [_RECORD] for n in units if n not in task.unknowns.names}
    for name, (time, _, unit, meaning) in (observed | applied).items():
        dims[name], units[name], units[time] = [time], (unit, meaning), ("s", "Time")
    predictions = []
    for p in (posterior, prior):
        table = {column_of(task, b): y[None] for b, y in zip(blocks, p.readings, strict=True)}
        for b, level in zip(blocks, p.noise, strict=True):
            name, count = _of("noise", task.channel(b)), len(task.experiments)
            table.setdefault(name, np.full((1, len(level), count), np.nan))[0, :, b.record] = level
        predictions.append(table)
    tree = arviz.from_dict(
        posterior=draws,
        sample_stats=chains.statistics,
        prior=before,
        posterior_predictive=predictions[0],
        prior_predictive=predictions[1],
        observed_data={n: values for n, (_, values, *_) in observed.items()},
        constant_data={n: values for n, (_, values, *_) in applied.items()},
        coords={_RECORD: [e.record.name for e in task.experiments], **times},
        dims=dims,
    )
    for group in tree.groups():
        for name in tree[group].variables:
            unit, meaning = units.get(name, ("", ""))
            if unit:
                tree[group][name].attrs |= {"units": unit, "long_name": meaning}
    tree.posterior.attrs["inference_library"] = "nutpie"
    tree.posterior.attrs["created_by"] = f"psa_casadi {__version__}"
    return tree


#: The name of a column's times, its values (n,), unit and meaning.
_Columns = dict[str, tuple[str, FloatArray, str, str]]


def _recorded(task: Task) -> tuple[_Columns, _Columns, dict[str, FloatArray]]:
    """Return what was measured and what was applied, by names in the tree, and the times."""
    columns: _Columns = {}
    applied: _Columns = {}
    times = {}
    for k, e in enumerate(task.experiments):
        first = next((column_of(task, b) for b in task.of_record(k)), "")
        for b in task.of_record(k):
            times[f"time_{first}"], c = e.record.time, task.channel(b)
            column = e.measured(b.channel), c.unit, c.column
            columns[column_of(task, b)] = (f"time_{first}", *column)
        for inputs in task.model.structure.inputs:
            values = e.record.column(inputs.name)
            if first and values is not None:
                column = values, inputs.unit, inputs.description
                applied[f"{inputs.name}_{first}"] = (f"time_{first}", *column)
    return columns, applied, times


def quantities(task: Task, theta: FloatArray) -> dict[str, FloatArray]:
    """Return parameters, starts and offsets in SI units, each (chains, draws[, records])."""
    u, shape = task.unknowns, theta.shape[:2]
    flat = theta.reshape(-1, theta.shape[2])
    rows = [u.values(t) for t in flat]
    table = {n: np.array([r[n] for r in rows]).reshape(shape) for n in u.names}
    starts = [[u.start(t, k) for k in range(u.records)] for t in flat]
    for name in _states(u):
        values = [[s.get(name, np.nan) for s in each] for each in starts]
        table[f"start_{name}"] = np.array(values).reshape(*shape, u.records)
    first = task.experiments[0].channels[0]
    if first.offset:
        offsets = [[u.offset(t, k) for k in range(u.records)] for t in flat]
        table[_of("offset", first)] = np.array(offsets).reshape(*shape, u.records)
    return table


def _states(u: Unknowns) -> tuple[str, ...]:
    return tuple(dict.fromkeys(n for started in u.started for n in started))


def _units(task: Task) -> dict[str, tuple[str, str]]:
    """Return unit and meaning of every variable."""
    u, model = task.unknowns, task.model
    table = {n: (model.parameter(n).unit, model.parameter(n).description) for n in u.names}
    states = {s.name: s for s in model.structure.states}
    for name in _states(u):
        meaning = f"Start of a record: {states[name].description}, as a deviation from rest"
        table[f"start_{name}"] = (states[name].unit, meaning)
    for k, channel in enumerate(task.experiments[0].channels):
        sensor = channel.column if channel.column != "displacement" else "displacement sensor"
        if k == 0 and channel.offset:
            table[_of("offset", channel)] = (channel.unit, f"Offset of the {sensor} in a record")
        if not channel.factors:
            meaning = "Standard deviation of the noise of a record"
            table[_of("noise", channel)] = (channel.unit, meaning)
    return table
