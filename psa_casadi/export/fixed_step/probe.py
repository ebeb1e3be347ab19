"""The generated code run on this machine: compiled, played on reference voltages, compared."""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from psa_casadi.export.fixed_step.code import CodePlan, probe_code
from psa_casadi.export.fixed_step.step import FloatArray
from psa_casadi.model.compose import Model
from psa_casadi.simulation.compiler import shared_library
from psa_casadi.simulation.simulate import output_of
from psa_casadi.simulation.stepper import SimulationError, run
from psa_casadi.variables import nominal_value

#: Steps of a reference voltage.
STEPS = 1000
#: Multiples of the usual voltage that are tried beyond it, the furthest first.
_BEYOND = (8.0, 4.0, 2.0, 1.25)
#: Tolerance of the reference: its error is far below that of any step.
_RTOL = 1e-10


def _tones(s: FloatArray) -> FloatArray:
    parts = [np.sin(2 * np.pi * k * s + q) for k, q in ((11, 2.0), (37, 4.0), (90, 1.0))]
    return np.asarray(0.8 * np.sin(np.pi * s) ** 2 * (0.5 + 0.15 * sum(parts)))


#: Reference voltages from 0 to 1 over the share of their 1000 steps; what each of them holds.
VOLTAGES: dict[str, tuple[str, Callable[[FloatArray], FloatArray]]] = {
    "sine": ("5 periods of 200 steps", lambda s: 0.5 * (1.0 - np.cos(10.0 * np.pi * s))),
    "triangle": (
        "4 periods of 250 steps",
        lambda s: 1.0 - np.abs(2.0 * ((4.0 * s) % 1.0) - 1.0),
    ),
    "tones": ("11, 37 and 90 periods in 1000 steps", _tones),
    "ramps and holds": (
        "ramps of 200 steps, and holds between them",
        lambda s: np.interp(s, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0], [0.0, 0.9, 0.9, 0.3, 0.3, 0.0]),
    ),
    "jumps": (
        "jumps within one step, by up to 0.8 of the range",
        lambda s: np.select([s < 0.1, s < 0.4, s < 0.7], [0.0, 0.8, 0.2], 0.9),
    ),
}


@dataclass(frozen=True)
class VoltageError:
    """The largest error on one reference voltage over the range of the output there."""

    voltage: str
    error: float


def played_inputs(model: Model, shape: FloatArray) -> FloatArray:
    """Return inputs (n, nu): the voltage takes a shape, or all inputs of a model without one.

    Shapes go from 0 to 1; an input goes from its start value to its usual size.
    """
    s = model.structure
    u = np.tile([q.start for q in s.inputs], (len(shape), 1))
    for place, declared in enumerate(s.inputs):
        if declared.name == "voltage" or "voltage" not in model.input_names:
            full = nominal_value(declared.nominal, model.values)
            u[:, place] += (full - declared.start) * shape
    return u


def shown_output(model: Model) -> str:
    """Return the name of the output that is compared: the displacement, or the first one."""
    return output_of(model) or model.output_names[0]


class Probe:
    """A generated step as a library of this machine."""

    def __init__(self, plan: CodePlan, texts: dict[str, str]) -> None:
        self._plan = plan
        library = shared_library({**texts, "probe.c": probe_code(plan)}, (), ("-O2",))
        self._play = ctypes.CDLL(str(library)).psa_probe
        self._play.argtypes = [ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
        self._play.restype = None

    def play(self, u: FloatArray) -> FloatArray:
        """Return all outputs (n - 1, ny) after each step of inputs (n, nu), from the start on."""
        given = np.ascontiguousarray(u, dtype=np.float64)
        y = np.empty((len(u) - 1, len(self._plan.model.output_names)))
        self._play(len(u), given.ctypes.data, y.ctypes.data)
        return y


def errors(plan: CodePlan, texts: dict[str, str]) -> tuple[VoltageError, ...]:
    """Return the errors on all reference voltages, by the stepper at a far finer tolerance.

    An error that is no number is infinite. Raises SimulationError where the model itself fails.
    """
    probe, share = Probe(plan, texts), np.linspace(0.0, 1.0, STEPS + 1)
    return tuple(
        VoltageError(name, _error(plan, probe, played_inputs(plan.model, shape(share))))
        for name, (_, shape) in VOLTAGES.items()
    )


def reach(plan: CodePlan, texts: dict[str, str], allowed: float) -> float:
    """Return the voltage [V] up to which jumps within one step err by no more than `allowed`.

    In either direction and between both, over the range of the output there. At least the usual
    voltage, for which `errors` are; infinite for a model without one.
    """
    s = plan.model.structure
    if "voltage" not in plan.model.input_names:
        return float("inf")
    place, probe = plan.model.input_names.index("voltage"), Probe(plan, texts)
    usual = abs(nominal_value(s.inputs[place].nominal, plan.model.values))
    share = np.linspace(0.0, 1.0, STEPS + 1)
    jumps = np.select([share < 0.1, share < 0.4, share < 0.7], [0.0, 1.0, -1.0], 1.0)
    for multiple in _BEYOND:
        u = np.tile([q.start for q in s.inputs], (STEPS + 1, 1))
        u[1:, place] = multiple * usual * jumps[1:]
        try:
            if _error(plan, probe, u) <= allowed:
                return multiple * usual
        except SimulationError:  # nothing is known of the model there
            continue
    return usual


def _error(plan: CodePlan, probe: Probe, u: FloatArray) -> float:
    """Return the largest error over the range of the output on inputs (n, nu)."""
    model = plan.model
    output = model.output_names.index(shown_output(model))
    x0 = np.array([q.start for q in model.structure.states])
    times = plan.step * np.arange(len(u), dtype=np.float64)
    hold = "zero" if plan.held else "linear"
    true = run(model, times, u, x0, rtol=_RTOL, hold=hold).y[1:, output]
    # held inputs hold from the instant on that they are given for
    own = probe.play(np.vstack([u[:1], u[:-1]]) if plan.held else u)[:, output]
    size = float(np.ptp(true)) or float(model.output_nominals()[output])
    worst = float(np.max(np.abs(own - true))) / size
    return worst if np.isfinite(worst) else float("inf")
