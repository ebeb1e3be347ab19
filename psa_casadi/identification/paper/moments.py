"""The paper's linear part: six iterated integrals of a step response, eqs. (15) to (21)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from psa_casadi.identification.paper.shapes import STEADY_SHARE, Step
from psa_casadi.records.quality.noise import high_frequency_noise
from psa_casadi.units import FloatArray

#: The coefficients of eq. (15) in the order in which arrays hold them.
COEFFICIENTS = ("a_1", "a_2", "a_3", "a_4", "a_5", "b_1")
#: The window is cut by this share to see whether the coefficients depend on where it ends.
_CUT = 0.1
#: A coefficient that changes by more than this share with the cut is not an estimate.
_STEADY = 0.05
_OVERSHOOT = 0.01


@dataclass(frozen=True, eq=False)
class LinearPart:
    """Coefficients of eq. (15) [s to s^5, then s] and what is doubtful about them, in sentences."""

    coefficients: Mapping[str, float]
    sentences: tuple[str, ...]


def linear_part(step: Step) -> LinearPart:
    """Return a_1..a_5, b_1 by the iterated integrals of one step response, and their doubts."""
    found = moment_coefficients(step.time, step.g)
    sentences = [*_dependence(step, found), *_signs(found)]
    return LinearPart(dict(zip(COEFFICIENTS, found.tolist(), strict=True)), tuple(sentences))


def moment_coefficients(time: FloatArray, g: FloatArray) -> FloatArray:
    """Return a_1..a_5, b_1, shape (6,), of a normalised step response that begins at time 0.

    `time` (n,) [s], `g` (n,) [1]. Exact only if g is free of noise and the window is endless.
    """
    limits = iterated_limits(time, g)
    return coefficients_of_limits(limits)


def iterated_limits(time: FloatArray, g: FloatArray) -> FloatArray:
    """Return K_1..K_6 [s, s^2 ...], shape (6,), eqs. (16), (19), by the trapezoidal rule.

    g_1' = 1 - g,  g_i' = K_(i-1) - g_(i-1),  K_i = lim g_i, for which the last sample stands.
    """
    width = np.diff(time)
    limit, current, limits = 1.0, g, []
    for _ in range(6):
        rest = limit - current
        current = np.concatenate([[0.0], np.cumsum(0.5 * (rest[1:] + rest[:-1]) * width)])
        limit = float(current[-1])
        limits.append(limit)
    return np.array(limits)


def coefficients_of_limits(limits: FloatArray) -> FloatArray:
    """Solve eq. (21) for a_1..a_5, b_1, shape (6,), given K_1..K_6.

    K_1 = a_1 - b_1,  K_i = sum_(j=1..5) (-1)^(j-1) K_(i-j) a_j with K_0 = 1 and K_m = 0 for m < 0.
    Times are counted in units of |K_1| while solving, which keeps the six equations alike in size.
    """
    unit = abs(float(limits[0])) or 1.0
    k = np.concatenate([[1.0], limits / unit ** np.arange(1, 7)])
    matrix = np.zeros((6, 6))
    for i in range(1, 7):
        for j in range(1, min(i, 5) + 1):
            matrix[i - 1, j - 1] = (-1) ** (j - 1) * k[i - j]
    matrix[0, 5] = -1.0
    scaled = np.linalg.lstsq(matrix, k[1:], rcond=None)[0]
    found: FloatArray = scaled * unit ** np.array([1.0, 2.0, 3.0, 4.0, 5.0, 1.0])
    return found


def coefficients_of_values(values: Mapping[str, float]) -> FloatArray:
    """Return a_1..a_5, b_1, shape (6,), of the physical parameters of the cascade, eqs. (13), (15).

    The denominator is (tau s + 1) (m_B/k_B s^2 + c_B/k_B s + 1) (m_P/k_P s^2 + c_P/k_P s + 1).
    """
    product = np.array([values["tau"], 1.0])
    for part in "BP":
        m, c, k = (values[f"{q}_{part}"] for q in "mck")
        product = np.polymul(product, [m / k, c / k, 1.0])
    zero = (values["c_B"] + values["c_P"]) / (values["k_B"] + values["k_P"])
    return np.append(product[-2::-1], zero)


def _dependence(step: Step, found: FloatArray) -> list[str]:
    """Say whether the coefficients depend on the end of the window, and why that may be."""
    kept = step.time <= (1.0 - _CUT) * step.time[-1]
    other = moment_coefficients(step.time[kept], step.g[kept])
    change = np.abs(other - found) / np.maximum(np.abs(found), 1e-300)
    worst = int(np.argmax(change))
    if change[worst] <= _STEADY:
        return []
    reasons = _reasons(step) or ["the window is too short for the higher integrals"]
    return [
        f"The linear part is not to be trusted: without the last tenth of step '{step.name}',"
        f" {COEFFICIENTS[worst]} changes by {_share(change[worst])}, though it should not"
        f" depend on where the window ends. Likely cause: {'; '.join(reasons)}. Use"
        " --method prediction-error for these records."
    ]


def _reasons(step: Step) -> list[str]:
    """Return what keeps the iterated integrals of a step from converging, as parts of a sentence.

    Truncation: the means of the last two twentieths differ. Noise: the high-frequency noise of the
    last quarter. Ringing: the response passes its steady state by more than 1 %.
    """
    g, n = step.g, len(step.g)
    noise = high_frequency_noise(g[-max(n // 4, 8) :])
    last = max(int(STEADY_SHARE * n), 4)
    drift = abs(float(np.mean(g[-last:]) - np.mean(g[-2 * last : -last])))
    overshoot = float(np.max(g)) - 1.0
    reasons = []
    if drift > max(4.0 * noise / np.sqrt(last), 1e-12):
        reasons.append(
            f"the window truncates the response, which still moves by {drift:.1g} of the step at"
            " its end"
        )
    if noise > 1e-9:
        reasons.append(f"white noise of {noise:.1g} of the step, which six integrations amplify")
    if overshoot > max(_OVERSHOOT, 6.0 * noise):
        reasons.append(
            f"the response rings (it overshoots by {100.0 * overshoot:.0f} %), and integrals of a"
            " ringing response converge only long after the ringing has ended"
        )
    return reasons


def _signs(found: FloatArray) -> list[str]:
    """Say which coefficients are not larger than zero, as eq. (15) demands."""
    wrong = [name for name, value in zip(COEFFICIENTS, found, strict=True) if not value > 0.0]
    if not wrong:
        return []
    verb = "is" if len(wrong) == 1 else "are"
    return [
        f"{', '.join(wrong)} {verb} not larger than zero, which the paper's eq. (15) demands: the"
        " moments did not find a stack's transfer function. A longer, quieter step may help."
    ]


def _share(change: float) -> str:
    return f"a factor of {change:.2g}" if change > 10.0 else f"{100.0 * change:.0f} %"
