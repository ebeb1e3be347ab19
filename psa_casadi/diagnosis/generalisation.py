"""Does a model hold where it was not fitted? Held-out errors against those of the fit."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy import stats

from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.errors_of import held_out_residuals
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.fit import Fit

FloatArray = npt.NDArray[np.float64]

#: Held-out errors say that something is missing below this probability, and by this ratio [-] of
#: their rms to that of the fit.
ALARM, RATIO = 1e-4, 1.05
#: Largest held-out errors that do not count (stray readings), and the fewest that are tested.
_STRAY, _FEWEST = 2, 50


def held_out_excess(
    fit: Fit, experiments: Sequence[Experiment], predicted: Sequence[FloatArray], colour: Colour
) -> float:
    """Return by which factor the held-out rms exceeds the fit's [-]; 1 where noise would do so.

    Both are whitened by `colour` and scaled by the records' noise. The ratio F of their mean
    squares is about normal under noise of kurtosis K, with mean (n + k)/(n - k) for k fitted
    parameters and n samples of the fit, and variance (K - 1)(1/m + 1/n) for m held-out samples.
    """
    held = held_out_residuals(experiments, predicted)
    scaled = np.concatenate([h / s for h, s in zip(held, fit.sigma, strict=True)])
    lengths = tuple(len(h) for h in held)
    squares = np.sort(replace(colour, lengths=lengths).whiten(scaled) ** 2)[:-_STRAY]
    used = [r / s for r, s in zip(fit.residuals_of(experiments), fit.sigma, strict=True)]
    learnt = colour.whiten(np.concatenate(used)) ** 2
    n, m, k = len(learnt), len(squares), len(fit.theta)
    power = float(np.mean(learnt))
    if m < _FEWEST or n <= 2 * k or power <= 0:
        return 1.0
    ratio = float(np.mean(squares)) / power
    kurtosis = max(3.0, float(np.mean(learnt**2)) / power**2)
    spread = np.sqrt((kurtosis - 1.0) * (1.0 / m + 1.0 / n))
    usual = (n + k) / (n - k)
    chance = float(stats.norm.sf((ratio / usual - 1.0) / spread))
    return float(np.sqrt(ratio)) if chance < ALARM and ratio > RATIO**2 else 1.0
