"""A voltage held within the amplifier's limits, and what a response says of where they bind."""

from math import inf

import numpy as np
import numpy.typing as npt

from psa_casadi.design.tracking.amplifier_limits import AmplifierLimits
from psa_casadi.design.tracking.verification import Response
from psa_casadi.model.compose import Model
from psa_casadi.records.quality.runs import runs_of
from psa_casadi.units import FloatArray

BoolArray = npt.NDArray[np.bool_]

#: Share of the largest current that a held voltage aims at: the lag's own part needs the rest.
_CURRENT = 0.98
#: A limit binds where no more than this share of it is left.
_BINDS = 0.01
#: Samples between two runs at a limit that count as one run.
_GAP = 4
#: Spans of time that a sentence names one by one.
_NAMED = 3


def held(
    model: Model, limits: AmplifierLimits, time: FloatArray, voltage: FloatArray
) -> FloatArray:
    """Return the voltage (n,) [V] clipped to its limits, and slowed to those of rate and current.

    The current of the drive is C_p u', u the voltage behind amplifier and lag, whose largest rate
    is no more than that of G v; a stack without these parameters has no limit of current here.
    """
    p, rate = model.values, limits.max_rate
    if np.isfinite(limits.max_current) and "C_p" in p:
        rate = min(rate, _CURRENT * limits.max_current / (p["C_p"] * p.get("G", 1.0)))
    clipped = np.clip(voltage, limits.min_voltage, limits.max_voltage)
    if rate == inf:
        return np.asarray(clipped)
    slowed = clipped.copy()
    for k, step in enumerate(rate * np.diff(time)):
        slowed[k + 1] = min(max(clipped[k + 1], slowed[k] - step), slowed[k] + step)
    return np.asarray(slowed)


def binding(response: Response, limits: AmplifierLimits) -> tuple[str, ...]:
    """Return one sentence for each limit that a response stands at: which, and from when to when.

    A rate or a current counts where it lasts for three samples at least.
    """
    v, rate = response.voltage, np.diff(response.voltage) / np.diff(response.time)
    rate, least = np.abs(np.concatenate([rate[:1], rate])), (1, 1, 3, 3)
    room = _BINDS * np.ptp(v)
    current = np.abs(response.current)
    cases = (
        (f"highest voltage, {limits.max_voltage:.4g} V", v > limits.max_voltage - room),
        (f"lowest voltage, {limits.min_voltage:.4g} V", v < limits.min_voltage + room),
        (f"largest rate, {limits.max_rate:.4g} V/s", rate > (1.0 - _BINDS) * limits.max_rate),
        (
            f"largest current, {limits.max_current:.4g} A",
            current > (1.0 - 3.0 * _BINDS) * limits.max_current,
        ),
    )
    sentences = []
    for (name, stands), fewest in zip(cases, least, strict=True):
        spans = [(a, b) for a, b in _runs(stands) if b - a + 1 >= fewest]
        if spans:
            share = 100.0 * sum(b - a + 1 for a, b in spans) / len(v)
            when = f"{_when(spans, response.time)} ({share:.2g} % of the samples)"
            sentences.append(f"The {name}, is reached {when}.")
    return tuple(sentences)


def _runs(stands: BoolArray) -> list[tuple[int, int]]:
    """Return first and last sample of every run of True; short gaps do not end one."""
    spans: list[tuple[int, int]] = []
    for first, stop in zip(*(ends.tolist() for ends in runs_of(stands)), strict=True):
        if spans and first - spans[-1][1] <= _GAP:
            spans[-1] = (spans[-1][0], stop - 1)
        else:
            spans.append((first, stop - 1))
    return spans


def _when(spans: list[tuple[int, int]], time: FloatArray) -> str:
    named = [f"from {1e3 * time[a]:.4g} to {1e3 * time[b]:.4g} ms" for a, b in spans[:_NAMED]]
    more = len(spans) - _NAMED
    return " and ".join(named) + (f", and {more} times more" if more > 0 else "")
