"""Paths, the amplifier's limits, and the full simulator's response to a voltage."""

import os
from dataclasses import dataclass
from math import inf
from pathlib import Path

import casadi as ca
import numpy as np
import scipy

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.common.units import BoolArray, FloatArray, parse_unit, to_si
from psa_casadi.model.compose import Model
from psa_casadi.records.noise import runs_of
from psa_casadi.records.read import apart
from psa_casadi.records.read.choose import Request
from psa_casadi.records.read.columns import ColumnMap, columns_of
from psa_casadi.simulation.simulate import input_samples
from psa_casadi.simulation.start import linear_part, start_state
from psa_casadi.simulation.stepper import run

#: Fewest samples of a path.
_FEWEST = 10


@dataclass(frozen=True, eq=False)
class Target:
    """A path: `displacement` (n,) [m] at strictly increasing times `time` (n,) [s]."""

    time: FloatArray
    displacement: FloatArray

    @property
    def span(self) -> float:
        """Largest minus smallest displacement [m]; the range that errors are a share of."""
        return float(np.ptp(self.displacement))

    @property
    def step(self) -> float:
        """Median distance between samples [s]."""
        return float(np.median(np.diff(self.time)))


def read_target(
    path: str | os.PathLike[str],
    columns: ColumnMap | None = None,
    sample_time: float | None = None,
) -> Target:
    """Read a path from a file with the columns `time [s]` and `displacement [um]`.

    `columns` says which of the file they are, `sample_time` [s] goes before its time.

    Raises InputError with every mistake: a column missing, a cell that is no number, times
    that do not increase, fewer than ten samples, a displacement that never changes.
    """
    sources = columns_of(columns or {}, Path(path).name)
    outcome = apart.read(str(path), Request(sources, sample_time, needed=("displacement",)))
    if outcome.problems:
        raise InputError(outcome.problems)
    if not outcome.units:
        raise InputError(
            f"{path}: holds no path; name its columns as 'time [s],displacement [um]'."
        )
    units = outcome.units
    if parse_unit(units["displacement"]).counts:
        raise InputError(
            f"{path}: line 1: the displacement is in counts of a sensor, which is no length;"
            " give the path in um."
        )
    values = dict(zip(units, outcome.values.T, strict=True))
    time, displacement = (to_si(values[n], units[n]) for n in ("time", "displacement"))
    return checked_target(time, displacement, str(path))


def checked_target(time: FloatArray, displacement: FloatArray, where: str = "target") -> Target:
    """Return a path after checking it; raises InputError with every mistake."""
    problems = Problems()
    if time.size < _FEWEST or time.shape != displacement.shape:
        problems.add(
            f"{where}: holds {time.size} times and {displacement.size} displacements; give at least"
            f" {_FEWEST} samples, one displacement for each time."
        )
    elif not (np.isfinite(time).all() and np.isfinite(displacement).all()):
        problems.add(f"{where}: has samples that are missing or not finite; fill them in.")
    elif not (np.diff(time - time[0]) > 0.0).all():  # as it is used: a far start merges instants
        line = int(np.flatnonzero(np.diff(time - time[0]) <= 0.0)[0]) + 2
        problems.add(
            f"{where}: the time does not increase at sample {line}; sort the samples and remove"
            " repeated ones."
        )
    elif np.ptp(displacement) == 0.0:
        problems.add(f"{where}: the displacement never changes; give a path with a motion in it.")
    problems.raise_if_any()
    return Target(time - time[0], displacement)


@dataclass(frozen=True)
class AmplifierLimits:
    """Bounds of the voltage command [V], of its rate [V/s], and of the stack's current [A].

    Raises InputError if no voltage can obey them.
    """

    min_voltage: float = -inf
    max_voltage: float = inf
    max_rate: float = inf
    max_current: float = inf

    def __post_init__(self) -> None:
        problems = Problems()
        if not self.min_voltage < self.max_voltage:
            problems.add(
                f"The lowest voltage, {self.min_voltage:g} V, is not below the highest,"
                f" {self.max_voltage:g} V; correct one of them."
            )
        for name, most in (("rate", self.max_rate), ("current", self.max_current)):
            if not most > 0.0:
                unit = "V/s" if name == "rate" else "A"
                problems.add(f"The largest {name} is {most:g} {unit}; give a positive one.")
        problems.raise_if_any()


