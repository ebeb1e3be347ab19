"""Rivals, and what a design maximises: their separation, or what is known of parameters.

What a design maximises: its value for inputs, and a function with the same gradient there.

The value involves a re-fit or a covariance, whose derivative by the inputs would need second
derivatives of the trajectories. At one record everything but the trajectories can be held: by the
envelope theorem the derivative of a minimum is that of the function at the minimising point, and
the derivative of a function of the information matrix is linear in that of the sensitivities.

Models that a designed record shall separate or sharpen: values, unknowns, what is known.

A rival's unknowns are coordinates delta around its values: its free parameters, and for the new
record the initial states that no input determines, in nominal sizes, and the offsets of sensors.
Of a stack the states are its memories, and the one sensor has an offset; other models start at
declared or at unknown states.
The records at hand give an information matrix of the parameters, with the initial states and
offsets of these records eliminated: H = H_pp - H_pn H_nn^-1 H_np, with the weak priors of the fits.

Separation of rivals: how far one rival's prediction stays from another that is fitted again.

    T(a, b) = min over delta of |W (y_a(v) - y_b(v, delta))|^2 + delta^T H_b delta

y_a is what rival a predicts for the voltage v, its effect a standard error weaker than fitted, y_b
what rival b does at coordinates delta away from its fit (parameters, initial states, offset), W
whitens the noise, and H_b is what the data at hand know of b: it may move only where they let it.
If a is true, ln of the Bayes factor of a over b is expected to grow by T/2 with variance T. The
value is the logarithm of the harmonic mean of all T(a, b). Sources: Atkinson and Fedorov,
Biometrika 62 (1975), 57 (T-optimality); for Gaussian noise T/2 is the Kullback-Leibler distance
(Lopez-Fidalgo, Tommasi and Trandafir 2007).

Optimality for parameters: the covariance that a record and the data at hand would leave.

    Phi = known + J^T W J,   C = (Phi^-1) of the chosen coordinates

J (m n, size) holds the exact derivatives of the predicted m outputs by parameters, initial states
and offsets; W whitens the noise. D minimises ln det C, A the trace, E the largest eigenvalue;
each is stated as minus the logarithm of a mean standard error, so that a difference d of two values
means intervals narrower by the factor exp(d). Gradient: d phi(C) = -tr(Psi dPhi), with
Psi = Phi^-1 E (d phi/d C) E^T Phi^-1 and E the choice of coordinates. Source: Fedorov and Leonov,
Optimal Design for Nonlinear Response Models, 2013, chapters 2 and 10.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import permutations
from typing import Any, Literal, get_args

import numpy as np

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.design.experiment.limits import Limits
from psa_casadi.diagnosis.colour import Colour, colour_of
from psa_casadi.identification.fitting.fit import Fit, unknowns_around
from psa_casadi.identification.fitting.levenberg_marquardt import minimise
from psa_casadi.identification.fitting.prediction import OUTPUT, trace_record
from psa_casadi.identification.fitting.unknowns import (
    Unknowns,
    coordinates_of,
    memory_starts,
    unknowns_of,
)
from psa_casadi.model.compose import Model
from psa_casadi.records.signals import Hold, Signals
from psa_casadi.records.split import Channel, whole
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.simulate import Traced, Way
from psa_casadi.simulation.start import is_stack
from psa_casadi.simulation.stepper import SimulationError


@dataclass(frozen=True, eq=False)
class Point:
    """A criterion at one record: its value, and a function of the inputs with its gradient."""

    value: float
    frozen: Callable[[Signals], float]


#: Standard errors by which the cautious truth has less of its effect, and the most that it loses.
_CAUTION, _LOSS = 1.0, 0.75
#: How far other parameters may move with it, in natural logarithms.
_FARTHEST = 1.0
#: Tolerance of trajectories: far below what a step of the gradient changes.
RTOL = 1e-6
_OFFSET = 1e-6
_NOTHING = Channel("", "", (), offset=False)


@dataclass(frozen=True)
class SensorNoise:
    """Noise of a sensor: its `rms`, a stack's in m, and the `correlation` of neighbours."""

    rms: float
    correlation: float = 0.0

    def on_grid(self, limits: Limits, samples: int) -> Colour:
        """Return the noise on a grid of fewer samples with the same information on slow signals.

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
    the rival is taken for where it is the truth. A new record shows the `outputs`, those of `zeros`
    with an offset; it starts as an ordinary one, or at the declared states, and `hold` is the
    course of its inputs between samples.
    """

    name: str
    model: Model
    unknowns: Unknowns
    theta: FloatArray
    known: FloatArray
    evidence: float = 0.0
    less: FloatArray | None = None
    outputs: tuple[str, ...] = (OUTPUT,)
    zeros: tuple[str, ...] = (OUTPUT,)
    known_start: bool = False
    hold: Hold = "linear"

    @property
    def truth(self) -> FloatArray:
        """Return the coordinates (size,) at which it is the truth that a record shall show."""
        truth = np.zeros(self.size)
        if self.less is not None:
            truth[: len(self.theta)] = self.less
        return np.clip(truth, *self.bounds())

    @cached_property
    def starts(self) -> Mapping[str, tuple[float, float]]:
        """Size and prior width of every initial state that a new record leaves open."""
        if is_stack(self.model):
            return memory_starts(self.model)
        planned: Any = Signals(name="planned", time=np.arange(8.0), columns={})
        new = replace(whole(planned), known_start=self.known_start, channels=(_NOTHING,))
        unknowns = unknowns_around(self.model, (), [new], [1.0], placed=self.model)
        rows = zip(unknowns.started[0], unknowns.start_scale[0], unknowns.prior, strict=False)
        return {name: (float(size), float(prior)) for name, size, prior in rows}

    @cached_property
    def _offsets(self) -> FloatArray:
        """Return what the coordinates of the offsets add to the outputs, (outputs, zeros)."""
        sizes = dict(zip(self.model.output_names, self.model.output_nominals(), strict=True))
        values = np.zeros((len(self.outputs), len(self.zeros)))
        for column, name in enumerate(self.zeros):
            size = _OFFSET if is_stack(self.model) else sizes[name]
            values[self.outputs.index(name), column] = size
        return values

    @property
    def size(self) -> int:
        """Number of coordinates for a new record: parameters, initial states, offsets."""
        return len(self.theta) + len(self.starts) + len(self.zeros)

    @property
    def information(self) -> FloatArray:
        """Return what is known of all coordinates, (size, size); nothing of the offsets."""
        count, states = len(self.theta), len(self.starts)
        full = np.zeros((self.size, self.size))
        full[:count, :count] = self.known
        where = np.arange(count, count + states)
        full[where, where] = [1.0 / prior**2 for _, prior in self.starts.values()]
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
        rows = zip(self.starts.items(), delta[count:].tolist(), strict=False)
        start = {name: size * moved for (name, (size, _)), moved in rows}
        return self.model.with_values(values), start

    def predict(self, record: Signals, delta: FloatArray) -> FloatArray:
        """Return the outputs (n, m) that the rival predicts at delta."""
        return self._traced(record, delta, ()).y

    def sensitivities(self, record: Signals, delta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (n, m) and their exact derivatives by delta (n, m, size)."""
        traced, count = self._traced(record, delta, self.unknowns.names), len(self.theta)
        slopes = self.unknowns.slopes(self.theta + delta[:count])
        by_parameter = traced.sensitivity[:, :, :count] @ slopes
        by_start = traced.sensitivity[:, :, count:] * [size for size, _ in self.starts.values()]
        offsets = np.broadcast_to(self._offsets, (record.n, *self._offsets.shape))
        return traced.y, np.concatenate([by_parameter, by_start, offsets], axis=2)

    def _traced(self, record: Signals, delta: FloatArray, wanted: Sequence[str]) -> Traced:
        """Return outputs with their offsets, and derivatives by `wanted` and the starts."""
        model, start = self.moved(delta)
        planned: Any = record if self.hold == record.hold else replace(record, hold=self.hold)
        traced = trace_record(
            model, planned, start, wanted, stop=record.n, way=Way(RTOL, RTOL), outputs=self.outputs
        )
        return replace(traced, y=traced.y + self._offsets @ delta[self.size - len(self.zeros) :])


def whitened(noise: Sequence[Colour], values: FloatArray) -> FloatArray:
    """Return outputs (n, m), or their derivatives (n, m, k), over their noise: (m n,), (m n, k)."""
    parts = [item.whiten(values[:, j]) / item.level for j, item in enumerate(noise)]
    return np.concatenate(parts)


def rival_of_fit(
    name: str, fit: Fit, noise: Sequence[Colour], evidence: float = 0.0, **words: Any
) -> Rival:
    """Return a fitted model as a rival; what it was fitted to is what is known of it.

    `noise` is that of the fit's samples, of every channel without factors; `words` are other fields
    of a rival.
    """
    count, full = len(fit.unknowns.names), np.diag(1.0 / fit.unknowns.prior**2)
    channels = [c for c in fit.channels if not c.channel.factors]
    for channel, colour in zip(channels, noise, strict=True):
        white = colour.whiten(channel.jacobian) / colour.level
        full = full + white.T @ white
    inner, cross = full[count:, count:], full[:count, count:]
    known = full[:count, :count] - cross @ np.linalg.pinv(inner, hermitian=True) @ cross.T
    less = _less(name, fit, known)
    theta = fit.theta[:count].copy()
    return Rival(name, fit.model, fit.unknowns, theta, known, evidence, less, **words)


def _less(name: str, fit: Fit, known: FloatArray) -> FloatArray:
    """Return the way (k,) to the likeliest values with a standard error less of an effect's gain.

    If a record hardly determines the strength of an effect, its fit may be far too strong, and a
    record that separates it from a rival may not separate the true effect. theta moves by C_g /
    C_gg of the gain's.
    """
    gain = next((c.gain for c in fit.model.components if c.name == name), None)
    names = fit.unknowns.names
    if gain is None or gain not in names:
        return np.zeros(len(names))
    k = names.index(gain)
    covariance = np.linalg.pinv(known, hermitian=True)[:, k]
    size = fit.model.values[gain] / fit.unknowns.scale[k]
    shift = min(_CAUTION * float(np.sqrt(max(covariance[k], 0.0))), _LOSS * abs(size))
    less: FloatArray = -float(np.sign(size)) * shift * covariance / max(covariance[k], 1e-300)
    farthest = float(np.max(np.abs(less[fit.unknowns.log[: len(less)]]), initial=0.0))
    return less * min(1.0, _FARTHEST / max(farthest, 1e-300))


def rival_of_model(name: str, model: Model, free: Sequence[str], **words: Any) -> Rival:
    """Return a model of which only the order of magnitude of its free parameters is known.

    `words` are other fields of a rival.
    """
    if is_stack(model):
        unknowns = unknowns_of(model, free, [], [], _OFFSET)
    else:
        unknowns = coordinates_of(model, free, [], 0.0, 1.0)
    theta = unknowns.coordinates(model.values)
    known = np.diag(1.0 / unknowns.prior[: len(theta)] ** 2)
    return Rival(name, model, unknowns, theta, known, **words)


def noise_of_fit(fit: Fit) -> tuple[tuple[SensorNoise, ...], tuple[Colour, ...]]:
    """Return the noise that a fit leaves in every channel without factors: rms and correlation.

    And as the colour of the channel's samples.
    """
    channels = [c for c in fit.channels if not c.channel.factors]
    colours = tuple(colour_of(c.residuals, c.lengths) for c in channels)
    noise = []
    for channel, colour in zip(channels, colours, strict=True):
        first = colour.autoregression[0]
        noise.append(SensorNoise(channel.rms, float(first[0]) if first.size else 0.0))
    return tuple(noise), colours


#: Evaluations of a re-fit at most, while voltages are compared and in the end; when it has settled.
#: A re-fit that is cut off too soon shows a distance that is not there, which a search would find.
QUICK, FINAL, _SETTLED = 30, 40, 1e-4
#: Distances below this are none.
LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class _Refit:
    """Rival b fitted again to a: the distance T, where b ended, and the whitened difference."""

    distance: float
    delta: FloatArray
    difference: FloatArray


@dataclass(frozen=True, eq=False)
class Separation:
    """The criterion for rivals under the noise of every output on the record's grid.

    A re-fit ends after `evaluations` while inputs are compared. `base` is the model without any of
    the rivals.
    """

    rivals: tuple[Rival, ...]
    noise: Sequence[Colour]
    base: Rival | None = None
    evaluations: int = QUICK

    def __post_init__(self) -> None:
        if len(self.rivals) < 2:
            raise InputError("One effect cannot be separated from itself; name two or more.")

    def at(self, record: Signals) -> Point:
        """Return the value and a function of the inputs with its gradient."""
        refits = self._refits(record, self.evaluations)
        inverse = {pair: 1.0 / max(r.distance, LEAST) for pair, r in refits.items()}
        total = sum(inverse.values())
        value = overall([r.distance for r in refits.values()])

        def frozen(other: Signals) -> float:
            plain = [r.predict(other, r.truth) for r in self.rivals]
            moved = 0.0
            for (a, b), r in refits.items():
                gap = plain[a] - self.rivals[b].predict(other, r.delta)
                slope = 2.0 * r.difference @ whitened(self.noise, gap)
                moved += inverse[a, b] ** 2 / total * float(slope)
            return moved

        return Point(value, frozen)

    def distances(self, record: Signals) -> Mapping[tuple[str, str], float]:
        """Return T of every true rival and other one, by their names, fitted to the end."""
        names = [r.name for r in self.rivals]
        refits = self._refits(record, FINAL)
        return {(names[a], names[b]): r.distance for (a, b), r in refits.items()}

    def distance(self, truth: Rival, other: Rival, record: Signals) -> float:
        """Return T of one pair, fitted to the end."""
        target = truth.predict(record, truth.truth)
        return self._refit(target, other, record, FINAL).distance

    def _refits(self, record: Signals, steps: int) -> dict[tuple[int, int], _Refit]:
        plain = side_by_side(lambda r: r.predict(record, r.truth), self.rivals)
        pairs = list(permutations(range(len(self.rivals)), 2))

        def refit(pair: tuple[int, int]) -> _Refit:
            return self._refit(plain[pair[0]], self.rivals[pair[1]], record, steps)

        return dict(zip(pairs, side_by_side(refit, pairs), strict=True))

    def _refit(self, target: FloatArray, rival: Rival, record: Signals, evaluations: int) -> _Refit:
        """Fit a rival again to a target (n, m), held by what is known of it."""
        values, vectors = np.linalg.eigh(rival.information)
        root = np.sqrt(np.clip(values, 0.0, None))[:, None] * vectors.T  # R^T R = information

        def evaluate(delta: FloatArray) -> tuple[FloatArray, FloatArray] | None:
            try:
                y, jacobian = rival.sensitivities(record, delta)
            except PsaError:
                return None
            residual = np.concatenate([whitened(self.noise, y - target), root @ delta])
            return residual, np.vstack([whitened(self.noise, jacobian), root])

        start, bounds = np.zeros(rival.size), rival.bounds()
        minimum = minimise(evaluate, start, bounds, tolerance=_SETTLED, evaluations=evaluations)
        if minimum is None:
            raise SimulationError(
                f"The model with {rival.name} cannot follow a planned input; its values are far"
                " from physical ones."
            )
        return _Refit(minimum.cost, minimum.theta, -minimum.residual[: target.size])


def overall(distances: Collection[float]) -> float:
    """Return the logarithm of the harmonic mean of distances: the least one counts most."""
    return float(np.log(len(distances) / sum(1.0 / max(t, LEAST) for t in distances)))


Optimality = Literal["D", "E", "A"]
OPTIMALITIES: tuple[Optimality, ...] = get_args(Optimality)


@dataclass(frozen=True, eq=False)
class Information:
    """The criterion for the parameters `names` of a model under its outputs' noise."""

    rival: Rival
    names: tuple[str, ...]
    optimality: Optimality
    noise: Sequence[Colour]

    def __post_init__(self) -> None:
        unknown = [n for n in self.names if n not in self.rival.unknowns.names]
        if unknown or not self.names:
            free = ", ".join(self.rival.unknowns.names)
            raise InputError(
                f"The parameters {', '.join(unknown) or '(none)'} are not among the model's free"
                f" ones; choose from {free}."
            )
        if self.optimality not in OPTIMALITIES:
            raise InputError(f"There is no optimality '{self.optimality}'; there are D, E and A.")

    @property
    def _chosen(self) -> list[int]:
        return [self.rival.unknowns.names.index(n) for n in self.names]

    def _white(self, record: Signals) -> FloatArray:
        _, jacobian = self.rival.sensitivities(record, np.zeros(self.rival.size))
        return whitened(self.noise, jacobian)

    def covariance(self, record: Signals | None) -> FloatArray:
        """Return C of the chosen coordinates (k, k), with a record or with the data at hand."""
        information = self.rival.information
        if record is not None:
            white = self._white(record)
            information = information + white.T @ white
        return _inverse(information)[np.ix_(self._chosen, self._chosen)]

    def at(self, record: Signals) -> Point:
        """Return the value and a function of the inputs with its gradient."""
        chosen, white = self._chosen, self._white(record)
        inverse = _inverse(self.rival.information + white.T @ white)
        value, slope = _value(inverse[np.ix_(chosen, chosen)], self.optimality)
        sides = inverse[:, chosen]
        weights = 2.0 * white @ (sides @ slope @ sides.T)
        return Point(value, lambda other: float(np.sum(weights * self._white(other))))

    def standard_errors(self, record: Signals | None) -> Mapping[str, float]:
        """Return the standard error of every chosen parameter, in the parameter's unit."""
        slopes = np.abs(np.diag(self.rival.unknowns.slopes(self.rival.theta)))
        errors = np.sqrt(np.diag(self.covariance(record))) * slopes[self._chosen]
        return dict(zip(self.names, errors.tolist(), strict=True))


#: What is maximised: `at` returns value and frozen function at a planned record.
Criterion = Separation | Information


def _value(c: FloatArray, optimality: Optimality) -> tuple[float, FloatArray]:
    """Return minus the log of the mean standard error, and -d value / d C."""
    count = len(c)
    if optimality == "D":
        return -0.5 * float(np.linalg.slogdet(c)[1]) / count, 0.5 * np.linalg.inv(c) / count
    if optimality == "A":
        trace = float(np.trace(c))
        return -0.5 * float(np.log(trace / count)), 0.5 * np.eye(count) / trace
    values, vectors = np.linalg.eigh(c)
    worst = vectors[:, -1:]
    slope: FloatArray = 0.5 * worst @ worst.T / values[-1]
    return -0.5 * float(np.log(values[-1])), slope


def _inverse(matrix: FloatArray) -> FloatArray:
    """Invert an information matrix, scaled to a unit diagonal first; unknown offsets are wide."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    scaled = matrix * scale[:, None] * scale[None, :] + 1e-12 * np.eye(len(matrix))
    return np.asarray(np.linalg.inv(scaled) * scale[:, None] * scale[None, :])
