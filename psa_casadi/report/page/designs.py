"""Pages of designs: an input, an experiment, a prestress mechanism."""

import os
from collections.abc import Mapping, Sequence

import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_write
from psa_casadi.common.units import FloatArray
from psa_casadi.design.experiment.experiment import Informative, Separated
from psa_casadi.design.mechanism.loop import Mounting, response_times, step_response
from psa_casadi.design.mechanism.mechanism import MechanismDesign, mounted_model, root_locus
from psa_casadi.design.tracking.minimum_time import QuickMove
from psa_casadi.design.tracking.targets import AmplifierLimits, Response, Target, respond
from psa_casadi.design.tracking.tracking import TrackedInput
from psa_casadi.model.compose import Model
from psa_casadi.records.signals import Signals
from psa_casadi.report.page.document import Picture, render
from psa_casadi.report.page.live import LiveModel, live_design
from psa_casadi.report.plots.figures import record_figure, response_figure
from psa_casadi.report.plots.panel import Panel
from psa_casadi.report.words import colours, design_words
from psa_casadi.report.words.catalogue import say
from psa_casadi.report.words.phrases import any_scale, in_brackets, number, plain

_COLOURS = (colours.EXTENDED, colours.BASE, colours.MEASURED)
_HEIGHT, _MOST_POINTS = 360, 4000
#: Duration of a move and its hold in the plot, over the move's; the zoom shows the rest.
_SHOWN = 2.5
_FREE = Mounting(0.0, 0.0, 0.0)
#: Samples of the step that the page's model runs on.
_STEP_SAMPLES = 3000


def write_design_page(
    path: str | os.PathLike[str],
    *,
    title: str,
    summary: Sequence[str],
    tables: Sequence[design_words.Titled] = (),
    figures: Sequence[Picture] = (),
    badges: Sequence[str] = (),
    live: LiveModel | None = None,
) -> None:
    """Write the page of a design, whole or not at all.

    The first sentence of `summary` is the result, the others follow as a list; then come the
    figures and the tables with their notes. `badges` are short marks under the title, such as
    "2,000 samples". `live` is a model that runs in the page on the designed voltage; where no
    script runs, a picture shows it, with its path if it has one.

    Raises InputError when `path` cannot be written to.
    """
    still = None
    if live is not None:
        s = live.records[0].series
        if s.unit or live.records[0].residual.any():
            still = record_figure(s, origin=live.aim), f"The {live.aim} and the model"
        else:
            figure = response_figure(s.time, s.voltage, s.measured)
            still = figure, "The model's answer to the voltage"
    page = render(
        "design.html", title, tuple(badges), summary=summary, still=still, figures=figures,
        live=live, tables=tables,
    )  # fmt: skip
    atomic_write(path, page)


# Inputs


def tracking_pictures(tracked_input: TrackedInput, uncompensated: FloatArray) -> list[Picture]:
    """Return path and response, the error, and the voltage with its limits."""
    target, x = tracked_input.target, tracked_input.response.displacement
    share = 100.0 / target.span
    responses = ("designed, simulated", x), ("uncompensated, simulated", uncompensated)
    errors = Panel("time [ms]", "error [% of range]", _HEIGHT)
    _curve(errors, target.time, share * (x - target.displacement), "simulated")
    if tracked_input.by_program:
        predicted = share * (tracked_input.predicted - target.displacement)
        _curve(errors, target.time, predicted, "predicted by the program", colours.BASE, 1.2)
    return [
        path_picture("Path and response", target, *responses),
        Picture("Error of the designed input", errors),
        voltage_picture(tracked_input.response, tracked_input.limits),
    ]


def move_pictures(quick_move: QuickMove) -> list[Picture]:
    """Return the displacement of a quickest move with its hold, and the voltage."""
    plot = Panel("time [ms]", "displacement [µm]", _HEIGHT).across(1e6 * quick_move.end)
    r = quick_move.response
    _curve(plot, r.time, 1e6 * r.displacement, "simulated", width=1.8)
    note = "Dashed: the position to reach. The voltage holds its last value behind the move."
    pictures = [Picture("Move and hold", plot, note), voltage_picture(r, quick_move.limits)]
    for picture in pictures:
        picture.panel.axes({"range": [0.0, _SHOWN * 1e3 * quick_move.move_time]})
    return pictures


