"""`psa linearize`: a model as matrices at an operating point, its Bode picture, loop, observer."""

from pathlib import Path

import psa_casadi as psa
from psa_casadi.cli.inputs import Fitting, Inputs, own_model, step_seconds
from psa_casadi.cli.options import StackName
from psa_casadi.cli.screen import show, show_written


def linearize(
    *,
    model: Path | None = None,
    fmu: Path | None = None,
    stack: StackName = None,
    at: list[str] | None = None,
    state: list[str] | None = None,
    output: Path | None = None,
    figure: Path | None = None,
    controller: str | None = None,
    from_: str | None = None,
    to: str | None = None,
    observer: Path | None = None,
    noise: list[str] | None = None,
    step: str = "100us",
    inputs: Inputs,
) -> None:
    """Linearise a model at rest: A, B, C, D, poles, Bode picture, margins, Kalman filter.

    A stack, your model (FILE.py:FUNCTION or its file), or an FMU of model exchange.

    Options:
        model: MODEL.json, or your model.
        fmu: FMU of any tool, in the place of --model.
        at: Input at the operating point, NAME=VALUE in SI units; repeat for several.
        state: State there, NAME=VALUE in SI units, where it is not at rest; repeat for several.
        output: NAME.mat or NAME.json to write: matrices, point, names.
        figure: Bode picture to write, PNG, SVG or PDF as its name ends.
        controller: Transfer function that acts on the setpoint less the output, as "2 50 / 1 0" for
            (2 s + 50)/s, of which it prints the loop's margins. Needs python-control.
        from_: Input of the loop, where there are several.
        to: Output of the loop, where there are several.
        observer: NAME.fmu to write, or a folder for C: a Kalman filter of the model.
        noise: Standard deviation of the samples of an input or a measured output, NAME=VALUE in SI
            units, for the observer; repeat for several.
        step: Time between these samples with its unit, and the step of the observer's C.

    Example:
        psa linearize --stack P-885.51 --at voltage=60 -o stack.mat --figure bode.png
    """
    from psa_casadi.report.plots.figures import bode_figure, write_figure
    from psa_casadi.report.words.catalogue import say

    is_fmu = observer is not None and observer.suffix.lower() == ".fmu"
    files = {"--output": output, "--figure": figure, "--observer": observer if is_fmu else None}
    inputs.outputs(files, [model, fmu], ("matrices", ".mat", ".json"))
    chosen = own_model(inputs, model, Fitting(fmu=fmu), fitted=False)
    if chosen is None:
        chosen = inputs.model_or_stack(model, stack, any_model=True)
    point, states = inputs.numbers("--at", at), inputs.numbers("--state", state)
    sizes, loop = inputs.numbers("--noise", noise), _parsed(inputs, controller)
    seconds = inputs.attempt(lambda: step_seconds(step, plain=True))
    result = psa.linearize(inputs.ready(chosen), point, states=states)
    show(repr(result))
    if loop is not None:
        m = psa.margins(result, loop, input=from_, output=to)
        show(say("command.loop", m=m))
    if output is not None:
        result.save(output)
    if figure is not None:
        write_figure(bode_figure(result), figure)
    if observer is not None:
        made = psa.observer(
            result,
            input_noise={n: v for n, v in sizes.items() if n in result.input_names},
            output_noise={n: v for n, v in sizes.items() if n not in result.input_names},
            step=inputs.ready(seconds),
        )
        if is_fmu:
            psa.export_fmu(made, observer)
        else:
            psa.export_c(made, observer, step=inputs.ready(seconds))
    show_written(output, figure, observer)


def _parsed(inputs: Inputs, controller: str | None) -> tuple[list[float], list[float]] | None:
    """Return numerator and denominator of a controller's text; None without one."""
    if controller is None:
        return None
    parts = controller.split("/")
    try:
        top, bottom = ([float(q) for q in part.split()] for part in parts)
        if top and any(bottom):
            return top, bottom
    except ValueError:
        pass
    inputs.add(f"--controller is '{controller}'; give coefficients, as \"2 50 / 1 0\".")
    return None
