"""Chains of the No-U-Turn sampler on a density with its gradient."""

from collections.abc import Callable
from contextvars import Context, copy_context
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from psa_casadi.interruption import current_work
from psa_casadi.posterior.packages import sampler_and_arviz
from psa_casadi.units import FloatArray

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
    size = density.size
    model = nutpie.compiled_pyfunc.from_pyfunc(
        ndim=size,
        make_logp_fn=_in_context(copy_context(), density),
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
    found = _waited(running, progress)
    statistics = {
        ours: found.sample_stats[theirs].to_numpy()
        for theirs, ours in _STATISTICS.items()
        if theirs in found.sample_stats
    }
    return Chains(found.posterior["u"].to_numpy(), statistics)


def _in_context(context: Context, density: Sampled) -> Callable[[], Callable[..., Any]]:
    """Return what makes a density for each chain's thread, in the context of the caller."""

    def make() -> Callable[..., Any]:
        own = context.copy()
        return lambda u: own.run(density, np.asarray(u))

    return make


def _waited(running: Any, progress: Progress) -> Any:
    """Return the trace once all chains have ended; an interrupt ends them."""
    progress("sampling")
    try:
        while True:
            try:
                return running.wait(timeout=_LOOK)
            except TimeoutError:
                continue
    except KeyboardInterrupt:
        current_work().stop()
        running.cancel()
        raise
