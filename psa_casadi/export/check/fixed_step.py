"""What an FMU with a fixed step must give: the errors that it states, on their voltages."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError
from psa_casadi.export.check.agreement import bare_truth, expected_outputs, has_reference, simulated
from psa_casadi.export.check.rows import BREAKDOWNS
from psa_casadi.export.check.truth import Run, Truth
from psa_casadi.export.fixed_step.probe import STEPS, VOLTAGES, played_inputs, shown_output
from psa_casadi.export.fmu.sources import FIXED_ENTRY, fixed_step_of
from psa_casadi.export.importer.masters import Signals
from psa_casadi.model.compose import Model
from psa_casadi.strict_json import parse_json, read_json_text

FloatArray = npt.NDArray[np.float64]

#: Errors are stated with two digits, and what they are compared with errs too.
_ROUNDING, _OWN_ERROR = 1.06, 1e-8
#: Steps of the run with longer communication steps, and the voltage that is straight in between.
_AT_ONCE, _STRAIGHT = 10, "ramps and holds"
#: The reference restarts at every knot of a voltage; with more of them the simulator computes it.
_MOST_KNOTS = 50


@dataclass(frozen=True)
class StatedStep:
    """What an FMU says of its fixed step [s]: the largest error by voltage, over the range."""

    step: float
    errors: Mapping[str, float]


def stated_step(directory: Path) -> StatedStep | None:
    """Return what an unpacked FMU says of its fixed step; None if it has none.

    Raises InputError if it does not state an error for each reference voltage, as JSON.
    """
    step = fixed_step_of(directory)
    if step is None:
        return None
    try:
        text = read_json_text(directory / FIXED_ENTRY)
        found = parse_json(text, FIXED_ENTRY, "export the FMU again.")["errors"]
        errors = {name: float(found[name]) for name in VOLTAGES}
    except (KeyError, OSError, TypeError, ValueError) as error:
        raise InputError(
            f"{FIXED_ENTRY}: does not state the error for each reference voltage ({error});"
            " export the FMU again."
        ) from error
    if not all(math.isfinite(e) and e >= 0.0 for e in (*errors.values(), step)) or step == 0.0:
        raise InputError(f"{FIXED_ENTRY}: its numbers are impossible; export the FMU again.")
    return StatedStep(step, errors)


def fixed_truth(model: Model, version: int, stated: StatedStep) -> Truth:
    """Return what an FMU with a fixed step is compared with; runs that fail are a problem."""
    truth = bare_truth(model)
    try:
        names = (shown_output(model),)
        runs = [_run(model, name, stated, held=version == 3) for name in VOLTAGES]
        runs.append(_run(model, _STRAIGHT, stated, held=version == 3, every=_AT_ONCE))
    except BREAKDOWNS as error:
        return replace(truth, problem=str(error))
    return replace(truth, compared=names, scale=np.ones(1), runs=tuple(runs))


def _run(model: Model, name: str, stated: StatedStep, *, held: bool, every: int = 1) -> Run:
    """Return the run of a reference voltage, in communication steps of some fixed ones.

    Where inputs are held over several, they jump more often: by less than in the worst of them.
    """
    _, shape = VOLTAGES[name]
    grid = np.arange(0, STEPS + 1, every)
    times = stated.step * grid.astype(np.float64)
    inputs = played_inputs(model, shape(np.linspace(0.0, 1.0, STEPS + 1)))[grid]
    signals = _knots(Signals(model.input_names, times, inputs, held))
    exact = has_reference(model) and len(signals.times) <= _MOST_KNOTS
    compute = expected_outputs if exact else simulated
    column = model.output_names.index(shown_output(model))
    expected = compute(model, times, signals)[:, column : column + 1]
    scale = np.ptp(expected, axis=0)
    error = max(stated.errors.values()) if held and every > 1 else stated.errors[name]
    return Run(
        f"fixed step, {name}" + (f", {every} at once" if every > 1 else ""),
        times,
        signals,
        expected,
        _ROUNDING * error + _OWN_ERROR,
        scale=np.where(scale > 0.0, scale, model.output_nominals()[column]),
        by="reference" if exact else "simulator",
    )


def _knots(signals: Signals) -> Signals:
    """Return the same signals without the knots at which nothing bends or jumps."""
    u = signals.values
    rounding = 1e-9 * np.max(np.abs(u), initial=0.0)
    bends = u[1:-1] - u[:-2] if signals.held else u[2:] - 2.0 * u[1:-1] + u[:-2]
    kept = np.ones(len(u), dtype=bool)
    kept[1:-1] = np.any(np.abs(bends) > rounding, axis=1)
    return replace(signals, times=signals.times[kept], values=u[kept])
