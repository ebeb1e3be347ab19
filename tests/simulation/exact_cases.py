"""Models, records and runs for the tests of exact steps."""

from functools import cache

import casadi as ca
import numpy as np

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.simulation.simulate import input_samples
from tests.model.stack_models import at_ordinary_size, stack

OUTPUT = "measured_displacement"
#: Five voltages over rated voltage, as functions of the share of the record.
VOLTAGES = ("sine", "triangle", "steps", "multisine", "ramps")
#: No list of names contains the components below.
LAG = psa.Component(
    name="second_lag",
    description="the voltage follows through one more lag",
    source="test",
    parameters=(psa.Parameter("tau_2", 3e-4, "s", (1e-7, 1.0), "time constant", log=True),),
    states=(psa.State("f_2", "N", "force after one more lag", 100.0),),
    equations=lambda s: psa.Equations(
        der={"f_2": (0.2 * s.f_out - s.f_2) / s.tau_2}, add={"wafer_force": s.f_2}
    ),
)
CUBIC = psa.Component(
    name="cubic_spring",
    description="a spring whose force grows with the third power",
    source="test",
    parameters=(psa.Parameter("cubic", 3e21, "N/m^3", (0.0, 1e24), "stiffness"),),
    equations=lambda s: psa.Equations(add={"tip_force": -s.cubic * s.x**3}),
)
#: Force from the displacement back to the hysteresis.
FEEDBACK = psa.Component(
    name="feedback",
    description="the displacement lowers the drive voltage",
    source="test",
    parameters=(psa.Parameter("back", 1e5, "V/m", (0.0, 1e9), "volts per metre"),),
    equations=lambda s: psa.Equations(add={"drive_voltage": -s.back * s.x}),
)
KINK = psa.Component(
    name="kink",
    description="a stop with a switch",
    source="test",
    equations=lambda s: psa.Equations(
        add={"tip_force": -1e6 * ca.fmax(0, s.x - 3e-6)}, switches={"contact": s.x - 3e-6}
    ),
)
#: What jumps has a derivative of zero everywhere that CasADi looks.
JUMP = psa.Component(
    name="jump",
    description="a force that sets in at a voltage",
    source="test",
    equations=lambda s: psa.Equations(add={"free_force": -5.0 * (s.u > 37.3)}),
)
#: A force that depends on time alone.
BEAT = psa.Component(
    name="beat",
    description="a tone at the tip",
    source="test",
    parameters=(psa.Parameter("beat_period", 1e-3, "s", (1e-9, 1.0), "period", log=True),),
    equations=lambda s: psa.Equations(
        add={"tip_force": 20.0 * ca.sin(2.0 * np.pi * s.time / s.beat_period)}
    ),
)


@cache
def with_effect(name: str, stack_name: str = "P-885.51") -> psa.Model:
    """Return a stack with one effect at an ordinary size; "base" is the stack alone."""
    model = stack(stack_name)
    return model if name == "base" else at_ordinary_size(model, psa.EFFECTS[name])


def times(samples: int, step: float) -> FloatArray:
    """Return instants (n,) [s] that are `step` apart, from 0 on."""
    values: FloatArray = step * np.arange(samples, dtype=np.float64)
    return values


def voltage(kind: str, share: FloatArray) -> FloatArray:
    """Return a voltage over the rated one at shares (n,) of the record."""
    corners, levels = [0.0, 0.1, 0.3, 0.5, 0.6, 0.8, 1.0], [0.0, 0.0, 0.8, 0.8, 0.3, 0.3, 0.0]
    tones = ((3, 0.3), (11, 2.0), (37, 4.0), (90, 1.0))
    shapes = {
        "sine": 0.4 * (1.0 - np.cos(10.0 * np.pi * share)),
        # corners between the samples
        "triangle": 0.8 * (1.0 - np.abs(2.0 * ((4.0 * share + 0.003) % 1.0) - 1.0)),
        "steps": np.select([share < 0.1, share < 0.4, share < 0.7], [0.0, 0.7, 0.2], 0.9),
        "multisine": 0.4 + 0.1 * sum(np.sin(2 * np.pi * k * share + q) for k, q in tones),
        "ramps": np.interp(share, corners, levels),
    }  # fmt: skip
    return np.asarray(shapes[kind], dtype=np.float64)


def composite(samples: int) -> FloatArray:
    """Return a sine, a ramp, a hold and a step one after the other, over rated voltage."""
    share = np.linspace(0.0, 1.0, samples)
    sine = 0.4 * (1.0 - np.cos(10.0 * np.pi * share))
    rest = np.interp(share, [0.0, 0.4, 0.6, 0.8, 1.0], [0.0, 0.0, 0.7, 0.7, 0.7])
    return np.select([share < 0.4, share < 0.9], [sine, rest], 0.2)


def inputs(model: psa.Model, t: FloatArray, relative: FloatArray) -> FloatArray:
    """Return all inputs (n, nu) for a voltage over the rated one; a temperature wanders."""
    table = {"voltage": model.values["u_rated"] * relative}
    if "temperature" in model.input_names:
        reference = model.values["temperature_reference"]
        table["temperature"] = reference + 2.0 * np.sin(3.0 * t / t[-1])
    return input_samples(model, len(t), table)


def stepped(
    model: psa.Model,
    t: FloatArray,
    u: FloatArray,
    x0: FloatArray,
    *,
    rtol: float = 1e-10,
    hold: str = "linear",
) -> FloatArray:
    """Return the measured displacement (n,) by the stepper."""
    y = psa.run(model, t, u, x0, rtol=rtol, hold=hold).y
    return y[:, model.output_names.index(OUTPUT)]


def error(values: FloatArray, true: FloatArray) -> float:
    """Return the largest difference over the range."""
    return float(np.abs(values - true).max() / np.ptp(true))
