"""A device whose effect is told relative to its first record, in the terms of another record.

Three effects are drawn relative to the record that they are hidden in: the drift to its length T,
the heating to its mean loss P, the clipping to its highest voltage V. On a record with T', P', V'
the same device has

    drift       g' = g T'/T,  c' = c T/T',  q' = q T/T',  s_1' = s_1 T/T',  e' = e
    heating     g' = g P'/P
    clipping    (1 - g') V' = (1 - g) V,  no less than 0
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.make import Truth
from tests.studies.plants.self_heating import heat
from tests.studies.plants.stack import FloatArray

_IN_LENGTHS = ("exponential", "q", "s_1")


def in_terms_of(truth: Truth, times: FloatArray, command: FloatArray) -> Truth:
    """Return the truth whose effect on times (N,) [s] and commands (N,) [V] is the same device's.

    Further effects stay as they are.
    """
    if truth.effect == "offset_drift":
        ratio = _length(times) / _length(truth.times)
        parameters = {n: v / ratio if n in _IN_LENGTHS else v for n, v in truth.parameters.items()}
        return replace(truth, gain=truth.gain * ratio, parameters=parameters)
    if truth.effect == "self_heating":
        losses = [
            _mean_loss(simulate_base(truth.stack, t, v), truth.parameters)
            for t, v in ((truth.times, truth.voltage), (times, command))
        ]
        return replace(truth, gain=truth.gain * losses[1] / losses[0])
    if truth.effect == "voltage_saturation":
        ends = (1.0 - truth.gain) * float(truth.voltage.max())
        return replace(truth, gain=max(0.0, 1.0 - ends / float(command.max())))
    return truth


def _length(times: FloatArray) -> float:
    return float(times[-1] - times[0])


def _mean_loss(run: Run, parameters: Mapping[str, float]) -> float:
    """Return what the plant's temperature is divided by [V^q/s]."""
    energy: FloatArray = heat(run.path.path_voltage, parameters["q"])[run.path.node]
    return float(energy[-1]) / float(np.ptp(run.times))
