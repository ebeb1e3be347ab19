"""Unnamed corrections of a model: their forms, and what each would remove.

About the fitted model everything is linear: measured - predicted = J d + C w + noise, d the change
of the model's parameters, w ~ N(0, (s p)^2) the weights of one correction. The size s is that
of the largest evidence. The evidence is on the scale of the hypotheses' score.

A correction is a sum of columns with weights w_k ~ N(0, (s p_k)^2): s its size, estimated from the
data, p_k the shape of the prior, smooth where 1/k or steeper. Quantities are over their range:

    curve         cos(k pi q)                       p_k = 1/k            of voltage or displacement
    direction     d cos(k pi q), k from 0           p_k = 1/(1 + k)      d a narrow stop, -1 to 1
    memory        stops E_r, plays^2, plays^3       p_k = 1              of the voltage
    relaxation    z_tau - x, tau z' + z = x         p_k = 1              tau over decades
    modes         resonators driven by the force    p_k = 1              frequencies over decades
    time          cos(k pi t/T)                     p_k = 1/k            of every record
    gain in time  x cos(k pi t/T)                   p_k = 1/k

Stops and plays: Visintin 1994; their squares and cubes make loops that are asymmetric or S-shaped
(generalised Prandtl-Ishlinskii, Al Janaideh, Rakheja and Su 2009).

What data say of a cause first is its family, the place where it sits and what it does. Which effect
of a family it is comes second, and it may be none that is listed: unnamed corrections of other
kinds compete with the listed effects on the scale of evidence.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.held_out import held_out_rms
from psa_casadi.diagnosis.screening import independent, temperature, without
from psa_casadi.diagnosis.task import LIMITS, Thresholds, shows_ringing
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.refitting import POLISH
from psa_casadi.identification.start.linear_response import plays
from psa_casadi.model.component import Component, Kind
from psa_casadi.model.compose import Model
from psa_casadi.model.effects import patches
from psa_casadi.records.noise import filtered
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.start import linear_part
from psa_casadi.simulation.stepper import SimulationError

#: Relaxations per decade, modes.
_PER_DECADE, MODES = 2, 24
#: Damping ratio of modes; longest time constant of relaxations over the longest record.
_DAMPING, _LONGEST = 0.05, 3.0
#: Fewest periods of a mode in the longest record; lowest frequency of one over the sampling rate.
_PERIODS, _SLOWEST = 8.0, 0.01


@dataclass(frozen=True)
class Signals:
    """What columns are made of: the records, their voltages and predictions [m].

    `respond` filters a signal at the plant's force as the stack does, over its response at rest.
    """

    experiments: Sequence[Experiment]
    predicted: Sequence[FloatArray]
    respond: Callable[[int, FloatArray], FloatArray]

    def voltage(self, k: int) -> FloatArray:
        """Voltage of a record over the range of all, 0 to 1."""
        every = [e.record.voltage for e in self.experiments]
        return _over_range(self.experiments[k].record.voltage, every)

    def displacement(self, k: int) -> FloatArray:
        """Predicted displacement of a record over the range of all, 0 to 1."""
        return _over_range(self.predicted[k], self.predicted)


@dataclass(frozen=True)
class Form:
    """One form at one port: its name, its columns of a record (n, k) and the prior's shape (k,)."""

    name: str
    port: str
    columns: Callable[[Signals, int], FloatArray]
    shape: Callable[[int], FloatArray]
    fast: bool = False


def _over_range(values: FloatArray, every: Sequence[FloatArray]) -> FloatArray:
    low, high = min(float(np.min(v)) for v in every), max(float(np.max(v)) for v in every)
    return (values - low) / max(high - low, 1e-300)


def _cosines(q: FloatArray, first: int, count: int) -> FloatArray:
    return np.cos(np.pi * np.outer(q, np.arange(first, first + count)))


def _direction(s: Signals, k: int) -> FloatArray:
    q = s.voltage(k)
    side = (q[:, None] - plays(q, [patches.NARROW])) / patches.NARROW
    return s.respond(k, side * _cosines(q, 0, patches.BRANCH))


def _memory(s: Signals, k: int) -> FloatArray:
    q = s.voltage(k)
    radii = np.array([patches.radius(k) for k in range(patches.ELEMENTS)])
    followed = plays(q, radii)
    return s.respond(k, np.hstack([q[:, None] - followed, followed**2, followed**3]))


