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
from scipy.signal import lfilter

from psa_casadi.diagnosis.colour import residual_colour
from psa_casadi.diagnosis.screening import independent, without
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.fit import Fit
from psa_casadi.simulation.simulate import simulate_record

FloatArray = npt.NDArray[np.float64]

#: Tones and decay rates that are tried, over the sampling rate.
_TONES, _DECAYS = np.arange(0.04, 0.501, 0.02), (0.03, 0.06, 0.12, 0.25)
#: Records whose sampling interval or whose steps differ by this share do not contribute.
_SAME = 0.01
#: Multiples of the sampling rate about which a tone's resonance may lie.
_IMAGES = (0, 1, 2)


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
        images = {abs(k * self.rate + sign * self.tone) for k in _IMAGES for sign in (1.0, -1.0)}
        return tuple((f, min(1.0, self.decay / f)) for f in sorted(images))


def ringing(fit: Fit, experiments: Sequence[Experiment]) -> Ringing | None:
    """Return the tone that explains most of a residual; None where no record can show one.

    The residual is whitened by its own autoregression, so that a tone has to follow the force to
    count: one that is there all the time is taken for colour.
    """
    interval = min(e.record.sample_time for e in experiments)
    forces = [_force(fit, k, e) if _even(e, interval) else None for k, e in enumerate(experiments)]
    if all(f is None for f in forces):
        return None
    colour = residual_colour(fit.residuals, [int(e.used.sum()) for e in experiments])
    basis = independent(colour.whiten(fit.jacobian))
    residual = without(colour.whiten(fit.residuals), basis)
    best: Ringing | None = None
    for tone in _TONES:
        for decay in _DECAYS:
            columns = colour.whiten(_response(forces, experiments, tone, decay))
            own = independent(without(columns, basis))
            decrease = float(np.sum((own.T @ residual) ** 2)) / colour.level**2
            if best is None or decrease > best.decrease:
                best = Ringing(float(tone) / interval, decay / interval, 1.0 / interval, decrease)
    return best


def _even(experiment: Experiment, interval: float) -> bool:
    """Whether a record is sampled evenly at this interval [s]."""
    steps = np.diff(experiment.record.time)
    return bool(np.all(np.abs(steps - interval) < _SAME * interval))


def _force(fit: Fit, number: int, experiment: Experiment) -> FloatArray:
    """Return a record's simulated force, linear and hysteresis, from its first sample on [N]."""
    run = simulate_record(fit.model, experiment.record, memory=fit.start(number))
    force = fit.model.values["k_L"] * run.states["u"] + run.states["f_H"]
    change: FloatArray = force - force[0]
    return change


def _response(
    forces: Sequence[FloatArray | None],
    experiments: Sequence[Experiment],
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
            for column, zeros in enumerate(([1.0, -1.0], [0.0, 1.0, -1.0])):
                own[:, column] = np.asarray(lfilter(zeros, poles, force))[e.used]
        parts.append(own)
    return np.vstack(parts)
