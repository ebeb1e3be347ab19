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

from psa_casadi.errors import InputError, PsaError
from psa_casadi.identification.fitting.prediction import measured, predict
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.interruption import current_work
from psa_casadi.model.compose import Model
from psa_casadi.posterior.task import Task
from psa_casadi.units import FloatArray
from psa_casadi.version import __version__


def sampler_and_arviz() -> tuple[Any, Any]:
    """Return the modules nutpie and arviz. Raises InputError where one is not installed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # arviz tells of its next version
            return import_module("nutpie"), import_module("arviz")
    except ImportError as error:
        raise InputError(
            f"A posterior needs nutpie and ArviZ ({error.name} is not installed); run"
            " `pip install 'psa-casadi[sample]'`. `psa identify` gives intervals without them."
        ) from error


@dataclass(frozen=True, eq=False)
class Predictive:
    """Draws that were predicted: `theta` (draws, size), and per record displacement and noise.

    `displacement` (draws, samples) [m] holds noise of the level `noise` (draws,) [m]. `failed` of
    the draws could not be simulated and are left out.
    """

    theta: FloatArray
    displacement: tuple[FloatArray, ...]
    noise: tuple[FloatArray, ...]
    failed: int


def prior_draws(task: Task, count: int, rng: np.random.Generator) -> FloatArray:
    """Return draws of the priors (count, size): normal about their centre, cut at the bounds.

    Offsets have flat priors and stay 0.
    """
    known = np.isfinite(task.unknowns.prior)
    width, found = task.unknowns.prior[known], np.zeros((count, task.unknowns.size))
    low, high = (edge[known] / width for edge in task.unknowns.bounds())
    found[:, known] = width * scipy.stats.truncnorm.rvs(
        low, high, size=(count, int(known.sum())), random_state=rng
    )
    return found


def predictive(
    task: Task, draws: FloatArray, rng: np.random.Generator, *, fit_offset: bool
) -> Predictive:
    """Predict all records at draws of theta (n, size), with white noise at the records' level.

    The level is drawn from its conditional posterior, sigma^2 = S / (c chi^2) with the sum of
    squares S at the draw, c samples counting as one, and n / c degrees of freedom. With
    `fit_offset`, for draws of the prior, whose offsets are flat, the sensor's offset is the one
    that fits best, and the level is that of the fit.
    """
    kept, shown, noise = [], [], []
    for theta in draws:
        try:
            parts = predict(
                task.model, task.experiments, task.unknowns, theta,
                way=task.way, everything=True, differentiated=False,
            )  # fmt: skip
        except PsaError:
            continue
        clean = [p.displacement for p in parts]
        left = [
            (measured(e.record) - y)[e.used] for e, y in zip(task.experiments, clean, strict=True)
        ]
        if fit_offset:
            clean = [y + np.mean(r) for y, r in zip(clean, left, strict=True)]
            levels = list(task.levels)
        else:
            levels = [
                float(np.sqrt(float(r @ r) / c / rng.chisquare(len(r) / c)))
                for r, c in zip(left, task.inflation, strict=True)
            ]
        kept.append(theta)
        noise.append(levels)
        shown.append(
            [y + s * rng.standard_normal(len(y)) for y, s in zip(clean, levels, strict=True)]
        )
    count = len(task.experiments)
    return Predictive(
        theta=np.array(kept).reshape(len(kept), draws.shape[1]),
        displacement=tuple(
            np.array([own[k] for own in shown]).reshape(len(kept), e.record.n)
            for k, e in enumerate(task.experiments)
        ),
        noise=tuple(np.array([own[k] for own in noise]) for k in range(count)),
        failed=len(draws) - len(kept),
    )


Progress = Callable[[str], None]

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
    progress: Progress = lambda _: None,
) -> Chains:
    """Draw from a density, `tune` draws to adapt step and metric first, which are thrown away.

    The chains start around u = 0. The No-U-Turn sampler (Hoffman and Gelman, JMLR 15, 2014) is
    nutpie's, whose diagonal metric follows draws and gradients (Seyboldt, Carlson and Carpenter,
    2026). Raises InputError where nutpie is not installed, KeyboardInterrupt.
    """
    nutpie, _ = sampler_and_arviz()
    size, context = density.size, copy_context()

    def make() -> Callable[..., Any]:  # a density for each chain's thread, in the caller's context
        own = context.copy()
        return lambda u: own.run(density, np.asarray(u))

    model = nutpie.compiled_pyfunc.from_pyfunc(
        ndim=size,
        make_logp_fn=make,
        make_expand_fn=lambda *_: lambda u: {"u": np.array(u)},
        expanded_dtypes=[np.dtype("float64")],
        expanded_shapes=[(size,)],
        expanded_names=["u"],
        make_initial_point_fn=lambda own: (
            _SPREAD * np.random.default_rng(own).standard_normal(size)
        ),
    )
    running = nutpie.sample(
        model, draws=draws, tune=tune, chains=chains, cores=cores, seed=seed,
        target_accept=_ACCEPT, progress_bar=False, save_warmup=False, blocking=False,
    )  # fmt: skip
    progress("sampling")
    found = None
    try:
        while found is None:
            with suppress(TimeoutError):
                found = running.wait(timeout=_LOOK)
    except KeyboardInterrupt:
        current_work().stop()
        running.cancel()
        raise
    statistics = {
        ours: found.sample_stats[theirs].to_numpy()
        for theirs, ours in _STATISTICS.items()
        if theirs in found.sample_stats
    }
    return Chains(found.posterior["u"].to_numpy(), statistics)


_RECORD = "record"


def columns_of_records(task: Task) -> tuple[str, ...]:
    """Return the name of each record's displacement in the tree."""
    if len(task.experiments) == 1:
        return ("displacement",)
    return tuple(f"displacement_{k + 1}" for k in range(len(task.experiments)))