def _relaxation(s: Signals, k: int) -> FloatArray:
    record = s.experiments[k].record
    x = s.displacement(k)
    taus = time_constants([e.record for e in s.experiments])
    step = np.append(0.0, np.diff(record.time))
    return np.column_stack([_relaxed(x, step, float(tau)) - x for tau in taus])


def time_constants(records: Sequence[Record]) -> FloatArray:
    """Return the time constants of a relaxation [s], evenly over the decades of the records."""
    shortest = min(r.sample_time for r in records)
    longest = _LONGEST * max(r.duration for r in records)
    count = max(2, round(_PER_DECADE * float(np.log10(longest / shortest))))
    return np.geomspace(shortest, longest, count)


def _modes(s: Signals, k: int) -> FloatArray:
    records = [e.record for e in s.experiments]
    shortest, longest = min(r.sample_time for r in records), max(r.duration for r in records)
    change = np.append(0.0, np.diff(s.displacement(k)))
    columns = []
    lowest = max(_PERIODS / longest, _SLOWEST / shortest)
    for f in np.geomspace(lowest, 0.45 / shortest, MODES):
        turn = 2.0 * np.pi * f * records[k].sample_time
        pole = np.exp(turn * (-_DAMPING + 1j * np.sqrt(1.0 - _DAMPING**2)))
        rings = [1.0, -2.0 * pole.real, abs(pole) ** 2]
        columns += [filtered(before, rings, change) for before in ([1.0, 0.0], [0.0, 1.0])]
    return np.column_stack(columns)


def _time(s: Signals, k: int) -> FloatArray:
    t = s.experiments[k].record.time
    return _cosines((t - t[0]) / (t[-1] - t[0]), 1, patches.BRANCH)


def _relaxed(x: FloatArray, step: FloatArray, tau: float) -> FloatArray:
    """Return z of tau z' + z = x with x linear between samples, z(0) = x(0)."""
    if np.ptp(step[1:]) < 1e-6 * step[-1]:
        a = float(np.exp(-step[-1] / tau))
        b = (1.0 - a) * tau / step[-1]
        even: FloatArray = x[0] + filtered([1.0 - b, b - a], [1.0, -a], x - x[0])
        return even
    z = np.empty_like(x)
    z[0] = x[0]
    for i in range(1, len(x)):
        a = float(np.exp(-step[i] / tau))
        b = (1.0 - a) * tau / max(step[i], 1e-300)
        z[i] = a * z[i - 1] + (b - a) * x[i - 1] + (1.0 - b) * x[i]
    return z


def _smooth(count: int) -> FloatArray:
    return 1.0 / np.arange(1, count + 1)


KINDS = (
    Form("curve", "drive voltage",
         lambda s, k: s.respond(k, _cosines(s.voltage(k), 1, patches.CURVE)), _smooth),
    Form("curve", "reading", lambda s, k: _cosines(s.displacement(k), 1, patches.CURVE), _smooth),
    Form("curve", "force",
         lambda s, k: s.respond(k, _cosines(s.displacement(k), 1, patches.CURVE)), _smooth, True),
    Form("direction", "force", _direction, _smooth),
    Form("memory", "force", _memory, np.ones),
    Form("relaxation", "force", _relaxation, np.ones),
    Form("modes", "force", _modes, np.ones),
    Form("time", "reading", _time, _smooth),
    Form("gain in time", "force",
         lambda s, k: s.displacement(k)[:, None] * _time(s, k), _smooth),
)  # fmt: skip


#: Coordinates this near to a bound stay there.
_AT_BOUND = 1e-6
#: Sizes s that are tried, over the rms of what the correction may explain.
_SIZES = np.geomspace(1e-3, 1e3, 25)


@dataclass(frozen=True)
class Estimate:
    """A parameter of a cause: value and 95 % interval in its unit."""

    value: float
    unit: str
    interval: tuple[float, float]


def estimates(effect: Component, model: Model) -> dict[str, Estimate]:
    """Return the estimates of an effect's parameters from a fitted model's provenance."""
    known = model.provenance.intervals
    return {
        p.name: Estimate(model.values[p.name], p.unit, (known[p.name].low, known[p.name].high))
        for p in effect.parameters
        if p.name in known
    }


