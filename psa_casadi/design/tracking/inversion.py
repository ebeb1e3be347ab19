"""The fast way to a voltage for a path: hysteresis inverse and zero-phase inverse, then trials.

The linear part is inverted without phase (`linear_part.zero_phase_inverse`), which gives the
voltage v_e that a stack without hysteresis would need. Behind the drive it is u_e, and the exact
inverse of the Bouc-Wen element along the path finds u with u + f_H(u)/k_L = u_e:

    k_L u_e' = k_L u' + A u' - (beta s sgn(f_H) + gamma) u' (|f_H|/h_ref)^n + delta u s,
    s = sgn(u') = sgn(u_e'),   v = (u + R_s C_p u') / G

What neither inverse knows (creep's past, further effects) shows in a run of the full simulator; its
error goes back through the same inverse, so long as it falls. Limits, where there are any, cut the
voltage of every trial; the error of samples that stand at a limit does not go back.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.units import FloatArray
from psa_casadi.design.tracking.targets import (
    AmplifierLimits,
    Response,
    Target,
    TrackingError,
    behind_drive,
    demand_stack,
    error_of,
    held,
    respond,
    rest_at,
)
from psa_casadi.model.compose import Model
from psa_casadi.records import Record
from psa_casadi.simulation.start import LinearPart, linear_part

#: Response over that at rest, below which the inverse rolls off.
ROLL_OFF = 0.03


def zero_phase_inverse(part: LinearPart, wanted: FloatArray, step: float) -> FloatArray:
    """Return the voltage (n,) for a displacement (n,) sampled every `step` [s].

    V(w) = D(w) H*(w) / (|H(w)|^2 + (ROLL_OFF |H(0)|)^2), H the linear part's response times
    sinc^2(w step / 2) of the line between samples: the exact inverse where the stack responds,
    rolling off without phase where it does not. The path is taken as settled before its first
    sample, and comes back to it behind the last one.
    """
    n = len(wanted)
    # samples in which all but slow creep settles, at most as many as the path has
    decay = -np.linalg.eigvals(part.a).real
    slowest = 1.0 / np.min(decay) if np.all(decay > 0) else 0.0
    pad = int(np.clip(10.0 * slowest / step, 50, max(n, 50)))
    back = 0.5 * (1.0 + np.cos(np.pi * np.arange(1, pad + 1) / (pad + 1)))
    tail = wanted[0] + (wanted[-1] - wanted[0]) * back
    path = np.concatenate([np.full(pad, wanted[0]), wanted, np.full(pad, wanted[-1]), tail])
    omega: FloatArray = np.asarray(2.0 * np.pi * np.fft.rfftfreq(len(path), step), dtype=float)
    response = part.response(omega) * np.sinc(omega * step / (2.0 * np.pi)) ** 2
    floor = (ROLL_OFF * abs(part.response(np.zeros(1))[0])) ** 2
    inverse = response.conj() / (np.abs(response) ** 2 + floor)
    inverse[0] = 1.0 / response[0].real
    voltage = np.fft.irfft(np.fft.rfft(path) * inverse, len(path))
    return np.asarray(voltage[pad : pad + n])


_PARTS = 4  # sub-intervals of a sample for the hysteresis inverse
_LEAST_SLOPE = 0.05  # of k_L; a stack whose force falls with rising voltage has no inverse
_PROGRESS = 0.8  # a trial that leaves more of the error than this is the last
_MOST_STROKES = 5.0  # range of a path over the stroke, above which its unit is wrong
_MOST_SAMPLES = 4  # uniform samples for each sample of a path that is not uniform


@dataclass(frozen=True, eq=False)
class InvertedInput:
    """A voltage [V] from inversion, the simulator's response, its error, and the trials made."""

    target: Target
    response: Response
    error: TrackingError
    trials: tuple[TrackingError, ...]


