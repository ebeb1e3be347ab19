"""Does a model hold where it was not fitted? Held-out errors against those of the fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.diagnosis.colour import Colour, rms
from psa_casadi.diagnosis.held_out.errors import held_out_residuals
from psa_casadi.diagnosis.noise import NoiseFloor, knowable_of
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]

#: Largest held-out errors that do not count (stray readings), the fewest that are tested, and those
#: of a whole record: fewer do not tell the colour of its noise.
_STRAY, _FEWEST, _FEWEST_OF_RECORDS = 2, 50, 512


@dataclass(frozen=True)
class Excess:
    """By which factor held-out errors exceed what they should be [-], and its p-value."""

    factor: float = 1.0
    p_value: float = 1.0

    def __bool__(self) -> bool:
        return self.factor > 1.0


def held_out_excess(
    fit: Fit,
    experiments: Sequence[Experiment],
    predicted: Sequence[FloatArray],
    colour: Colour,
    noise: Sequence[NoiseFloor],
) -> Excess:
    """Return by which factor held-out errors exceed those of the fit; 1 where noise would do so.

    Samples of records that are fitted for the most part are compared with the fitted ones, both
    whitened by `colour` and scaled by the records' noise. The ratio F of their mean squares is
    about normal under noise of kurtosis K, with mean (n + k)/(n - k) for k fitted parameters and n
    samples of the fit, and variance (K - 1)(1/m + 1/n) for m held-out samples. Whole records that
    are held out are compared with their own `noise`: parameters that the fitted ones leave open
    make an error there too, so that only a clear excess counts. One below what can be told of a
    stack does not.
    """
    own = [not e.held_out_whole for e in experiments]
    parts = held_out_residuals(experiments, predicted)
    beyond = [
        rms(part) / floor.level
        for part, floor, mine in zip(parts, noise, own, strict=True)
        if not mine and len(part) >= _FEWEST_OF_RECORDS and floor.level > 0
    ]
    found = _within(fit, experiments, parts, colour, own)
    worst = max(beyond, default=0.0)
    if worst > max(thresholds().unseen_ratio_of_records, found.factor):
        found = Excess(worst, thresholds().unseen_alarm)
    size = rms(np.concatenate(parts)) * float(np.sqrt(1.0 - 1.0 / found.factor**2))
    return found if size > knowable_of(fit, experiments) else Excess()


def _within(
    fit: Fit,
    experiments: Sequence[Experiment],
    parts: Sequence[FloatArray],
    colour: Colour,
    own: Sequence[bool],
) -> Excess:
    scales = [1.0 / s if mine else 0.0 for s, mine in zip(fit.sigma, own, strict=True)]
    held = np.concatenate([p * s for p, s in zip(parts, scales, strict=True)])
    used = np.concatenate(
        [r * s for r, s in zip(fit.residuals_of(experiments), scales, strict=True)]
    )
    counts = np.repeat(own, [len(p) for p in parts])
    fitted = np.repeat(own, [int(e.used.sum()) for e in experiments])
    lengths = tuple(len(p) for p in parts)
    squares = np.sort(replace(colour, lengths=lengths).whiten(held)[counts] ** 2)[:-_STRAY]
    learnt = colour.whiten(used)[fitted] ** 2
    n, m, k = len(learnt), len(squares), len(fit.theta)
    power = float(np.mean(learnt)) if n else 0.0
    if m < _FEWEST or n <= 2 * k or power <= 0:
        return Excess()
    ratio = float(np.mean(squares)) / power
    kurtosis = max(3.0, float(np.mean(learnt**2)) / power**2)
    spread = np.sqrt((kurtosis - 1.0) * (1.0 / m + 1.0 / n))
    chance = float(scipy.special.ndtr(-(ratio * (n - k) / (n + k) - 1.0) / spread))
    return Excess(float(np.sqrt(ratio)), chance) if _tells(ratio, chance) else Excess()


def _tells(ratio: float, chance: float) -> bool:
    return chance < thresholds().unseen_alarm and ratio > thresholds().unseen_ratio ** 2