@dataclass(frozen=True, eq=False, kw_only=True)
class Correction:
    """An unnamed correction of a model, at a `port`: evidence over it, and what it leaves.

    `predicted` are whole records with the correction, (n,) of one channel or (n, channels), and
    `held` the errors of these channels in held-out samples. Of a reported one, `open_to` are
    others that explain the data as well, and `share` is what it removes of the base's held-out
    error above the noise.
    """

    port: str
    evidence: float
    held: tuple[float, ...]
    predicted: tuple[FloatArray, ...]
    open_to: tuple[str, ...] = ()
    share: float = 0.0

    @property
    def name(self) -> str:
        """What it is, and where."""
        raise NotImplementedError

    @property
    def sentence(self) -> str:
        """What it is in words."""
        return str(self.label)

    @property
    def label(self) -> Note:
        """What it is."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, kw_only=True)
class Patch(Correction):
    """One of a stack: its kind of columns at a port of the plant, and what it adds.

    `weights` [m] are those of the kind's columns, `added` [m] their part of `predicted` [m];
    `moved` is how far the model's theta follows.
    """

    kind: str
    weights: FloatArray
    added: tuple[FloatArray, ...]
    moved: FloatArray

    @property
    def name(self) -> str:
        """Kind and port."""
        return f"{self.kind} at the {self.port}"

    @property
    def label(self) -> Note:
        """What it is."""
        return note("correction", kind=self.kind, port=self.port)

    def to_dict(self) -> dict[str, Any]:
        """Return the content for DIAGNOSIS.json."""
        names = ("kind", "port", "sentence", "evidence")
        return {**{n: getattr(self, n) for n in names}, "open_to": list(self.open_to)}


@dataclass(frozen=True, eq=False, kw_only=True)
class FreeFunction(Correction):
    """One of any model: a function without memory `of` some variables, added to a port's sum.

    Along all records it adds `added` (n,) in the port's `unit`; that follows the `variable`, of
    these the one that explains most of it, with the values `along` (n,). `model` holds it. Where
    few terms of a library predict as well as a polynomial, it is their sum: `equation`, with
    `parameters` in SI units. `fitted` is the `Formula` that it is made of.
    """

    of: str
    unit: str
    variable: str
    variable_unit: str
    along: FloatArray
    added: FloatArray
    model: Model
    fitted: Any = None
    equation: str = ""
    parameters: Mapping[str, Estimate] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What it is a function of, and its port."""
        return f"a free function of {self.of} in {self.port}"

    @property
    def label(self) -> Note:
        """What it is."""
        return note("free", of=self.of, port=self.port, equation=self.equation)

    def to_dict(self) -> dict[str, Any]:
        """Return the content for DIAGNOSIS.json."""
        names = ("port", "of", "evidence", "share", "unit", "variable", "equation")
        table = {n: asdict(e) for n, e in self.parameters.items()}
        return {**{n: getattr(self, n) for n in names}, "parameters": table}


def best_of(
    result: Sequence[Correction],
    experiments: Sequence[Experiment],
    held: Sequence[float],
    colour: Colour,
    limits: Thresholds = LIMITS,
) -> Correction | None:
    """Return the best correction of a model; None if none helps.

    Its evidence must be above the price of a cause, and the log-likelihood of the held-out samples,
    where the model's channels err by `held`, must gain as much as for a cause.
    """
    samples = [sum(int(e.at(j, e.held_out).sum()) for e in experiments) for j in range(len(held))]

    counts = [n / c.inflation for n, c in zip(samples, colour.each, strict=False)]

    def gained(c: Correction) -> float:
        rows = zip(counts, held, c.held, strict=False)
        return sum(n * float(np.log(before / max(after, 1e-300))) for n, before, after in rows)

    likely = [c for c in result if c.evidence > limits.price]
    good = [c for c in likely if not any(samples) or gained(c) > limits.held_out]
    if not good:
        return None
    best = max(good, key=lambda c: c.evidence)
    near = limits.clearly * temperature(best.evidence, limits)
    others = [c for c in good if c is not best and c.evidence > best.evidence - near]
    return replace(best, open_to=tuple(c.name for c in others))


