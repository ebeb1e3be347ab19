"""A charge drive that loses its whole charge: no base without it comes near, at any frequency."""

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import lfilter

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.records.record import Record

FloatArray = npt.NDArray[np.float64]
FINER, LEAK_TIME = 20, 2.5


def _record(name: str, frequency: float, duration: float, rate: float, seed: int) -> Record:
    """A sine of 0 to 100 V behind a high-pass of 2.5 s, on a Bouc-Wen loop; 5 nm of noise."""
    step = 1.0 / (rate * FINER)
    time = np.linspace(0.0, duration, round(duration * rate) * FINER, endpoint=False)
    u = 50.0 * (1.0 - np.cos(2.0 * np.pi * frequency * time))
    # (T/h)(q - q_1) + (q + q_1)/2 = (T/h)(u - u_1), exact to h^2
    one, half = LEAK_TIME / step, 0.5
    q = lfilter([one / (one + half), -one / (one + half)], [1.0, (half - one) / (one + half)], u)
    h = np.zeros_like(q)
    for k, dq in enumerate(np.diff(q)):
        middle = h[k] + 0.5 * _rate(h[k], dq)
        h[k + 1] = h[k] + _rate(middle, dq)
    x = 1e-7 * (q + h)[::FINER]
    noise = 5e-9 * np.random.default_rng(seed).standard_normal(x.size)
    return Record(name=name, time=time[::FINER], voltage=u[::FINER], displacement=x + noise)


def _rate(h: float, dq: float) -> float:
    return -0.2 * dq - 0.025 * abs(dq) * h - 0.006 * dq * abs(h)


@pytest.mark.slow
def test_it_is_named_alone_and_predicts_a_record_that_no_fit_has_seen() -> None:
    fitted = [_record("slow", 0.05, 60.0, 50.0, 1), _record("fast", 1.0, 10.0, 500.0, 2)]
    d = diagnose(fitted, holdout=[_record("judged", 20.0, 0.5, 5000.0, 3)])
    assert [c.effect for c in d.causes] == ["charge_leakage"], d
    values = d.causes[0].parameters
    assert values["leak_gain"].value == pytest.approx(1.0, abs=2e-3)
    assert values["leak_time"].value == pytest.approx(LEAK_TIME, rel=5e-3)
    assert d.extended_errors.train_rms_m < 5.5e-9
    # base: 29 to 31 %
    assert d.extended_errors.holdout_nrmse_percent < 0.2
