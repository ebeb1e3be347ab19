"""Sampled models and what they should do, computed in plain NumPy and scipy.linalg.expm."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import expm

import psa_casadi as psa
from psa_casadi.common.units import FloatArray

PERIOD, LAG, GAIN, PROPORTIONAL, INTEGRAL = 1e-3, 4e-3, 2.0, 0.6, 150.0

PLANT = psa.Component(
    name="lag",
    description="first-order lag",
    source="textbook",
    parameters=(
        psa.Parameter("lag", LAG, "s", (1e-6, 10.0), "time constant"),
        psa.Parameter("gain", GAIN, "m/V", (0.0, 1e3), "gain"),
    ),
    states=(psa.State("position", "m", "position", nominal=1.0),),
    inputs=(psa.Input("disturbance", "V", "added to the command", nominal=1.0),),
    outputs=(psa.Output("measured", "m", "measured position"),),
    equations=lambda s: psa.Equations(
        der={"position": (s.gain * (s.command + s.disturbance) - s.position) / s.lag},
        out={"measured": s.position},
    ),
)

CONTROLLER = psa.Component(
    name="sampled_pi",
    description="sampled PI controller",
    source="textbook",
    parameters=(
        psa.Parameter("T_s", PERIOD, "s", (1e-6, 1.0), "sample period"),
        psa.Parameter("k_p", PROPORTIONAL, "V/m", (0.0, 1e3), "proportional gain"),
        psa.Parameter("k_i", INTEGRAL, "V/(m.s)", (0.0, 1e6), "integral gain"),
    ),
    sampled=(
        psa.State("integral", "V", "integral part", nominal=1.0),
        psa.State("command", "V", "command that is held", nominal=1.0),
    ),
    sample_period="T_s",
    inputs=(psa.Input("reference", "m", "reference", nominal=1.0),),
    outputs=(psa.Output("voltage", "V", "command that is sent"),),
    equations=lambda s: psa.Equations(
        next={
            "integral": s.integral + s.k_i * s.T_s * (s.reference - s.position),
            "command": s.integral + s.k_p * (s.reference - s.position),
        },
        out={"voltage": s.command},
    ),
)

#: A controller without a plant: its measurement is an input, and it has no continuous state.
ALONE = psa.Component(
    name="controller",
    description="sampled PI controller with a direct part",
    source="textbook",
    parameters=CONTROLLER.parameters,
    sampled=CONTROLLER.sampled,
    sample_period="T_s",
    inputs=(*CONTROLLER.inputs, psa.Input("position", "m", "measured position", nominal=1.0)),
    outputs=CONTROLLER.outputs,
    equations=CONTROLLER.equations,
)


@cache
def loop() -> psa.Model:
    """Return the closed loop; its inputs are (disturbance, reference)."""
    return psa.compose((PLANT, CONTROLLER), name="loop")


@cache
def controller() -> psa.Model:
    """Return the controller alone: two sampled states and no continuous one."""
    return psa.compose((ALONE,), name="controller")


def grid(count: int, step: float, start: float = 0.0) -> FloatArray:
    """Return times [s] that are `start + k step` periods, k = 0 .. count - 1."""
    times: FloatArray = PERIOD * (start + step * np.arange(count, dtype=np.float64))
    return times


@dataclass(frozen=True)
class Held:
    """What the loop does: position and voltage (n,), and its sampled states (n, 2), at times."""

    position: FloatArray
    voltage: FloatArray
    z: FloatArray


def expected(times: FloatArray, reference: float, slope: float, position: float = 0.0) -> Held:
    """Return the loop's exact answer to `reference + slope t` from t = times[0] on.

    Between instants the command is constant: with A = -1/lag, B = gain/lag the position follows
    exp([[A, B], [0, 0]] t) exactly; at an instant k T the PI recursion is applied to the position
    there. An instant at a time counts before the values at that time are taken.
    """
    matrix = np.array([[-1.0 / LAG, GAIN / LAG], [0.0, 0.0]])
    z, now, rows = np.zeros(2), float(times[0]), []

    def sample(t: float, x: float, z: FloatArray) -> FloatArray:
        error = reference + slope * t - x
        return np.array([z[0] + INTEGRAL * PERIOD * error, z[0] + PROPORTIONAL * error])

    k = int(np.ceil(now / PERIOD - 1e-6))
    for t in times:
        while k * PERIOD <= t + 1e-9 * PERIOD:
            position = float((expm(matrix * (k * PERIOD - now)) @ [position, z[1]])[0])
            now, z = k * PERIOD, sample(k * PERIOD, position, z)
            k += 1
        position = float((expm(matrix * (t - now)) @ [position, z[1]])[0])
        now = float(t)
        rows.append([position, z[1], *z])
    table = np.array(rows)
    return Held(table[:, 0], table[:, 1], table[:, 2:])