def corrections(fit: Fit, colour: Colour) -> tuple[Patch, ...]:
    """Return all corrections of a fit, the one of the highest evidence first."""
    experiments = fit.experiments
    try:
        full = fit.predictions()
        signals = Signals(experiments, [p.displacement for p in full], responses(fit, experiments))
    except PsaError:
        return ()
    follow = _Following(fit, colour, [p.jacobian for p in full])
    fast = shows_ringing(experiments)
    every = [_correction(kind, signals, follow) for kind in KINDS if fast or not kind.fast]
    return tuple(sorted(every, key=lambda c: -c.evidence))


class _Following:
    """The model's parameters, which follow a correction as far as prior and bounds let them."""

    def __init__(self, fit: Fit, colour: Colour, jacobians: Sequence[FloatArray]) -> None:
        self.colour, self.whole, self.residuals = colour, jacobians, fit.residuals
        low, high = fit.unknowns.bounds()
        self.free = (fit.theta > low + _AT_BOUND) & (fit.theta < high - _AT_BOUND)
        known = np.isfinite(fit.unknowns.prior)
        self.prior = np.where(known, fit.unknowns.prior, 1.0)[self.free]
        self.held = np.diag(known[self.free].astype(np.float64))
        used = np.vstack([j[e.used] for j, e in zip(jacobians, fit.experiments, strict=True)])
        scaled = used[:, self.free] * self.prior
        self.white = np.vstack([self.over_noise(scaled), self.held])
        self.basis = independent(self.white)
        self.target = self.orthogonal(fit.residuals)

    def over_noise(self, columns: FloatArray) -> FloatArray:
        """Return columns at the used samples, whitened, over the noise."""
        return self.colour.whiten(columns) / self.colour.level

    def orthogonal(self, columns: FloatArray) -> FloatArray:
        """Return columns over the noise, whitened, less what the parameters can follow."""
        none = np.zeros((len(self.held), *columns.shape[1:]))
        return without(np.concatenate([self.over_noise(columns), none]), self.basis)

    def moved(self, added: FloatArray) -> FloatArray:
        """Return the change of theta (size,) with what is added at used samples."""
        rest = np.append(self.over_noise(self.residuals - added), np.zeros(len(self.held)))
        theta = np.zeros(len(self.free))
        theta[self.free] = self.prior * np.linalg.lstsq(self.white, rest, rcond=None)[0]
        return theta


def _correction(kind: Form, signals: Signals, follow: _Following) -> Patch:
    experiments = signals.experiments
    parts = [kind.columns(signals, k) for k in range(len(experiments))]
    shape = kind.shape(parts[0].shape[1])
    used = np.vstack([p[e.used] for p, e in zip(parts, experiments, strict=True)]) * shape
    free = follow.orthogonal(used)
    weights, evidence = _weights(free, follow.target)
    added = tuple(p @ (shape * weights) for p in parts)
    moved = follow.moved(used @ weights)
    changes = [j @ moved for j in follow.whole]
    predicted = tuple(y + c + o for y, c, o in zip(signals.predicted, changes, added, strict=True))
    return Patch(
        port=kind.port,
        evidence=evidence,
        held=(held_out_rms(experiments, predicted),),
        predicted=predicted,
        kind=kind.name,
        weights=weights * shape,
        added=added,
        moved=moved,
    )


def _weights(columns: FloatArray, target: FloatArray) -> tuple[FloatArray, float]:
    """Return the posterior mean of w ~ N(0, s^2) and ln of the Bayes factor, s the best one."""
    n = len(target)
    u, singular, vt = np.linalg.svd(columns, full_matrices=False)
    along = u.T @ target
    power = float(target @ target)
    best: tuple[float, FloatArray] = (-np.inf, np.zeros(columns.shape[1]))
    largest = float(np.max(singular, initial=0.0))
    if largest <= 0.0 or power <= 0.0:
        return best[1], 0.0
    for size in _SIZES:
        # the ratio of prior and noise, on the scale of the largest direction
        ratio = (size / largest) ** 2 * n
        shrunk = ratio * singular**2 / (1.0 + ratio * singular**2)
        left = power - float(np.sum(shrunk * along**2))
        spent = 0.5 * float(np.sum(np.log1p(ratio * singular**2)))
        log_ratio = -0.5 * n * np.log(left / power) - spent
        if log_ratio > best[0]:
            with np.errstate(divide="ignore", invalid="ignore"):
                scaled = np.where(singular > 1e-12 * largest, shrunk / singular, 0.0) * along
            best = (log_ratio, vt.T @ scaled)
    return best[1], max(best[0] - float(np.log(len(_SIZES))), 0.0) if best[0] > 0 else best[0]