def invert(
    model: Model, target: Target, limits: AmplifierLimits | None = None, *, trials: int = 8
) -> InvertedInput:
    """Return the voltage for a path, and the error that the full simulator states.

    `trials` bounds the runs of the simulator whose error is fed back. The path is sampled evenly
    inside; the voltage is returned at the path's instants. It keeps within `limits` (a current to
    about 1 %).

    Raises InputError for a model that is no stack, for a path that it cannot hold at its start, and
    for one that is many times the stroke.
    """
    demand_stack(model)
    part, even = linear_part(model), _evenly(target)
    rated = model.values.get("u_rated", np.inf)
    stroke = rated * float(abs(part.response(np.zeros(1))[0]))
    if target.span > _MOST_STROKES * stroke:
        raise InputError(
            f"The path's range is {1e6 * target.span:.4g} um, the stack's stroke at its rated"
            f" {rated:.4g} V about {1e6 * stroke:.3g} um; the path is likely in another unit:"
            " correct it."
        )
    bounds = limits or AmplifierLimits()
    rest, _ = rest_at(model, float(target.displacement[0]))
    made: list[_Trial] = []

    def learn(wanted: FloatArray, limits: AmplifierLimits) -> _Trial:
        """Return the best of the trials from a first one on, as long as the error falls."""
        first, felt = len(made), list[float]()
        for _ in range(max(trials, 1)):
            free = _voltage(model, even, wanted, rest)
            voltage = held(model, limits, even.time, free)
            displacement = respond(model, even.time, voltage).displacement
            made.append(_Trial(wanted, voltage, error_of(even, displacement)))
            left = np.where(voltage == free, even.displacement - displacement, 0.0)
            felt.append(float(np.linalg.norm(left)))
            if len(felt) > 1 and felt[-1] > _PROGRESS * felt[-2]:
                break
            wanted = wanted + zero_phase_inverse(part, left, even.step)
        return min(made[first:], key=lambda t: t.error.rms)

    best = learn(zero_phase_inverse(part, even.displacement, even.step), AmplifierLimits())
    if bounds != AmplifierLimits():
        best = learn(best.wanted, bounds)
    final = respond(model, target.time, np.interp(target.time, even.time, best.voltage))
    error = error_of(target, final.displacement)
    return InvertedInput(target, final, error, tuple(t.error for t in made))


@dataclass(frozen=True, eq=False)
class _Trial:
    """What was wanted of the linear part [V], the voltage played [V], and the error it left."""

    wanted: FloatArray
    voltage: FloatArray
    error: TrackingError


def correct(model: Model, target: Target, voltage: FloatArray, measured: FloatArray) -> FloatArray:
    """Return the voltage (n,) corrected by what a trial on the real stack showed.

    `measured` (n,) [m] is the displacement that `voltage` (n,) [V] gave at the path's instants,
    which must be uniform. The voltage is scaled by g, the path's range over the measured one, which
    takes out every error of the gain; what is left goes through the model's linear inverse:

        v -> v_0 + g (v - v_0) + s H^-1 (path - d_0 - g (measured - d_0)),

    s the mean slope of the linear part over that of the trial. An error of the other parameters
    counts only by its product with the error that is left.
    """
    part = linear_part(model)
    gain = float(np.ptp(target.displacement) / np.ptp(measured))
    rest = float(measured[0])
    expected = float(np.ptp(voltage) * abs(part.response(np.zeros(1))[0]))
    left = target.displacement - rest - gain * (measured - rest)
    change = zero_phase_inverse(part, left, target.step) * gain * expected / target.span
    corrected = voltage[0] + gain * (voltage - voltage[0]) + change
    corrected[:2] = voltage[0]
    return np.asarray(corrected)


def _evenly(target: Target) -> Target:
    steps = np.diff(target.time)
    if np.ptp(steps) < 1e-6 * target.step:
        return target
    n = len(target.time)
    wanted = int(np.ceil((target.time[-1] - target.time[0]) / np.min(steps))) + 1
    time = np.linspace(target.time[0], target.time[-1], min(wanted, _MOST_SAMPLES * n))
    return Target(time, np.interp(time, target.time, target.displacement))


def _voltage(model: Model, even: Target, wanted: FloatArray, rest: float) -> FloatArray:
    """Return the voltage (n,) that `wanted` becomes with hysteresis; at rest for one sample.

    Drive, exact inverse of the Bouc-Wen element, drive back.
    """
    p, voltage = model.values, np.array(wanted)
    if "h_ref" in p:
        constant, dt, n = p["R_s"] * p["C_p"], even.step / _PARTS, len(wanted)
        fine = np.interp(np.arange((n - 1) * _PARTS + 1) / _PARTS, np.arange(n), wanted)
        behind = behind_drive(model, dt, p["G"] * fine, p["G"] * fine[0])
        march = _march(model).mapaccum("march", len(fine) - 1)
        u = np.array(march(ca.DM([behind[0], 0.0]), np.diff(behind)[None, :], dt)).T
        u = np.concatenate([[behind[0]], u[:, 0]])
        rate = np.diff(u) / dt
        ends = np.concatenate([rate[:1], rate, rate[-1:]])
        voltage = ((u + constant * 0.5 * (ends[:-1] + ends[1:])) / p["G"])[::_PARTS].copy()
    voltage[:2] = rest
    return np.asarray(voltage)


