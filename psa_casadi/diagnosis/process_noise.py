"""Noise that enters a model before its outputs: at an input, or as a load in the rate of a state.

Linear about the model's course, with the noise w of one place and white noise v of the sensor:

    x_(k+1) = Phi_k x_k + G_k w_k + H_k w_(k+1),  w_(k+1) = phi w_k + n_k,  e_k = C_k x_k + v_k

A Kalman filter turns the residual e of an output into innovations, which are white if that is what
happened; their likelihood is that of the prediction-error form (Ljung, System Identification, 2nd
ed. 1999, section 7.4; Kristensen, Madsen and Jorgensen, Automatica 40 (2004) 225). phi separates
white noise, noise that is correlated over a time, and a walk.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import BoolArray, FloatArray, IndexArray, rate_unit
from psa_casadi.diagnosis.colour import Colour, Entering, OwnColour, price_of, rms, windows
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.component import Expression
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.tangent import Along, course_of

#: Powers of what noise makes of an output over the sensor's that are tried, and its times of
#: correlation over a record's duration: 0 is white, the last one a walk.
_RATIOS, _TIMES = 10.0 ** np.arange(-1.0, 6.5), np.array([0.0, 0.003, 0.03, 0.3, 30.0])
#: Then factors of both around the best one.
_FINER = 10.0 ** np.array([-0.5, -0.25, 0.0, 0.25, 0.5])
#: Samples that choose, at most, and nats by which noise must be likelier than an autoregression.
_CHOOSING, _LIKELIER = 2000, 8.0
#: Price of a place, a ratio and a time.
_ORDER = 3


@dataclass(frozen=True, eq=False)
class _Linear:
    """A model about its course in one record, in steps of some duration [s].

    `phi` (n - 1, nx, nx), `before` and `after` (n - 1, places, nx): what w at both ends of a step
    adds to the state; `c` (n, nx); `rows` (n, 1 + k) to filter: the residual and its derivatives by
    the parameters.
    """

    step: float
    phi: FloatArray
    before: FloatArray
    after: FloatArray
    c: FloatArray
    rows: FloatArray


@dataclass(frozen=True, eq=False)
class _Noises:
    """Noises (b,) that are tried at once: their place, power and time of correlation [s]."""

    place: IndexArray
    power: FloatArray
    time: FloatArray

    def only(self, k: int) -> "_Noises":
        """Return one of them."""
        return _Noises(self.place[[k]], self.power[[k]], self.time[[k]])

    def neighbours(self, k: int) -> "_Noises":
        """Return those near one of them."""
        power, time = np.meshgrid(self.power[k] * _FINER**2, self.time[k] * _FINER)
        return _Noises(np.full(power.size, self.place[k]), power.ravel(), time.ravel())


def entering(fit: Fit, errors: Sequence[FloatArray], k: int, item: OwnColour) -> OwnColour:
    """Return the noise of channel k with a place where it enters, if that is likelier.

    `errors` (n,) are those of whole records, over the noise's shares; `item` is the colour that
    they have by themselves. It is returned as it is where it is white, where nothing is likelier,
    and where the model has no linear form in CasADi's elementary operations.
    """
    if not item.autoregression.size or fit.model.structure.sampled or fit.model.structure.foreign:
        return item
    number, experiments = fit.channels[k].number, fit.experiments
    used = [e.at(number) for e in experiments]
    columns = fit.channels[k].jacobian[:, : 0 if fit.further else None]
    ends = np.cumsum([np.count_nonzero(rows) for rows in used])[:-1]
    try:
        parts = [
            _linear(fit, e, start, k, _rows(error, at, own_columns))
            for e, start, error, at, own_columns in zip(
                experiments, fit.starts(), errors, used, np.split(columns, ends), strict=True
            )
        ]
    except (PsaError, KeyError, np.linalg.LinAlgError):
        return item
    prior, (at, _, _) = fit.unknowns.prior[: columns.shape[1]], windows(used)
    states = len(fit.model.state_names) - sum(len(c.states) for c in fit.model.effects)
    tried = _tried(parts[0], len(fit.model.input_names) + states)
    few, few_used = _first(parts, used)
    if not tried.place.size or not few:
        return item
    chosen = _found(few, few_used, tried, prior).nats(np.flatnonzero(np.concatenate(few_used)))
    tried = tried.neighbours(int(np.argmax(chosen)))
    result = _found(parts, used, tried, prior)
    best = int(np.argmax(result.nats(at)))
    gained = float(result.nats(at)[best]) - price_of(_ORDER, len(at)) - item.nats()
    if not gained > _LIKELIER:
        return item
    one, level = tried.only(best), rms(result.white[at, best])
    held = [e.at(number, e.held_out) for e in experiments]
    ahead = np.concatenate(
        [_filtered(p, a | b, one)[0][:, 0, 0] for p, a, b in zip(parts, used, held, strict=True)]
    )
    rows = np.concatenate([p.rows[at] for p, at in zip(parts, used, strict=True)])
    return replace(
        item, entering=_told(fit.model, parts, one, level), gained=gained, learnt=ahead[at],
        ahead=ahead[np.concatenate(held)],
        entered=(
            rows[:, 0] - rows[:, 1:] @ result.moves[best],
            _Entered(
                (np.zeros(0),) * len(item.runs), level, item.runs,
                parts=tuple(parts), used=tuple(used), noise=one,
            ),
        ),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class _Entered(Colour):
    """The colour of noise that enters a model, of the fitted samples of all records."""

    parts: tuple[_Linear, ...]
    used: tuple[BoolArray, ...]
    noise: _Noises

    def whiten(self, signal: FloatArray) -> FloatArray:
        """Filter a signal (samples,) or columns (samples, k), every record for itself."""
        columns, first, result = signal.reshape(len(signal), -1), 0, []
        for p, at in zip(self.parts, self.used, strict=True):
            count = int(np.count_nonzero(at))
            rows = np.zeros((len(at), columns.shape[1]))
            rows[at] = columns[first : first + count]
            result.append(_filtered(replace(p, rows=rows), at, self.noise)[0][at, 0])
            first += count
        return np.concatenate(result).reshape(signal.shape)


def _rows(error: FloatArray, used: BoolArray, columns: FloatArray) -> FloatArray:
    """Return the residual and its derivatives (n, 1 + k), 0 where no sample counts."""
    rows = np.zeros((len(error), 1 + columns.shape[1]))
    rows[:, 0] = np.where(np.isfinite(error), error, 0.0)
    rows[used, 1:] = columns
    return rows


def _linear(
    fit: Fit, e: Experiment, start: Mapping[str, float], k: int, rows: FloatArray
) -> _Linear:
    """Return a record's linear form. Raises KeyError where there is none, SimulationError."""
    model, s, channel = fit.model, fit.model.structure, fit.channels[k]
    t, u = e.record.time - e.record.time[0], record_inputs(model, e.record, e.record.n)
    outputs = channel.channel.outputs
    x = course_of(model, t, u, start, way=fit.way, hold=e.record.hold, outputs=outputs).x
    n, nx = x.shape

    def along(of: Expression, by: Expression) -> FloatArray:
        expression = s.jacobian(of, by)
        values = Along(s.arguments, expression)(n, t[None], x.T, u.T, model.parameter_vector())
        return values.reshape(n, expression.shape[1], expression.shape[0]).transpose(0, 2, 1)

    rates = np.broadcast_to(np.eye(nx), (n, nx, nx))
    moved = np.concatenate([along(s.xdot, s.x), along(s.xdot, s.u), rates], axis=2)
    m, held = nx + u.shape[1], u.shape[1] * (e.record.hold == "zero")
    block = np.zeros((n - 1, nx + 2 * m, nx + 2 * m))
    block[:, :nx, : nx + m] = 0.5 * (moved[1:] + moved[:-1]) * np.diff(t)[:, None, None]
    block[:, nx : nx + m, nx + m :] = np.eye(m)
    if not np.isfinite(block).all():
        raise KeyError(e.record.name)
    over = scipy.linalg.expm(block)[:, :nx].transpose(0, 2, 1)
    after = over[:, nx + m :].copy()
    after[:, :held] = 0.0
    c = along(s.y, s.x)[:, model.output_names.index(outputs[0])] / e.share(channel.number)
    phi = over[:, :nx].transpose(0, 2, 1)
    step = float(np.median(np.diff(t)))
    return _Linear(step, phi, over[:, nx : nx + m] - after, after, c, rows)