#: Relative tolerance of the simulations that judge a design.
RTOL = 1e-7


@dataclass(frozen=True, eq=False)
class Response:
    """A stack's answer to a voltage that is linear between samples; arrays of shape (n,), SI."""

    time: FloatArray
    voltage: FloatArray
    displacement: FloatArray
    current: FloatArray
    states: FloatArray

    @property
    def rate(self) -> FloatArray:
        """Rate of the voltage between samples (n - 1,) [V/s]."""
        return np.asarray(np.diff(self.voltage) / np.diff(self.time))


@dataclass(frozen=True)
class TrackingError:
    """Displacement minus path: rms and largest magnitude [m], and both as shares of its range."""

    rms: float
    largest: float
    span: float

    @property
    def rms_percent(self) -> float:
        """Error in percent of the path's range, rms."""
        return 100.0 * self.rms / self.span

    @property
    def largest_percent(self) -> float:
        """Largest error in percent of the path's range."""
        return 100.0 * self.largest / self.span


def respond(model: Model, time: FloatArray, voltage: FloatArray, rtol: float = RTOL) -> Response:
    """Simulate a stack that rests at the first voltage before the first sample."""
    u = input_samples(model, len(time), {"voltage": voltage})
    x0 = start_state(model, list(u[0]), time=float(time[0])).x
    steps = run(model, time, u, x0, rtol=rtol)
    row = model.output_names.index
    current = steps.y[:, row("current")] if "current" in model.output_names else 0.0 * time
    return Response(time, voltage, steps.y[:, row("displacement")], current, steps.x)


def behind_drive(model: Model, step: float, command: FloatArray, rest: float) -> FloatArray:
    """Return the voltage behind the drive (n, ...) for a command (n, ...) at its gain [V].

    The command goes in lines between samples every `step` [s], from rest at a voltage; exact.
    """
    constant = model.values["R_s"] * model.values["C_p"]
    decay = np.exp(-step / constant)
    later = 1.0 - constant / step * (1.0 - decay)
    upper, lower = [later, 1.0 - decay - later], [1.0, -decay]
    state = np.full((1, *command.shape[1:]), rest * (1.0 - later))
    return np.asarray(scipy.signal.lfilter(upper, lower, command, axis=0, zi=state)[0])


def error_of(target: Target, displacement: FloatArray) -> TrackingError:
    """Return the error of a displacement (n,) [m] against the path at its samples."""
    difference = displacement - target.displacement
    rms = float(np.sqrt(np.mean(difference**2)))
    return TrackingError(rms, float(np.max(np.abs(difference))), target.span)


def usage(
    response: Response, limits: AmplifierLimits
) -> tuple[tuple[str, float, float, float, str], ...]:
    """Return what a response takes of each limit: name, least, largest, limit, unit.

    The limit is that of the magnitude for rate and current, the highest for the voltage.
    """
    v, i, rate = response.voltage, response.current, response.rate
    return (
        ("voltage", float(v.min()), float(v.max()), limits.max_voltage, "V"),
        ("voltage rate", float(rate.min()), float(rate.max()), limits.max_rate, "V/s"),
        ("current", float(i.min()), float(i.max()), limits.max_current, "A"),
    )


def exceeds_limits(response: Response, limits: AmplifierLimits, slack: float = 1e-3) -> bool:
    """Whether a response breaks a limit by more than the share `slack`."""
    v = response.voltage
    span = limits.max_voltage - limits.min_voltage
    room = slack * (span if np.isfinite(span) else max(1.0, float(np.ptp(v))))
    return bool(
        v.max() > limits.max_voltage + room
        or v.min() < limits.min_voltage - room
        or np.abs(response.rate).max() > (1.0 + slack) * limits.max_rate
        or np.abs(response.current).max() > (1.0 + slack) * limits.max_current
    )


