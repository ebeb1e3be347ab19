"""Ringing that a residual shows: a resonance near or above the band that the base has missed.

After each step of the force a resonance rings, and what the samples show of it is a tone below half
the sampling rate f_s that decays as fast as the resonance itself, whatever its own frequency: one
at f is seen at |f - k f_s|. Any such tone adds, with unknown amplitude and phase,

    q_k = 2 Re(z) q_(k-1) - |z|^2 q_(k-2) + b_0 (F_k - F_(k-1)) + b_1 (F_(k-1) - F_(k-2)),
    z = exp((-2 pi d + 2 pi i f) / f_s)

to the prediction, F the force. The residual is projected on it for a grid of f and d, as in
`screening`, the fitted parameters' directions taken out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.noise.colour import residual_colour
from psa_casadi.diagnosis.screening.screen import independent, without
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.force_start import force_of
from psa_casadi.records.quality.filtering import filtered
from psa_casadi.records.split import Experiment, fitted

FloatArray = npt.NDArray[np.float64]

#: Tones and decay rates that are tried, over the sampling rate.
_TONES, _DECAYS = np.arange(0.04, 0.501, 0.02), (0.03, 0.06, 0.12, 0.25)
#: Records whose sampling interval differs by this share do not contribute, nor those that gaps make
#: this many times as long as their samples.
_SAME, _LONGER = 0.01, 4.0
#: Multiple of the sampling rate about which a tone's resonance may lie at most.
_IMAGES = 2
#: Less than this of a column is rounding.
_NEW = 1e-7


@dataclass(frozen=True)
class Ringing:
    """A decaying tone in a residual.

    `tone` [Hz] and `decay` [Hz], damping ratio times frequency; `rate` of sampling [Hz];
    `decrease` of the whitened sum of squares over the noise's variance, two amplitudes being free.
    """

    tone: float
    decay: float
    rate: float
    decrease: float

    @property
    def resonances(self) -> tuple[tuple[float, float], ...]:
        """Frequencies [Hz] with damping ratios that are seen at this tone when sampled."""
        return tuple((f, min(1.0, self.decay / f)) for f in images(self.tone, self.rate, _IMAGES))


def images(tone: float, rate: float, most: int) -> list[float]:
    """Return what is seen at a tone f, |k f_s + f| and |k f_s - f| for k up to `most` [Hz].

    At half the sampling rate these are pairs, apart by rounding only.
    """
    found = {round(abs(k + sign * tone / rate), 9) for k in range(most + 1) for sign in (1.0, -1.0)}
    return [share * rate for share in sorted(found)]


def ringing(fit: Fit, experiments: Sequence[Experiment]) -> Ringing | None:
    """Return the tone that explains most of a residual; None where no record can show one.

    The residual is whitened by its own autoregression, so that a tone has to follow the force to
    count: one that is there all the time is taken for colour.
    """
    interval = min(e.record.sample_time for e in fitted(experiments))
    forces = [
        None if e.held_out_whole else _force(fit, k, e, interval) for k, e in enumerate(experiments)
    ]
    if all(f is None for f in forces):
        return None
    colour = residual_colour(fit.residuals, [int(e.used.sum()) for e in experiments])
    basis = independent(colour.whiten(fit.jacobian))
    residual = without(colour.whiten(fit.residuals), basis)
    best: Ringing | None = None
    for tone in _TONES:
        columns = [_response(forces, experiments, interval, tone, d) for d in _DECAYS]
        free = without(colour.whiten(np.hstack(columns)), basis)
        for decay, own in zip(_DECAYS, np.hsplit(free, len(_DECAYS)), strict=True):
            decrease = _explained(own, residual) / colour.level**2
            if best is None or decrease > best.decrease:
                best = Ringing(float(tone) / interval, decay / interval, 1.0 / interval, decrease)
    return best


def _explained(columns: FloatArray, residual: FloatArray) -> float:
    """Return the decrease of a residual's (n,) sum of squares along two columns (n, 2).

    A sixth of the time of their orthonormal basis by `independent`. Of one in the other's
    direction, and of none, nothing counts.
    """
    found = 0.0
    first: FloatArray | None = None
    for column in np.ascontiguousarray(columns.T):
        size = float(np.linalg.norm(column))
        own = column if first is None else column - (first @ column) * first
        norm = float(np.linalg.norm(own))
        if norm > _NEW * size:
            first = own / norm
            found += float(first @ residual) ** 2
    return found


def _force(fit: Fit, number: int, experiment: Experiment, interval: float) -> FloatArray | None:
    """Return a record's simulated force [N] from its first sample on, at even distances [s].

    None where the record is sampled at another rate, is mostly gaps, or cannot be simulated.
    """
    record = experiment.record
    count = _places(experiment, interval)[-1] + 1
    if abs(record.sample_time / interval - 1.0) > _SAME or count > _LONGER * record.n:
        return None
    try:
        force = force_of(fit, number, record)
    except PsaError:
        return None
    even = record.time[0] + interval * np.arange(count)
    change: FloatArray = np.interp(even, record.time, force - force[0])
    return change


def _places(experiment: Experiment, interval: float) -> npt.NDArray[np.int64]:
    """Return which of the even samples each sample of a record is, or is next to."""
    time = experiment.record.time
    found: npt.NDArray[np.int64] = np.rint((time - time[0]) / interval).astype(np.int64)
    return found


def _response(
    forces: Sequence[FloatArray | None],
    experiments: Sequence[Experiment],
    interval: float,
    tone: float,
    decay: float,
) -> FloatArray:
    """Return the two columns of a tone at the used samples; tone and decay over the rate."""
    z = np.exp(-2.0 * np.pi * decay + 2j * np.pi * tone)
    poles = [1.0, -2.0 * z.real, abs(z) ** 2]
    parts = []
    for force, e in zip(forces, experiments, strict=True):
        own = np.zeros((int(e.used.sum()), 2))
        if force is not None:
            where = _places(e, interval)[e.used]
            rung = filtered([1.0, -1.0], poles, force)
            own[:, 0] = rung[where]
            own[:, 1] = np.append(0.0, rung)[where]  # a sample later
        parts.append(own)
    return np.vstack(parts)