def responses(
    fit: Fit, experiments: Sequence[Experiment]
) -> Callable[[int, FloatArray], FloatArray]:
    """Return the filter of the plant from force to displacement, for records that show it.

    Effects of the drive come before the force; a high-pass among them has no response at rest.
    """
    if not shows_ringing(experiments):
        return lambda k, x: x
    drive = [e.name for e in fit.model.effects if e.belongs_to == "drive"]
    try:
        part = linear_part(fit.model.without(drive))
        rest = part.response(np.zeros(1))[0]
    except (PsaError, np.linalg.LinAlgError):
        return lambda k, x: x
    if not np.isfinite(rest) or rest == 0.0:
        return lambda k, x: x

    def respond(k: int, columns: FloatArray) -> FloatArray:
        step, n = experiments[k].record.sample_time, len(columns)
        pad = min(n, 4000)
        long = np.concatenate([np.repeat(columns[:1], pad, axis=0), columns,
                               np.repeat(columns[-1:], pad, axis=0)])  # fmt: skip
        omega: FloatArray = np.asarray(2.0 * np.pi * np.fft.rfftfreq(len(long), step), dtype=float)
        response = part.response(omega) / rest
        out = np.fft.irfft(np.fft.rfft(long, axis=0) * response[:, None], len(long), axis=0)
        return np.asarray(out[pad : pad + n])

    return respond


def with_patch(before: Fit, patch: Patch, predicted: Sequence[FloatArray]) -> Fit:
    """Return a fit with the correction added to the model, started from the correction's weights.

    Of two fits, one starts from the model's values as they follow the correction, one from those
    of `before`; the better one is returned.

    `predicted` [m] are the predictions of `before`. Raises InputError for a kind that no component
    represents, SimulationError where it cannot be simulated.
    """
    component = patches.PATCHES.get((patch.kind, patch.port))
    if component is None:
        raise InputError(
            f"The unnamed correction ({patch.name}) has no form that a model could hold; the page"
            " shows it, and a further mode of the table is the nearest that can be fitted."
        )
    numbers = _numbers(before, patch, predicted)
    names = [patches.weight(k + 1) for k in range(len(patch.weights))]
    values = {**numbers, patches.GAIN: 1.0, **dict(zip(names, patch.weights.tolist(), strict=True))}

    def fit_from(theta: FloatArray) -> Fit:
        unknowns = before.unknowns
        return fit(
            before.model.with_effect(component, {**values, **unknowns.values(theta)}),
            before.experiments,
            [*unknowns.names, *names],
            sigma=before.sigma,
            start_states=[unknowns.start(theta, r) for r in range(unknowns.records)],
            evaluations=POLISH,
        )

    fits = []
    for theta in (before.theta + patch.moved, before.theta):
        with suppress(SimulationError):
            fits.append(fit_from(theta))
    if not fits:
        raise SimulationError("The model cannot be simulated with the unnamed correction.")
    return min(fits, key=lambda f: f.cost)


def _numbers(before: Fit, patch: Patch, predicted: Sequence[FloatArray]) -> Mapping[str, float]:
    """Return the parameters that are not fitted: the range, times."""
    records = [e.record for e in before.experiments]
    longest = max(r.duration for r in records)
    if patch.kind in ("direction", "memory") or patch.port == "drive voltage":
        every = np.concatenate([r.voltage for r in records])
    else:
        every = np.concatenate([y - before.offset(k) for k, y in enumerate(predicted)])
    numbers = {"patch_low": float(np.min(every)), "patch_high": float(np.max(every))}
    if patch.kind == "time":
        return {"patch_time": longest}
    if patch.kind == "gain in time":
        return {**numbers, "patch_time": longest}
    if patch.kind == "relaxation":
        taus = time_constants(records)
        if len(taus) > patches.RELAXATIONS:
            raise InputError("The records span more decades of time than a correction can hold.")
        return {**numbers, "patch_time": float(taus[0]), "patch_ratio": float(taus[1] / taus[0])}
    return numbers