def uncompensated(model: Model, target: Target) -> Response:
    """Return the response to the path over the gain at rest of the linear part, a plain voltage."""
    gain = float(abs(linear_part(model).response(np.zeros(1))[0]))
    return respond(model, target.time, target.displacement / gain)


@dataclass(frozen=True, eq=False)
class Dynamics:
    """The equations that a design is made on.

    `f` is a CasADi function (time, x, v) -> (xdot, displacement, current) with columns of nx, one
    voltage [V], one displacement [m] and one current [A]; it may come from a model (`dynamics_of`)
    or from anything that has the same states, such as an imported FMU. `nominal` (nx,) are the
    sizes of the states.
    """

    f: ca.Function
    nominal: FloatArray


def dynamics_of(model: Model) -> Dynamics:
    """Return the equations of a stack's model; all other inputs stay at their start values.

    Raises InputError if the model has no voltage or no displacement.
    """
    demand_stack(model)
    s = model.structure
    time, x, v = ca.SX.sym("time"), ca.SX.sym("x", len(s.states)), ca.SX.sym("v")
    u = [v if i.name == "voltage" else ca.SX(i.start) for i in s.inputs]
    xdot, y = s.f(time, x, ca.vertcat(*u), model.parameter_vector())
    row = model.output_names.index
    current = y[row("current")] if "current" in model.output_names else ca.SX(0)
    f = ca.Function("dynamics", [time, x, v], [xdot, y[row("displacement")], current])
    return Dynamics(f, model.state_nominals())


def demand_stack(model: Model) -> None:
    """Raise InputError for a model that does not turn a voltage into a displacement."""
    if "voltage" not in model.input_names or "displacement" not in model.output_names:
        raise InputError(
            f"The model '{model.name}' has no voltage input or no displacement output, so no"
            " voltage can make it follow a path; give the model of a stack."
        )
    if model.structure.sampled:
        raise InputError(
            f"The model '{model.name}' has states that change at sample instants only, which a"
            " design cannot see through; give the stack without its controller."
        )


def smooth_form(model: Model, width: float) -> Model:
    """Return the model with the kinks at u' = 0 rounded over the rates `width` [V/s].

    The model's sign of the rate is u' / sqrt(u'^2 + hold_rate^2); the smooth form has `width`
    in place of a smaller hold_rate. A model without hysteresis is returned as it is.
    """
    if "hold_rate" not in model.values:
        return model
    wide = min(max(model.values["hold_rate"], width), model.parameter("hold_rate").bounds[1])
    return model.with_values({"hold_rate": wide})


def rest_at(model: Model, displacement: float) -> tuple[float, FloatArray]:
    """Return the voltage [V] that holds a displacement [m] without a past, and the state (nx,).

    Newton's method on the settled state by secants; the displacement at rest is all but linear in
    the voltage. Raises InputError if no voltage gives the displacement.
    """
    row, p = model.output_names.index("displacement"), model.parameter_vector()

    def settled(v: float) -> tuple[float, FloatArray]:
        u = [v if i.name == "voltage" else i.start for i in model.structure.inputs]
        x = start_state(model, u).x
        return float(model.structure.f(0.0, x, u, p)[1][row]), x

    before, after, size = 0.0, 1.0, model.output_nominals()[row]
    reached = settled(before)[0]
    for _ in range(20):
        position, x = settled(after)
        if position == reached or abs(position - displacement) < 1e-9 * size:
            break
        slope = (position - reached) / (after - before)
        before, reached, after = after, position, after + (displacement - position) / slope
    if not abs(position - displacement) < 1e-6 * size:
        raise InputError(
            f"No voltage holds the stack at {1e6 * displacement:g} um; the path is likely in"
            " another unit, or far beyond the stroke: correct it."
        )
    return after, x


