"""Which noise a fitted model leaves of every output of its records."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.records.noise_kinds import NoiseFound, noise_kinds
from psa_casadi.records.split import Experiment
from psa_casadi.units import FloatArray


def noise_found(fit: Fit, experiments: Sequence[Experiment]) -> tuple[NoiseFound, ...]:
    """Return the kinds of noise in every output of every record, fitted and held-out samples.

    The model is simulated once more. Raises SimulationError where it cannot be.
    """
    found = []
    for e, shown in zip(experiments, fit.shown(experiments), strict=True):
        named = (e.record.column(n) for n in fit.model.input_names)
        moving = [u for u in named if u is not None and np.isfinite(u).all() and np.ptp(u) > 0.0]
        for j, channel in enumerate(e.channels):
            y = shown[:, j]
            inputs = sorted(moving, key=lambda u: -_correlation(u, y))
            used = e.at(j, e.used | e.held_out)
            kinds = noise_kinds(e.record.time, e.measured(j), y, inputs, used)
            found.append(NoiseFound(e.record.name, channel.column, channel.unit, kinds))
    return tuple(found)


def _correlation(u: FloatArray, y: FloatArray) -> float:
    """Return the size of the correlation of an input with an output (n,), 0 where there is none."""
    there = np.isfinite(y)
    if not there.any() or not np.ptp(y[there]) > 0.0 or not np.ptp(u[there]) > 0.0:
        return 0.0
    return abs(float(np.corrcoef(u[there], y[there])[0, 1]))
