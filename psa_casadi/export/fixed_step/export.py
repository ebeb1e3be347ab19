"""A model as two files of C99 for a controller: a step of fixed length and constant cost.

Whether it fits is planned, in how many substeps, and how far it errs.
"""

import ctypes
import math
import os
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_write, make_folder
from psa_casadi.common.units import FloatArray
from psa_casadi.export.common.markup import generation_tool
from psa_casadi.export.common.publication import code_license, refuse_foreign
from psa_casadi.export.common.templates import filled
from psa_casadi.export.fixed_step import code
from psa_casadi.export.fixed_step.code import PRECISIONS, CodePlan, Precision, probe_code
from psa_casadi.export.fixed_step.step import step_of
from psa_casadi.model.components import BASE, SIMPLIFIED
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import nominal_value
from psa_casadi.simulation.compiler import shared_library
from psa_casadi.simulation.exact.printing import Unprintable
from psa_casadi.simulation.simulate import output_of
from psa_casadi.simulation.stepper import SimulationError, run

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


def main_output(model: Model) -> str:
    """Return the name of the output that is compared: the displacement, or the first one."""
    return output_of(model) or model.output_names[0]


class Probe:
    """A generated step as a library of this machine, compared with the stepper."""

    def __init__(self, plan: CodePlan, texts: dict[str, str]) -> None:
        self._plan = plan
        library = shared_library({**texts, "probe.c": probe_code(plan)}, (), ("-O2",))
        self._play = ctypes.CDLL(str(library)).psa_probe
        self._play.argtypes = [ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
        self._play.restype = None

    def play(self, u: FloatArray) -> FloatArray:
        """Return all outputs (n - 1, ny) after each step of inputs (n, nu), from the start on."""
        inputs = np.ascontiguousarray(u, dtype=np.float64)
        y = np.empty((len(u) - 1, len(self._plan.model.output_names)))
        self._play(len(u), inputs.ctypes.data, y.ctypes.data)
        return y

    def error(self, u: FloatArray) -> float:
        """Return the largest error over the range of the output on inputs (n, nu).

        The stepper has a far finer tolerance. An error that is no number is infinite. Raises
        SimulationError where the model itself fails.
        """
        plan, model = self._plan, self._plan.model
        output = model.output_names.index(main_output(model))
        x0 = np.array([q.start for q in model.structure.states])
        times = plan.step * np.arange(len(u), dtype=np.float64)
        hold = "zero" if plan.held else "linear"
        true = run(model, times, u, x0, rtol=_RTOL, hold=hold).y[1:, output]
        # held inputs hold from their instant on
        played = self.play(np.vstack([u[:1], u[:-1]]) if plan.held else u)[:, output]
        size = float(np.ptp(true)) or float(model.output_nominals()[output])
        worst = float(np.max(np.abs(played - true))) / size
        return worst if np.isfinite(worst) else float("inf")


def errors(plan: CodePlan, texts: dict[str, str]) -> tuple[VoltageError, ...]:
    """Return the errors on all reference voltages; raises what `Probe.error` raises."""
    probe, share = Probe(plan, texts), np.linspace(0.0, 1.0, STEPS + 1)
    return tuple(
        VoltageError(name, probe.error(played_inputs(plan.model, shape(share))))
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
        with suppress(SimulationError):  # nothing is known of the model there
            if probe.error(u) <= allowed:
                return multiple * usual
    return usual


#: Substeps that are tried by default, and the error that is good enough.
SUBSTEPS, GOOD = (1, 2, 4, 8), 1e-3
#: Error beyond which a step is of no use.
USELESS = 0.1
#: Two times that differ by less than this share are one.
_SAME = 1e-9
_HELD = {"linear": False, "zero": True}
#: Returns the plan of a model's step with its source, or why it has none.
Attempt = Callable[[Model], tuple[code.CodePlan, str] | str]


@dataclass(frozen=True, eq=False)
class FixedStep:
    """A planned step with its sources by file name, and its measured errors."""

    plan: code.CodePlan
    texts: dict[str, str]
    errors: tuple[VoltageError, ...]

    @property
    def worst(self) -> VoltageError:
        """Return the largest error."""
        return max(self.errors, key=lambda e: e.error)


def fixed_step(
    model: Model,
    *,
    name: str,
    step: float,
    precision: str = "double",
    hold: str = "linear",
    substeps: int | None = None,
) -> FixedStep:
    """Return the fixed step of a model: generated, compiled here, and compared.

    Without `substeps` the fewest of `SUBSTEPS` that err by less than `GOOD` are taken, or those
    that err least.

    Raises InputError for bad arguments, for a model that does not fit, with the effect and the
    reason, and for a step that is too long; MachineError if the compiler fails.
    """
    _check(name, step, precision, hold, substeps)
    if model.structure.sampled and _HELD[hold]:
        raise InputError(
            f"The model '{model.name}' reads its inputs at sample instants; --hold zero is for"
            " inputs of continuous models: leave it out."
        )
    fixed_steps: list[FixedStep] = []
    counts = SUBSTEPS if model.structure.states else SUBSTEPS[:1]
    for count in counts if substeps is None else (substeps,):
        attempt = partial(
            _plan_or_reason, name=name, step=step, substeps=count, held=_HELD[hold],
            precision=PRECISIONS[precision],
        )  # fmt: skip
        plan, source = _planned(model, attempt)
        texts = {f"{name}.h": header_code(plan), f"{name}.c": source}
        measured = errors(plan, texts)
        texts[f"{name}.h"] = header_code(plan, measured)
        fixed_steps.append(FixedStep(plan, texts, measured))
        if fixed_steps[-1].worst.error <= GOOD:
            break
    best = min(fixed_steps, key=lambda f: f.worst.error)
    plan, worst = best.plan, best.worst
    if not worst.error <= USELESS:
        cure = "the step is too long for this model: take a shorter one, or more --substeps"
        if not model.structure.states:
            cure = f"{precision} precision is too coarse for this model: take double"
        raise InputError(
            f"With a step of {step:g} s in {plan.substeps} substeps the {main_output(model)} errs"
            f" by {100 * worst.error:.3g} % of its range on {worst.voltage}; {cure}."
        )
    # the voltage is limited to where the step is as good as on the reference ones
    plan = replace(plan, limit=reach(plan, best.texts, max(GOOD, worst.error)))
    sources = (header_code(plan, best.errors), code.source_code(plan))
    return FixedStep(plan, dict(zip(best.texts, sources, strict=True)), best.errors)


def header_code(plan: code.CodePlan, errors: tuple[VoltageError, ...] = ()) -> str:
    """Return the header; its comment states the `errors` that were measured."""
    model = plan.model
    return filled(
        "fixed_step.h",
        **code.names_of(plan),
        model=model,
        numbers={name: repr(value) for name, value in model.values.items()},
        errors=errors,
        steps=STEPS,
        voltages=VOLTAGES,
        output=main_output(model) if errors else "",
        limit_words=code.limit_words(plan.limit),
        licence="\n".join(code_license().splitlines()),
        tool=generation_tool(),
    )


def _check(name: str, step: float, precision: str, hold: str, substeps: int | None) -> None:
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
        raise InputError(
            f"'{name}' cannot name functions in C; use letters, digits, underscores, no digit"
            " first."
        )
    try:
        positive = 0.0 < step < np.inf
    except TypeError:  # a text
        positive = False
    if not positive:
        raise InputError(f"The step is {step!r}; give seconds above 0, such as 1e-5.")
    if precision not in PRECISIONS:
        raise InputError(f"The precision '{precision}' is not known; choose double or single.")
    if hold not in _HELD:
        raise InputError(f"The hold '{hold}' is not known; choose linear or zero.")
    if substeps is not None and not 1 <= substeps <= 1000:
        raise InputError(f"The substeps are {substeps}; give a number from 1 to 1000.")


def _planned(model: Model, attempt: Attempt) -> tuple[code.CodePlan, str]:
    """Return the plan of a step and its source.

    Raises InputError where the model does not fit, with the effect to blame and the reason.
    """
    result = attempt(model)
    if not isinstance(result, str):
        code.check_names(result[0])
        return result
    base, blamed = {c.name for c in (*BASE, *SIMPLIFIED)}, []
    for name in (c.name for c in model.components if c.name not in base):
        with suppress(InputError):  # where others need it
            if not isinstance(attempt(model.without([name])), str):
                blamed.append(name)
    if not blamed:
        raise InputError(
            f"The model '{model.name}' has no step of fixed length and constant cost: {result}."
            " Export an FMU with the adaptive solver."
        )
    who = " or ".join(f"'{name}'" for name in blamed)
    raise InputError(
        f"The effect {who} does not fit a step of fixed length and constant cost: with it the"
        f" model is not of the form that is needed ({result}). Leave the effect out, or export an"
        " FMU with the adaptive solver."
    )


def _plan_or_reason(
    model: Model, *, name: str, step: float, substeps: int, held: bool, precision: Precision
) -> tuple[code.CodePlan, str] | str:
    if not model.output_names:
        return "it has no outputs"
    expression = step_of(model, step / substeps)
    if isinstance(expression, str):
        return expression
    every = _steps_of_a_period(model, step)
    plan = code.CodePlan(model, expression, name, step, substeps, held, precision, every)
    if precision.single and code.timed(plan):
        return (
            "its equations depend on the time itself, which single precision knows to 0.2 ms after"
            " an hour; double precision does not have this limit"
        )
    try:
        return plan, code.source_code(plan)
    except Unprintable as reason:
        return f"its equations have what the code cannot express, {reason}"


def _steps_of_a_period(model: Model, step: float) -> int:
    """Return how many steps a sample period has; 0 where nothing is sampled."""
    name = model.structure.period
    if name is None:
        return 0
    period = model.values[name]
    count = round(period / step)
    if count < 1 or abs(count * step - period) > _SAME * period:
        raise InputError(
            f"The model '{model.name}' is sampled every {period:g} s ({name}), which is no multiple"
            f" of the step of {step:g} s; give a step of {period / max(count, 1):.12g} s."
        )
    return count


@dataclass(frozen=True)
class CodeExport:
    """The files that were written, the substeps of a step, and the errors that were measured.

    An error is the largest one of the displacement over its range, on one reference voltage. A
    voltage beyond `limit` [V] is limited to it; it is infinite where there is no voltage.
    """

    header: Path
    source: Path
    substeps: int
    errors: tuple[VoltageError, ...]
    limit: float = math.inf


def export_c(
    model: Model,
    directory: str | os.PathLike[str],
    *,
    step: float,
    precision: str = "double",
    name: str | None = None,
    include_sensor: bool = False,
    hold: str = "linear",
    substeps: int | None = None,
) -> CodeExport:
    """Write a model as `name.c` and `name.h`: `name_init` and `name_step`, C99, no allocation.

    `step` is the time [s] between two calls of `name_step`. `precision` is "double" or "single".
    Inputs are reached at the end of a step along a line (`hold` "linear") or hold over it ("zero").
    A step is `substeps` equal ones; by default the fewest of 1, 2, 4 and 8 that err by less than
    0.1 % of the range. Parameters are fixed; `settled_at` gives a model another start. Sensor and
    environment stay out unless `include_sensor`. `name` is a C identifier, by default the model's
    name. The code is compiled here and compared with the stepper on reference voltages.

    Raises InputError for bad arguments, a model that does not fit (with the effect and the reason)
    or a step that is too long, and MachineError if the compiler fails.
    """
    refuse_foreign(model.structure, "C")
    exported = model if include_sensor else model.plant()
    identifier = name or model.name
    result = fixed_step(
        exported, name=identifier, step=step, precision=precision, hold=hold, substeps=substeps
    )
    folder = Path(directory)
    make_folder(folder)
    for file_name, text in result.texts.items():
        atomic_write(folder / file_name, text)
    header, source = (folder / f"{identifier}.{ending}" for ending in "hc")
    return CodeExport(header, source, result.plan.substeps, result.errors, result.plan.limit)
