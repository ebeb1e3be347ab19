"""Models that a designed record shall tell apart or sharpen: values, unknowns, what is known.

A rival's unknowns are coordinates delta around its values: its free parameters, and for the new
record the initial states that no voltage tells, in nominal sizes, and the sensor's offset in um.
What the records at hand say of the parameters is an information matrix, their own initial states
and offsets eliminated: H = H_pp - H_pn H_nn^-1 H_np, with the weak priors of the fits.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.design.experiment.limits import Limits
from psa_casadi.diagnosis.colour import Colour, colour_of
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import predict_record
from psa_casadi.identification.fitting.unknowns import (
    Unknowns,
    memory_priors,
    memory_sizes,
    unknowns_of,
)
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.start import memory_names
from psa_casadi.units import FloatArray

#: Standard errors by which the cautious truth has less of its effect, and the most that it loses.
_CAUTION, _LOSS = 1.0, 0.75
#: How far other parameters may move with it, in natural logarithms.
_FARTHEST = 1.0
#: Tolerance of trajectories: far below what a step of the gradient changes.
RTOL = 1e-6
_OFFSET = 1e-6


@dataclass(frozen=True)
class SensorNoise:
    """Noise of the sensor: `rms` [m], and the `correlation` of neighbouring samples, 0 if white."""

    rms: float
    correlation: float = 0.0

    def on_grid(self, limits: Limits, samples: int) -> Colour:
        """Return the noise on a grid of fewer samples that tells as much about slow signals.

        On every m-th sample the correlation is r^m, and the variance is such that the density at
        frequency 0, s^2 (1 + r)/(1 - r), over the number of samples stays what it is.
        """
        r = self.correlation
        m = limits.samples / samples
        coarse = r**m
        density = self.rms**2 * (1.0 + r) / (1.0 - r) / m
        variance = density * (1.0 - coarse) / (1.0 + coarse)
        colour = np.array([coarse] if coarse > 0.0 else [])
        return Colour((colour,), float(np.sqrt(variance * (1.0 - coarse**2))), (samples,))


@dataclass(frozen=True, eq=False)
class Rival:
    """A model with the coordinates `theta` (k,) of its free parameters and what is known of them.

    `known` (k, k) is the information of the records at hand and the priors; `evidence` is ln of the
    Bayes factor over the base that those records give. `less` (k,) is the way from `theta` to what
    the rival is taken for where it is the truth.
    """

    name: str
    model: Model
    unknowns: Unknowns
    theta: FloatArray
    known: FloatArray
    evidence: float = 0.0
    less: FloatArray | None = None

    @property
    def truth(self) -> FloatArray:
        """Return the coordinates (size,) at which it is the truth that a record shall show."""
        own = np.zeros(len(self.theta)) if self.less is None else self.less
        low, high = self.bounds()
        return np.clip(np.append(own, np.zeros(self.size - len(own))), low, high)

    @property
    def size(self) -> int:
        """Number of coordinates for a new record: parameters, initial states, offset."""
        return len(self.theta) + len(memory_names(self.model.structure)) + 1

    @property
    def information(self) -> FloatArray:
        """Return what is known of all coordinates, (size, size); nothing of the offset."""
        count, states = len(self.theta), len(memory_names(self.model.structure))
        full = np.zeros((self.size, self.size))
        full[:count, :count] = self.known
        where = np.arange(count, count + states)
        full[where, where] = 1.0 / np.square(memory_priors(self.model))
        return full

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and highest delta (size,) that the parameters' bounds allow."""
        count, rest = len(self.theta), np.full(self.size - len(self.theta), np.inf)
        low, high = (edge[:count] - self.theta for edge in self.unknowns.bounds())
        return np.append(np.minimum(low, 0.0), -rest), np.append(np.maximum(high, 0.0), rest)

    def moved(self, delta: FloatArray) -> tuple[Model, dict[str, float]]:
        """Return the model and the deviations of its initial states at delta (size,)."""
        count = len(self.theta)
        values = self.unknowns.values(self.theta + delta[:count])
        sizes = memory_sizes(self.model)
        start = dict(zip(sizes, (np.array(list(sizes.values())) * delta[count:-1]).tolist(),
                         strict=True))  # fmt: skip
        return self.model.with_values(values), start

    def predict(self, record: Record, delta: FloatArray) -> FloatArray:
        """Return the displacement (n,) [m] that the rival predicts at delta."""
        model, start = self.moved(delta)
        y, *_ = predict_record(model, record, start, (), stop=record.n, rtol=RTOL)
        shown: FloatArray = y + _OFFSET * delta[-1]
        return shown

    def sensitivities(self, record: Record, delta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the displacement (n,) [m] and its exact derivative by delta (n, size) [m]."""
        model, start = self.moved(delta)
        y, by_parameter, by_start = predict_record(
            model, record, start, self.unknowns.names, stop=record.n, rtol=RTOL
        )
        slopes = self.unknowns.slopes(self.theta + delta[: len(self.theta)])
        sizes = np.array(list(memory_sizes(model).values()))
        columns = [by_parameter @ slopes, by_start * sizes, np.full((record.n, 1), _OFFSET)]
        return y + _OFFSET * delta[-1], np.hstack(columns)


def rival_of_fit(name: str, fit: Fit, colour: Colour, evidence: float = 0.0) -> Rival:
    """Return a fitted model as a rival; what it was fitted to is what is known of it.

    `colour` is the noise of the fit's samples.
    """
    count = len(fit.unknowns.names)
    white = colour.whiten(fit.jacobian) / colour.level
    full = white.T @ white + np.diag(1.0 / fit.unknowns.prior**2)
    inner, cross = full[count:, count:], full[:count, count:]
    known = full[:count, :count] - cross @ np.linalg.pinv(inner, hermitian=True) @ cross.T
    less = _less(name, fit, known)
    return Rival(name, fit.model, fit.unknowns, fit.theta[:count].copy(), known, evidence, less)


def _less(name: str, fit: Fit, known: FloatArray) -> FloatArray:
    """Return the way (k,) to the likeliest values with a standard error less of an effect's gain.

    Where a record hardly tells how strong an effect is, its fit may be far too strong, and what
    would tell that from a rival may not tell the truth. theta moves by C_g / C_gg of the gain's.
    """
    gain = next((c.gain for c in fit.model.components if c.name == name), None)
    names = fit.unknowns.names
    if gain is None or gain not in names:
        return np.zeros(len(names))
    k = names.index(gain)
    own = np.linalg.pinv(known, hermitian=True)[:, k]
    size = fit.model.values[gain] / fit.unknowns.scale[k]
    shift = min(_CAUTION * float(np.sqrt(max(own[k], 0.0))), _LOSS * abs(size))
    less: FloatArray = -float(np.sign(size)) * shift * own / max(own[k], 1e-300)
    farthest = float(np.max(np.abs(less[fit.unknowns.log[: len(less)]]), initial=0.0))
    return less * min(1.0, _FARTHEST / max(farthest, 1e-300))


def rival_of_model(name: str, model: Model, free: Sequence[str]) -> Rival:
    """Return a model of which only the order of magnitude of its free parameters is known."""
    unknowns = unknowns_of(model, free, [], [], _OFFSET)
    theta = unknowns.coordinates(model.values)
    return Rival(name, model, unknowns, theta, np.diag(1.0 / unknowns.prior[: len(theta)] ** 2))


def noise_of_fit(fit: Fit, experiments: Sequence[Experiment]) -> tuple[SensorNoise, Colour]:
    """Return the noise that a fit's residuals show: rms and correlation, and as their colour."""
    colour = colour_of(fit.residuals, [int(e.used.sum()) for e in experiments])
    first = colour.autoregression[0]
    correlation = float(first[0]) if first.size else 0.0
    return SensorNoise(fit.rms, correlation), colour