def path_picture(caption: str, target: Target, *curves: tuple[str, FloatArray]) -> Picture:
    """Return the path over time, and displacements (n,) [m] on it by their names."""
    plot = Panel("time [ms]", "displacement [µm]", _HEIGHT)
    _curve(plot, target.time, 1e6 * target.displacement, "path", colours.MEASURED, 3.0)
    for (name, displacement), colour in zip(curves, _COLOURS, strict=False):
        _curve(plot, target.time, 1e6 * displacement, name, colour)
    return Picture(caption, plot)


def voltage_picture(
    response: Response, limits: AmplifierLimits, played: FloatArray | None = None
) -> Picture:
    """Return the voltage over time with its limits, and another one that was played."""
    plot = Panel("time [ms]", "voltage [V]", _HEIGHT)
    if played is not None:
        _curve(plot, response.time, played, "played in the trial", colours.BASE)
    _curve(plot, response.time, response.voltage, "designed", width=1.6)
    bounds = [v for v in (limits.min_voltage, limits.max_voltage) if np.isfinite(v)]
    return Picture("Voltage", plot.across(*bounds))


def _curve(
    plot: Panel, time: FloatArray, values: FloatArray, name: str, colour: str = colours.EXTENDED,
    width: float = 1.4,
) -> Panel:  # fmt: skip
    """Add values over time [s], thinned to what a screen shows."""
    part = slice(None, None, max(1, len(time) // _MOST_POINTS))
    return plot.line(1e3 * time[part], values[part], name, colour, width)


# Experiments


def write_experiment_page(
    path: str | os.PathLike[str], design: Separated | Informative, live: LiveModel | None = None
) -> None:
    """Write the page of a designed experiment, with what each of its rivals predicts.

    `live` is the model that runs in the page on the designed voltage. Raises InputError where the
    page cannot be written.
    """
    several, record = isinstance(design, Separated), design.record
    figures = []
    for name, values in record.columns.items():
        applied = Panel("time [s]", in_brackets(name, record.units[name]), 320)
        applied.line(record.time, values, colour=colours.MEASURED)
        figures.append(Picture(f"The {name} to apply", applied))
    predicted = {r.name: r.predict(record, r.truth) for r in design.rivals}
    units = {o.name: o.unit for r in design.rivals for o in r.model.structure.outputs}
    for k, name in enumerate(design.rivals[0].outputs):
        outputs = {n: y[:, k] for n, y in predicted.items()}
        figures.append(_responses(record, outputs, name, units[name]))
    write_design_page(
        path,
        title="Experiment that separates effects" if several else "Experiment for the parameters",
        summary=design_words.sentences(design),
        tables=design_words.design_tables(design),
        figures=figures,
        badges=(f"{record.n} samples", f"{number(record.n * record.sample_time)} s"),
        live=live,
    )


def _responses(
    record: Signals, responses: Mapping[str, FloatArray], output: str, unit: str
) -> Picture:
    """Return the plot of a predicted output, less the rivals' mean where there are several."""
    several = len(responses) > 1
    middle = np.mean(list(responses.values()), axis=0) if several else np.zeros(record.n)
    deviations = {n: y - middle for n, y in responses.items()}
    largest = max(float(np.max(np.abs(y))) for y in deviations.values())
    scale = any_scale(largest, unit)
    name = output.removeprefix("measured_")
    plot = Panel("time [s]", in_brackets(name, scale.unit), 340)
    for (rival, y), colour in zip(deviations.items(), _COLOURS * len(deviations), strict=False):
        plot.line(record.time, scale.factor * y, plain(rival), colour)
    caption = f"Where the predictions of {name} part" if several else f"Predicted {name}"
    return Picture(caption, plot, say("design.rivals_part") if several else "")


# Mechanisms


def write_mechanism_page(
    d: MechanismDesign, path: str | os.PathLike[str], model: Model, *, still: bool = False
) -> None:
    """Write the design as an HTML page; `model` is the stack.

    Unless it is to be `still`, the stack with its mechanism runs in the page. Raises InputError if
    it cannot be written.
    """
    why, live = [], None
    if not still:
        try:
            whole = mounted_model(model, d)
            end = 2.0 * float(response_times(d.mechanics, d.mounting)[-1])
            time = np.linspace(0.0, end, _STEP_SAMPLES)
            voltage = np.where(time > 0.02 * end, model.values["u_rated"], 0.0)
            played = respond(whole, time, voltage)
            live = live_design(whole, (time, voltage, played.displacement), rest=True)
        except InputError as error:
            why = [f"The model does not run in this page. {error}"]
    write_design_page(
        path,
        title=f"Prestress mechanism for {model.name}",
        summary=[*design_words.mechanism_sentences(d), *why],
        live=live,
        tables=(
            design_words.Titled("Mechanism", design_words.mechanism_table(d)),
            design_words.Titled("Poles", design_words.pole_table(d), say("design.acts")),
        ),
        figures=(
            Picture("Root locus", _root_locus(d), say("design.locus")),
            Picture("Step of the rated voltage", _step(d), say("design.linear")),
        ),
    )


def _root_locus(d: MechanismDesign) -> Panel:
    """Poles in the complex plane as the mechanism grows from nothing to four times its size."""
    gains = np.concatenate([[0.0], np.geomspace(1e-4, 4.0, 300)])
    branches = root_locus(d, gains)[1 if d.acts_on == "tip" else 0 :]
    plot = Panel("real part [1000 rad/s]", "imaginary part [1000 rad/s]", 520)
    for k, branch in enumerate(branches.T):
        name = "size 0 to 4 times" if k == 0 else ""
        plot.line(1e-3 * branch.real, 1e-3 * branch.imag, name, colours.NOISE)
    lag = np.array([complex(d.lag_pole)])
    for poles, name, colour, symbol in (
        (d.free_poles, "free stack", colours.BASE, "x"),
        (d.poles, "with the mechanism", colours.EXTENDED, "circle"),
        (lag, "lag, cannot be moved", colours.INK, "square"),
    ):
        plot.marks(1e-3 * poles.real, 1e-3 * poles.imag, name, colour, 10, symbol)
    near = np.concatenate([d.free_poles, d.poles, lag])
    near = near[np.abs(near) < 4.0 * np.abs(d.free_poles).max()]
    reach = 1.15e-3 * max(float(np.abs(near.real).max()), float(np.abs(near.imag).max()))
    left = max(1.3e-3 * float(np.abs(near.real).max()), 0.3 * reach)
    ratio, edge = min(d.reached.damping, 1.0), np.array([0.0, reach])
    for sign, name in ((-1.0, ""), (1.0, f"damping ratio {number(ratio, 3)}")):
        height = sign * np.sqrt(1.0 - ratio**2) * edge
        plot.line(-ratio * edge, height, name, width=1.2, dash="dot", hoverinfo="skip")
    return plot.axes({"range": [-left, 0.06 * left]}, {"range": [-reach, reach]})


def _step(d: MechanismDesign) -> Panel:
    """Answers to a step of the rated voltage, free and mounted, over the final value of each."""
    times = [response_times(d.mechanics, m, 1500) for m in (_FREE, d.mounting)]
    time = np.linspace(0.0, min(float(times[0][-1]), 2.0 * float(times[1][-1])), 3000)
    plot = Panel("time [ms]", "displacement [µm]", 400)
    for mounting, name, colour in (
        (_FREE, "free stack", colours.BASE),
        (d.mounting, "with the mechanism", colours.EXTENDED),
    ):
        x = 1e6 * step_response(d.mechanics, mounting, time).displacement
        plot.line(1e3 * time, x, name, colour, 1.8)
    return plot