def _march(model: Model) -> ca.Function:
    """Return ((u, f_H), du_e, dt) -> (u, f_H) after a step, by the midpoint rule."""
    p = model.values
    state, change, dt = ca.SX.sym("s", 2), ca.SX.sym("du_e"), ca.SX.sym("dt")
    rate = change / dt
    sign = rate / ca.sqrt(rate**2 + p["hold_rate"] ** 2)

    def increments(u: ca.SX, force: ca.SX) -> tuple[ca.SX, ca.SX]:
        power = ca.fabs(force / p["h_ref"]) ** p["n"]
        slope = p["k_L"] + p["A"] - (p["beta"] * sign * ca.sign(force) + p["gamma"]) * power
        slope = ca.fmax(slope, _LEAST_SLOPE * p["k_L"])
        du = (p["k_L"] * change - p["delta"] * u * sign * dt) / slope
        return du, p["k_L"] * (change - du)

    du, df = increments(state[0], state[1])
    du, df = increments(state[0] + 0.5 * du, state[1] + 0.5 * df)
    return ca.Function("step", [state, change, dt], [state + ca.vertcat(du, df)])


#: Steps of a path that differ by more than this share of their median are not uniform.
_UNIFORM = 1e-3
#: Share of a step by which a trial may end before the path does.
_SHORT = 1.5
#: Least range of the measured displacement, over that of the path.
_MOVED = 0.05


@dataclass(frozen=True, eq=False)
class CorrectedInput:
    """A corrected voltage, and the trial it comes from.

    `played` (n,) [V] and `measured` (n,) [m] are the trial at the path's instants, `error` is the
    trial's; `response` is the model's to the corrected voltage, which knows nothing of the trial.
    """

    target: Target
    limits: AmplifierLimits
    played: FloatArray
    measured: FloatArray
    error: TrackingError
    response: Response


def corrected(
    model: Model, target: Target, record: Record, limits: AmplifierLimits | None = None
) -> CorrectedInput:
    """Return the voltage for a path, corrected by a record of an earlier voltage for it.

    The record's first sample counts as the path's; see `inversion.correct` for what is done. The
    voltage is cut by the limits.

    Raises InputError for a model that is no stack, a path whose instants are not uniform, a record
    that is too short for the path, has gaps or no scale, or shows no motion to speak of.
    """
    demand_stack(model)
    _check(target, record)
    time = record.time - record.time[0]
    played = np.interp(target.time, time, record.voltage)
    measured = np.interp(target.time, time, np.asarray(record.displacement, dtype=float))
    bounds = limits or AmplifierLimits()
    voltage = held(model, bounds, target.time, correct(model, target, played, measured))
    error = error_of(target, measured)
    response = respond(model, target.time, voltage)
    return CorrectedInput(target, bounds, played, measured, error, response)


def _check(target: Target, record: Record) -> None:
    problems, name = Problems(), record.source or record.name
    if np.ptp(np.diff(target.time)) > _UNIFORM * target.step:
        problems.add(
            "The path's instants are not uniform; resample it evenly, design the voltage for that,"
            " and measure the trial again."
        )
    if record.time[-1] - record.time[0] < target.time[-1] - _SHORT * target.step:
        problems.add(
            f"{name}: lasts {record.time[-1] - record.time[0]:.4g} s, the path"
            f" {target.time[-1]:.4g} s; record the whole path, from its first sample on."
        )
    displacement = record.displacement
    if (
        displacement is None
        or record.displacement_unit != "m"
        or not np.isfinite(displacement).all()
    ):
        problems.add(
            f"{name}: a trial needs a displacement in a unit of length at every sample; fill"
            " the gaps, or convert counts by the sensor's scale."
        )
    elif np.ptp(displacement) < _MOVED * target.span:
        problems.add(
            f"{name}: the stack moved by {1e6 * np.ptp(displacement):.3g} um, the path moves by"
            f" {1e6 * target.span:.3g} um; this is no trial of it, or in another unit."
        )
    problems.raise_if_any()
