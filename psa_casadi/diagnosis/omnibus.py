"""Is anything missing at all? Tests of a residual that need no named effect."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import stats

from psa_casadi.diagnosis.colour import Colour

FloatArray = npt.NDArray[np.float64]

#: A test alarms below this probability; three tests share it.
ALARM = 1e-3
_LAGS = 25


@dataclass(frozen=True)
class Omnibus:
    """Probability of the residual under noise alone, the test that says so, and where it shows."""

    p_value: float
    excess: float
    where: str

    @property
    def alarm(self) -> bool:
        """Whether something besides noise is in the residual."""
        return self.p_value < ALARM


def omnibus(
    residual: FloatArray, voltage: FloatArray, time: FloatArray, colour: Colour, floor: float
) -> Omnibus:
    """Test a residual (samples,) [m] for structure that noise of the given colour does not have.

    Three tests with Bonferroni's correction: Ljung-Box on the whitened residual; Fisher's g for a
    line in its spectrum; and an F test on general features of the voltage and time. `excess` is the
    share of the residual's power above the noise `floor` [m].
    """
    white = colour.whiten(residual)
    tests = {
        "neighbouring samples are correlated": whiteness(white),
        "its spectrum has a line": _fisher_line(white),
        "it depends on voltage, rate or time": _features(white, voltage, time, colour),
    }
    where, p = min(tests.items(), key=lambda item: item[1])
    power = float(np.mean(residual**2))
    excess = max(0.0, 1.0 - floor**2 / power) if power > 0 else 0.0
    return Omnibus(min(1.0, 3.0 * p), excess, f"In the residual {where}.")


def whiteness(white: FloatArray) -> float:
    """Return the p-value of Ljung and Box's test (1978) that neighbours are not correlated."""
    n = len(white)
    centred = white - np.mean(white)
    power = float(centred @ centred)
    if power <= 0 or n <= 2 * _LAGS:
        return 1.0
    r = np.array([centred[k:] @ centred[:-k] / power for k in range(1, _LAGS + 1)])
    statistic = n * (n + 2) * np.sum(r**2 / (n - np.arange(1, _LAGS + 1)))
    return float(stats.chi2.sf(statistic, _LAGS))


def _fisher_line(white: FloatArray) -> float:
    power = np.abs(np.fft.rfft(white - np.mean(white))[1:-1]) ** 2
    count = len(power)
    if count < 8 or not np.sum(power) > 0:
        return 1.0
    share = float(np.max(power) / np.sum(power))
    return float(min(1.0, count * (1.0 - share) ** (count - 1)))


def _features(white: FloatArray, voltage: FloatArray, time: FloatArray, colour: Colour) -> float:
    """F test of the residual on u, u^2, u^3, sgn(u'), |u'|, u sgn(u'), a trend and slow waves."""
    u = (voltage - np.mean(voltage)) / (np.ptp(voltage) or 1.0)
    rate = np.gradient(u)
    turn = np.sign(rate) * (np.abs(rate) > 1e-3 * np.max(np.abs(rate)))
    t = (time - time[0]) / ((time[-1] - time[0]) or 1.0)
    columns = [np.ones_like(u), u, u**2, u**3, turn, np.abs(rate), u * turn, u**2 * turn, t, t**2]
    columns += [f(np.pi * k * t) for k in (1, 2, 3) for f in (np.sin, np.cos)]
    x = colour.whiten(np.column_stack(columns))
    coefficients, _, rank, _ = np.linalg.lstsq(x, white, rcond=None)
    explained = float(np.sum((x @ coefficients) ** 2))
    rest = float(white @ white) - explained
    freedom = len(white) - rank
    if rest <= 0 or freedom <= 0:
        return 1.0
    return float(stats.f.sf(explained / rank / (rest / freedom), rank, freedom))
