"""What the paper's method asks of the records, and the sentences where they fall short."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.identification.paper.linear import LinearPart, Loop, Step

#: The paper's loops are slower than this [Hz], and their lag should stay below this angle [rad].
_SLOW, _QUASI_STATIC = 1.0, 0.01


def missing(step: Step | None, loops: Sequence[Loop]) -> list[str]:
    """Say what the records lack."""
    sentences = []
    if step is None:
        rest = (
            " k is taken from the slope of the largest loop near its tip, which is not the paper's."
            if loops
            else ""
        )
        sentences.append(
            "No record is a step (a jump of the voltage that is then held), so the linear part"
            " cannot be found by this method: the lag, masses and dampings keep ordinary values."
            f"{rest} Give the response to a step as a record."
        )
    if not loops:
        sentences.append(
            "No record is a loop (a voltage that goes up and down at even intervals), so A, delta,"
            " n, beta and gamma cannot be found by this method: the model has no loop (f_H = 0)."
            " Give two periods of a slow sine or triangle from rest at 0 V."
        )
    return sentences


def loop_conditions(loops: Sequence[Loop], linear: LinearPart | None) -> list[str]:
    """Say where the loops are too fast, do not begin at 0 V, or have gaps."""
    if not loops:
        return []
    sentences, frequency = [], loops[0].frequency
    if frequency > 1.001 * _SLOW:
        sentences.append(
            f"The slowest loops have {frequency:.3g} Hz; the paper asks for less than 1 Hz, so that"
            " mechanics and lag do not widen the loop. Give slower loops."
        )
    if linear is not None:
        delay = linear.coefficients["a_1"] - linear.coefficients["b_1"]
        angle = 2.0 * np.pi * frequency * delay
        if angle > _QUASI_STATIC:
            sentences.append(
                f"The step lags by {1e3 * delay:.3g} ms, {angle:.2g} rad of"
                f" the loops at {frequency:.3g} Hz, which the method counts as hysteresis: A,"
                " delta, n, beta and gamma are off. Give slower loops."
            )
    away = [
        loop.name for loop in loops if abs(loop.first_volts) > 0.02 * float(np.ptp(loop.voltage))
    ]
    if away:
        sentences.append(
            f"{_names(away)} do not begin at 0 V, though the method needs h = 0 at the start; their"
            " first sample is taken for rest. Give loops from rest at 0 V."
        )
    gaps = [f"{loop.name} ({loop.missing})" for loop in loops if loop.missing]
    if gaps:
        sentences.append(
            f"Missing samples were bridged by straight lines in {_names(gaps)}; derivatives there"
            " are not measured."
        )
    return sentences


def _names(names: Sequence[str]) -> str:
    return ", ".join(f"'{n}'" for n in names)