@dataclass(frozen=True, eq=False)
class _Found:
    """Innovations (samples, b), over their standard deviations `spread` (samples, b).

    The parameters have taken their part of them, by `moves` (b, k).
    """

    white: FloatArray
    spread: FloatArray
    moves: FloatArray

    def nats(self, at: IndexArray) -> FloatArray:
        """Return ln of the likelihood of the samples `at`, up to a constant (b,)."""
        level = np.sqrt(np.mean(self.white[at] ** 2, axis=0))
        lost = np.sum(np.log(self.spread[at]), axis=0)
        nats: FloatArray = -len(at) * np.log(np.maximum(level, 1e-300)) - lost
        return np.where(np.isfinite(nats), nats, -np.inf)


def _found(
    parts: Sequence[_Linear], used: Sequence[BoolArray], noises: _Noises, prior: FloatArray
) -> _Found:
    """Filter the used samples of all records; linearly, the parameters follow the noise."""
    filtered = [_filtered(p, at, noises) for p, at in zip(parts, used, strict=True)]
    rows, spread = (np.concatenate(result) for result in zip(*filtered, strict=True))
    at = np.concatenate(used)
    white, columns = rows[:, :, 0], rows[:, :, 1:]
    known = np.isfinite(prior)
    weight = np.where(known, 1.0 / np.where(known, prior, 1.0) ** 2, 0.0)
    moves = np.zeros((white.shape[1], len(prior)))
    for b in range(len(moves)):
        part = columns[at, b]
        normal = part.T @ part + np.mean(white[at, b] ** 2) * np.diag(weight)
        moves[b] = np.linalg.lstsq(normal, part.T @ white[at, b], rcond=1e-12)[0]
        white[:, b] -= columns[:, b] @ moves[b]
    return _Found(white, spread, moves)


