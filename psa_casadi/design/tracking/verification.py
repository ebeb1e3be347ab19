"""What the full simulator says of a designed voltage: response, error, margins to the limits."""

from dataclasses import dataclass

import numpy as np

from psa_casadi.design.tracking.amplifier_limits import AmplifierLimits
from psa_casadi.design.tracking.targets import Target
from psa_casadi.model.compose import Model
from psa_casadi.simulation.linear_part import linear_part
from psa_casadi.simulation.simulate import input_samples
from psa_casadi.simulation.start import start_state
from psa_casadi.simulation.stepper import run
from psa_casadi.units import FloatArray

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
    rate = np.diff(response.voltage) / np.diff(response.time)
    v, i = response.voltage, response.current
    return (
        ("voltage", float(v.min()), float(v.max()), limits.max_voltage, "V"),
        ("voltage rate", float(rate.min()), float(rate.max()), limits.max_rate, "V/s"),
        ("current", float(i.min()), float(i.max()), limits.max_current, "A"),
    )


def broken(response: Response, limits: AmplifierLimits, slack: float = 1e-3) -> tuple[str, ...]:
    """Return one sentence for each limit that a response breaks by more than the share `slack`."""
    rate = np.abs(np.diff(response.voltage) / np.diff(response.time))
    span = limits.max_voltage - limits.min_voltage
    room = slack * span if np.isfinite(span) else slack * max(1.0, np.ptp(response.voltage))
    checks = (
        ("highest voltage", response.voltage.max() - limits.max_voltage > room, "V"),
        ("lowest voltage", limits.min_voltage - response.voltage.min() > room, "V"),
        ("largest rate", rate.max() > (1.0 + slack) * limits.max_rate, "V/s"),
        (
            "largest current",
            np.abs(response.current).max() > (1.0 + slack) * limits.max_current,
            "A",
        ),
    )
    values = (
        response.voltage.max(),
        response.voltage.min(),
        rate.max(),
        np.abs(response.current).max(),
    )
    return tuple(
        f"The {name} would be {value:.4g} {unit}, beyond its limit."
        for (name, is_broken, unit), value in zip(checks, values, strict=True)
        if is_broken
    )


def uncompensated(model: Model, target: Target) -> Response:
    """Return the response to the path over the gain at rest of the linear part, a plain voltage."""
    gain = float(abs(linear_part(model).response(np.zeros(1))[0]))
    return respond(model, target.time, target.displacement / gain)