def data_tree(
    task: Task, chains: Chains, theta: FloatArray, prior: Predictive, posterior: Predictive
) -> Any:
    """Return an `arviz.InferenceData` of all groups; `theta` is (chains, draws, size)."""
    _, arviz = sampler_and_arviz()
    told = _units(task.model, task.unknowns)
    dims = {n: [_RECORD] for n in told if n.startswith("start_") or n in ("offset", "noise")}
    seen, applied, times = {}, {}, {}
    for column, e in zip(columns_of_records(task), task.experiments, strict=True):
        time = f"time_{column}"
        seen[column], times[time] = measured(e.record), e.record.time
        applied[f"voltage_{column}"] = e.record.voltage
        dims |= {column: [time], f"voltage_{column}": [time]}
    predictions = [
        {
            **{c: y[None] for c, y in zip(seen, p.displacement, strict=True)},
            "noise": np.stack(p.noise, axis=-1)[None],
        }
        for p in (posterior, prior)
    ]
    tree = arviz.from_dict(
        posterior=quantities(task, theta),
        sample_stats=chains.statistics,
        prior=quantities(task, prior.theta[None]),
        posterior_predictive=predictions[0],
        prior_predictive=predictions[1],
        observed_data=seen,
        constant_data=applied,
        coords={_RECORD: [e.record.name for e in task.experiments], **times},
        dims=dims,
    )
    kinds = {"displacement": ("m", "Displacement"), "voltage": ("V", "Voltage")}
    kinds["time"] = ("s", "Time")
    for group in tree.groups():
        for name in tree[group].variables:
            unit, meaning = kinds.get(name.partition("_")[0], told.get(name, ("", "")))
            if unit:
                tree[group][name].attrs |= {"units": unit, "long_name": meaning}
    tree.posterior.attrs["inference_library"] = "nutpie"
    tree.posterior.attrs["created_by"] = f"psa_casadi {__version__}"
    return tree


def quantities(task: Task, theta: FloatArray) -> dict[str, FloatArray]:
    """Return parameters, starts and offsets in SI units, each (chains, draws[, records])."""
    u, shape = task.unknowns, theta.shape[:2]
    flat = theta.reshape(-1, theta.shape[2])
    rows = [u.values(t) for t in flat]
    found = {n: np.array([r[n] for r in rows]).reshape(shape) for n in u.names}
    starts = [[u.start(t, k) for k in range(u.records)] for t in flat]
    for name in _states(u):
        own = [[s.get(name, np.nan) for s in each] for each in starts]
        found[f"start_{name}"] = np.array(own).reshape(*shape, u.records)
    offsets = [[u.offset(t, k) for k in range(u.records)] for t in flat]
    found["offset"] = np.array(offsets).reshape(*shape, u.records)
    return found


def _states(u: Unknowns) -> tuple[str, ...]:
    return tuple(dict.fromkeys(n for started in u.started for n in started))


def _units(model: Model, u: Unknowns) -> dict[str, tuple[str, str]]:
    """Return unit and meaning of every variable."""
    told = {n: (model.parameter(n).unit, model.parameter(n).description) for n in u.names}
    states = {s.name: s for s in model.structure.states}
    for name in _states(u):
        meaning = f"Start of a record: {states[name].description}, as a deviation from rest"
        told[f"start_{name}"] = (states[name].unit, meaning)
    told["offset"] = ("m", "Offset of the displacement sensor in a record")
    told["noise"] = ("m", "Standard deviation of the noise of a record")
    return told
