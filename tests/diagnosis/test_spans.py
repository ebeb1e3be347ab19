"""Noise passes for an effect that is linear in weights no more often than for any other."""

import numpy as np
from scipy.stats import chi2

from psa_casadi.diagnosis.probes import Span
from psa_casadi.diagnosis.task import LIMITS


def test_noise_passes_the_threshold_no_more_often_than_along_one_direction() -> None:
    """In 0.5 % of 40,000 draws, of any number of weights; hardly visible ones do not count."""
    rng = np.random.default_rng(3)
    level = chi2.isf(LIMITS.false_alarm, 1)
    for size in (1, 3, 9):
        unit, _ = np.linalg.qr(rng.standard_normal((50, size)))
        for norms in (np.full(size, 30.0), np.geomspace(30.0, 1e-3, size)):
            span = Span(unit.T @ unit, norms, LIMITS.false_alarm)
            drawn = span.decrease(rng.standard_normal((40_000, 50)) @ unit)
            assert np.mean(drawn > level) < 0.0065
        assert np.mean(Span(unit.T @ unit, np.full(size, 30.0), LIMITS.false_alarm).decrease(
            rng.standard_normal((40_000, 50)) @ unit) > level) > 0.0035  # fmt: skip