def move_start(model: Model, begin: float, end: float, limits: AmplifierLimits) -> float:
    """Return the voltage [V] at the begin of a move [m]; both ends must be within the limits."""
    demand_stack(model)
    problems = Problems()
    if begin == end:
        problems.add("The move starts where it ends; name two positions.")
    if not np.isfinite([limits.min_voltage, limits.max_voltage]).all():
        problems.add(
            "A quickest move uses the whole voltage range; give both limits of the voltage."
        )
    problems.raise_if_any()
    rest = rest_at(model, begin)[0]
    for where, voltage in ((begin, rest), (end, rest_at(model, end)[0])):
        if not limits.min_voltage - 1e-9 <= voltage <= limits.max_voltage + 1e-9:
            problems.add(
                f"The stack rests at {1e6 * where:.4g} um with {voltage:.4g} V, outside the voltage"
                " limits; widen them or choose another position."
            )
    problems.raise_if_any()
    return float(np.clip(rest, limits.min_voltage, limits.max_voltage))


#: Share of the largest current that a held voltage aims at: the lag's part needs the rest.
_CURRENT = 0.98
#: A limit binds where no more than this share of it is left.
_BINDS = 0.01
#: Samples between two runs at a limit that count as one run.
_GAP = 4
#: Spans of time that a sentence names one by one.
_NAMED = 3


def held(
    model: Model, limits: AmplifierLimits, time: FloatArray, voltage: FloatArray
) -> FloatArray:
    """Return the voltage (n,) [V] clipped to its limits, and slowed to those of rate and current.

    The current of the drive is C_p u', u the voltage behind amplifier and lag, whose largest rate
    is no more than that of G v; a stack without these parameters has no limit of current here.
    """
    p, rate = model.values, limits.max_rate
    if np.isfinite(limits.max_current) and "C_p" in p:
        rate = min(rate, _CURRENT * limits.max_current / (p["C_p"] * p.get("G", 1.0)))
    clipped = np.clip(voltage, limits.min_voltage, limits.max_voltage)
    if rate == inf:
        return np.asarray(clipped)
    slowed = clipped.copy()
    for k, step in enumerate(rate * np.diff(time)):
        slowed[k + 1] = min(max(clipped[k + 1], slowed[k] - step), slowed[k] + step)
    return np.asarray(slowed)


def binding(response: Response, limits: AmplifierLimits) -> tuple[str, ...]:
    """Return one sentence for each limit that a response reaches: which, and from when to when.

    A rate or a current counts where it lasts for three samples at least.
    """
    v, rate, current = response.voltage, np.abs(response.rate), np.abs(response.current)
    room, most, amperes = _BINDS * np.ptp(v), limits.max_rate, limits.max_current
    cases = (
        (f"highest voltage, {limits.max_voltage:.4g} V", v > limits.max_voltage - room, 1),
        (f"lowest voltage, {limits.min_voltage:.4g} V", v < limits.min_voltage + room, 1),
        (f"largest rate, {most:.4g} V/s", np.append(rate[:1], rate) > (1.0 - _BINDS) * most, 3),
        (f"largest current, {amperes:.4g} A", current > (1.0 - 3.0 * _BINDS) * amperes, 3),
    )
    sentences = []
    for name, holds, fewest in cases:
        spans = [(a, b) for a, b in _runs(holds) if b - a + 1 >= fewest]
        if spans:
            times = [(1e3 * response.time[a], 1e3 * response.time[b]) for a, b in spans[:_NAMED]]
            when = " and ".join(f"from {first:.4g} to {last:.4g} ms" for first, last in times)
            more = len(spans) - _NAMED
            when += f", and {more} times more" if more > 0 else ""
            share = 100.0 * sum(b - a + 1 for a, b in spans) / len(v)
            sentences.append(f"The {name}, is reached {when} ({share:.2g} % of the samples).")
    return tuple(sentences)


def _runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Return first and last sample of every run of True; short gaps do not end one."""
    spans: list[tuple[int, int]] = []
    for first, stop in runs_of(mask):
        if spans and first - spans[-1][1] <= _GAP:
            spans[-1] = (spans[-1][0], stop - 1)
        else:
            spans.append((first, stop - 1))
    return spans