#: What a correction of a kind does, where it has another name, and the places of its ports.
_DOES: dict[str, Kind] = {
    "curve": "curve", "direction": "hysteresis", "memory": "hysteresis", "relaxation": "relaxation",
    "modes": "resonance", "time": "time", "gain in time": "changing gain",
}  # fmt: skip
_PLACES = {"drive voltage": "drive", "force": "plant", "reading": "sensor"}
#: The largest probability that is stated.
SUREST = 0.99
#: Families less probable than this are not reported.
_LEAST = 0.01


@dataclass(frozen=True)
class Family:
    """A place (plant, drive, sensor, environment, or a port of any model) and a kind.

    `probability` is that the cause belongs to it; `effects` are those of the listed effects in it,
    `not_listed` that it is none of them.
    """

    place: str
    kind: str
    probability: float
    effects: Mapping[str, float]
    not_listed: float


def place_and_kind(c: Correction) -> tuple[str, str]:
    """Return the family of an unnamed correction; a free function is a curve at its port."""
    if isinstance(c, Patch):
        return _PLACES[c.port], _DOES[c.kind]
    return c.port, "curve"


@dataclass(frozen=True)
class CauseEvidence:
    """What a cause has: its evidence E [nats], from n samples, with k causes in all."""

    evidence: float
    samples: int
    causes: int = 1

    def listed_probability(self, limits: Thresholds) -> float:
        """Return the probability that it is of any kind that was tried.

        The odds of what looks like it, but nobody has thought of or is the form of another cause,
        are `unknown` k (n/E)^(1/2). The smaller it is over the noise, the less of its form shows.
        """
        small = float(np.sqrt(self.samples / max(self.evidence, 1e-300)))
        return 1.0 / (1.0 + limits.unknown * self.causes * small)


def families(
    probability: Mapping[str, float],
    places: Mapping[str, tuple[str, str]],
    cause: CauseEvidence,
    corrections: Sequence[Correction],
    limits: Thresholds,
) -> tuple[Family, ...]:
    """Return the families that a cause may belong to, the most probable first.

    `probability` is that of each effect on condition that the cause is a listed one, `places` has
    their families; `cause` is the evidence of the cause over the model without it, `corrections`
    are those of that model. With the evidence F_k, above the price of a cause, of each correction
    and that E of the cause, the odds that it is not listed are

        sum_k exp((F_k - E*) / T),   T = max(temperature 2, further E)

    over corrections whose kind no likely effect has; E* is E, or F of one of its kind if larger.
    One of its kind has more freedom: it counts where `enough` of its F is more than E.
    Without any effect the corrections share all, with `form_of_unnamed` in that place: a model that
    lacks the cause holds little information on it. One whose kind nobody has declared may be of
    any. What is missing to 1 is of no kind that was tried (`CauseEvidence.listed_probability`).
    """
    evidence = cause.evidence
    form = limits.further if probability else limits.form_of_unnamed
    scale = max(limits.temperature, form * evidence)
    kinds = {places[n][1] for n, p in probability.items() if n in places and p > _LEAST}
    apart = [(place_and_kind(c), c.evidence) for c in corrections if c.evidence > limits.price]
    most = max([evidence, *(e for family, e in apart if family[1] in kinds)])
    others: dict[tuple[str, str], float] = {}
    for family, each in apart:
        if "" not in kinds:
            ahead = limits.enough * each - evidence if family[1] in kinds else each - most
            odds = float(np.exp(min(ahead / scale, 50.0)))
            others[family] = max(others.get(family, 0.0), odds)
    odds_of_all = bool(probability) + sum(others.values())
    listed = cause.listed_probability(limits) / odds_of_all if odds_of_all else 0.0
    table: dict[tuple[str, str], dict[str, float]] = {family: {} for family in others}
    for name, p in probability.items():
        if name in places:
            table.setdefault(places[name], {})[name] = p * listed
    rows = (
        Family(
            *family,
            probability=min(SUREST, sum(effects.values()) + others.get(family, 0.0) * listed),
            effects={n: p for n, p in effects.items() if p > _LEAST},
            not_listed=others.get(family, 0.0) * listed,
        )
        for family, effects in table.items()
    )
    probable = (f for f in rows if f.probability > _LEAST)
    return tuple(sorted(probable, key=lambda f: -f.probability))
