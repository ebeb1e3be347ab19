"""The paper's model in plain NumPy and SciPy with slow creep behind it: judges designed inputs.

    d = x + creep_gain (z_1 + z_2 + z_3),   creep_time 10^(i-1) z_i' = x - z_i

with x from `psa_casadi.reference`; the relaxations are exact for an x that is linear between
samples. No part of the symbolic model is in it.
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from psa_casadi import reference

FloatArray = npt.NDArray[np.float64]

_RATIOS = (1.0, 10.0, 100.0)


def creeping_displacement(
    values: Mapping[str, float], time: FloatArray, voltage: FloatArray, *, rtol: float = 1e-7
) -> FloatArray:
    """Return the displacement (n,) [m] of a voltage (n,) [V] that starts at 0 from rest."""
    found = reference.simulate(
        values, reference.from_samples(time, voltage), time,
        breakpoints=[float(t) for t in time[1:-1]], rtol=rtol,
    )  # fmt: skip
    return crept(values, time, found.displacement)


def crept(values: Mapping[str, float], time: FloatArray, x: FloatArray) -> FloatArray:
    """Return the displacement (n,) [m] with creep behind an x (n,) [m] that began at rest."""
    gain, first = values.get("creep_gain", 0.0), values.get("creep_time", 1.0)
    return np.asarray(x + gain * sum(_relaxed(time, x, first * r) for r in _RATIOS))


def _relaxed(time: FloatArray, x: FloatArray, constant: float) -> FloatArray:
    """Solve constant z' = x - z for an x that is linear between samples, from z = x."""
    z, decays = np.empty_like(x), np.exp(-np.diff(time) / constant)
    z[0] = x[0]
    for k, (h, decay) in enumerate(zip(np.diff(time), decays, strict=True)):
        slope = (x[k + 1] - x[k]) / h
        z[k + 1] = x[k + 1] - slope * constant + decay * (z[k] - x[k] + slope * constant)
    return z