def _filtered(of: _Linear, used: BoolArray, noises: _Noises) -> tuple[FloatArray, FloatArray]:
    """Return innovations (n, b, rows) over their standard deviations (n, b), and these.

    The sensor's noise is 1. Without `used` samples the deviations are those of a simulation.
    """
    (n, nx), size, count = of.c.shape, len(noises.place), of.rows.shape[1]
    with np.errstate(divide="ignore"):
        phi = np.exp(-of.step / noises.time)
    x, p = np.zeros((size, nx + 1, count)), np.zeros((size, nx + 1, nx + 1))
    p[:, nx, nx] = noises.power
    step, new = np.zeros_like(p), np.zeros((size, nx + 1))
    step[:, nx, nx], new[:, nx] = phi, 1.0
    drive = np.sqrt(noises.power * (1.0 - phi**2))[:, None]
    white, spread, c = np.zeros((n, size, count)), np.ones((n, size)), np.zeros(nx + 1)
    for k in range(n):
        c[:nx] = of.c[k]
        gain = p @ c
        variance = gain @ c + 1.0
        spread[k] = np.sqrt(variance)
        if used[k]:
            error = of.rows[k] - np.einsum("i,bij->bj", c, x)
            white[k] = error / spread[k][:, None]
            x += (gain / variance[:, None])[:, :, None] * error[:, None, :]
            p -= gain[:, :, None] * (gain / variance[:, None])[:, None, :]
        if k == n - 1:
            break
        after = of.after[k, noises.place]
        step[:, :nx, :nx] = of.phi[k]
        step[:, :nx, nx] = of.before[k, noises.place] + phi[:, None] * after
        new[:, :nx] = after
        x, p = step @ x, step @ p @ step.transpose(0, 2, 1)
        p += (drive * new)[:, :, None] * (drive * new)[:, None, :]
    return white, spread


def _first(
    parts: Sequence[_Linear], used: Sequence[BoolArray]
) -> tuple[list[_Linear], list[BoolArray]]:
    """Return the first samples of records, as many as choose."""
    left, few, few_used = _CHOOSING, [], []
    for p, at in zip(parts, used, strict=True):
        n = min(len(at), left)
        if n < 2 or not at[:n].any():
            continue
        few.append(replace(
            p, phi=p.phi[: n - 1], before=p.before[: n - 1], after=p.after[: n - 1],
            c=p.c[:n], rows=p.rows[:n],
        ))  # fmt: skip
        few_used.append(at[:n])
        left -= n
    return few, few_used


def _tried(of: _Linear, count: int) -> _Noises:
    """Return noises of the first places, and of all powers and times.

    A power is set by the effect on the output.
    """
    places, time = np.arange(count), _TIMES * of.step * len(of.c)
    grid = _Noises(
        np.repeat(places, len(time)), np.ones(places.size * time.size), np.tile(time, len(places))
    )
    _, size = _filtered(of, np.zeros(len(of.c), dtype=np.bool_), grid)
    power = np.nan_to_num(np.mean(size**2 - 1.0, axis=0), posinf=0.0)
    there = power > 1e-12 * np.max(power)
    return _Noises(
        np.repeat(grid.place[there], len(_RATIOS)), (_RATIOS / power[there, None]).ravel(),
        np.repeat(grid.time[there], len(_RATIOS)),
    )  # fmt: skip


def _told(model: Model, parts: Sequence[_Linear], one: _Noises, level: float) -> Entering:
    """Return where noise enters, in words' figures; its power is over that of the sensor."""
    first, inputs = parts[0], model.structure.inputs
    place, time = int(one.place[0]), float(one.time[0])
    rms = level * float(np.sqrt(one.power[0]))
    lasts = first.step * len(first.c)
    if time > lasts:
        rms, time = rms * float(np.sqrt(2.0 * lasts / time)), np.inf
    if place < len(inputs):
        return Entering(inputs[place].name, False, inputs[place].unit, rms, time)
    state = model.structure.states[place - len(inputs)]
    return Entering(state.name, True, rate_unit(state.unit), rms, time)
