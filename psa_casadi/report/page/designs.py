"""Pages of designs: an input, an experiment, a prestress mechanism."""

import os
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from psa_casadi.design.experiment.experiment import Informative, Separated
from psa_casadi.design.mechanism.loop import Mounting, response_times, step_response
from psa_casadi.design.mechanism.mechanism import MechanismDesign, mounted_model, root_locus
from psa_casadi.design.tracking.inversion import CorrectedInput, InvertedInput
from psa_casadi.design.tracking.minimum_time import QuickMove
from psa_casadi.design.tracking.targets import AmplifierLimits, Response, Target, respond
from psa_casadi.design.tracking.tracking import TrackedInput
from psa_casadi.errors import InputError
from psa_casadi.files import atomic_write
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.report.page.document import Picture, render
from psa_casadi.report.page.live import LiveModel, live_design
from psa_casadi.report.plots.figures import record_figure, response_figure
from psa_casadi.report.plots.panel import INK, Panel
from psa_casadi.report.words.design_words import (
    Titled,
    design_tables,
    mechanism_sentences,
    mechanism_table,
    pole_table,
    sentences,
)
from psa_casadi.report.words.phrases import length_scale, number, plain
from psa_casadi.report.words.series import (
    BASE_COLOUR,
    EXTENDED_COLOUR,
    MEASURED_COLOUR,
    NOISE_COLOUR,
    Curve,
    FloatArray,
    Series,
)

_COLOURS = (EXTENDED_COLOUR, BASE_COLOUR, MEASURED_COLOUR)
_HEIGHT, _MOST_POINTS = 360, 4000
#: Time shown of a move and its hold at first, over the move's; the rest is behind the zoom.
_SHOWN = 2.5
_FREE = Mounting(0.0, 0.0, 0.0)
#: Samples of the step that the page's model runs on.
_STEP_SAMPLES = 3000

#: A curve over time: its name, values, colour and width.
Line = tuple[str, FloatArray, str, float]


def write_design_page(
    path: str | os.PathLike[str],
    *,
    title: str,
    summary: Sequence[str],
    tables: Sequence[Titled] = (),
    figures: Sequence[Picture] = (),
    badges: Sequence[str] = (),
    live: LiveModel | None = None,
) -> None:
    """Write the page of a design, whole or not at all.

    The first sentence of `summary` is the result, the others follow as a list; then come the
    figures and the tables with their notes. `badges` are short marks under the title, such as
    "2,000 samples". `live` is a model that runs in the page on the designed voltage.

    Raises InputError when `path` cannot be written to.
    """
    page = render(
        "design.html",
        title,
        tuple(badges),
        summary=summary,
        still=None if live is None else _still(live),
        figures=figures,
        live=live,
        tables=tables,
    )
    atomic_write(path, page)


def _still(live: LiveModel) -> tuple[Figure, str]:
    """Return what is seen of a design where no script runs: beside its path, where it has one."""
    r = live.records[0]
    time, voltage, model = r.time, r.inputs["voltage"], r.measured - r.residual
    if not r.residual.any():
        return response_figure(time, voltage, model), "The model's answer to the voltage"
    curves = (Curve("model", EXTENDED_COLOUR, model),)
    s = Series(r.name, time, voltage, r.measured, curves, r.held_out, noise=0.0, counts=False)
    return record_figure(s, origin=live.aim), f"The {live.aim} and the model"


# Inputs


def tracking_pictures(found: TrackedInput, uncompensated: FloatArray) -> list[Picture]:
    """Return path and response, the error, and the voltage with its limits."""
    t, wanted = found.target.time, found.target.displacement
    share = 100.0 / found.target.span
    paths = _path_and("designed, simulated", found.target, found.response.displacement)
    paths.append(("uncompensated, simulated", 1e6 * uncompensated, BASE_COLOUR, 1.4))
    error = share * (found.response.displacement - wanted)
    errors: list[Line] = [("simulated", error, EXTENDED_COLOUR, 1.4)]
    if found.by_program:
        predicted = share * (found.predicted - wanted)
        errors.append(("predicted by the program", predicted, BASE_COLOUR, 1.2))
    return [
        Picture("Path and response", _over_time(t, paths, "displacement [µm]")),
        Picture("Error of the designed input", _over_time(t, errors, "error [% of range]")),
        _voltage(found.response, found.limits),
    ]


def inversion_pictures(found: InvertedInput, limits: AmplifierLimits) -> list[Picture]:
    """Return path and response of an inverted input, and the voltage with its limits."""
    shown = _path_and("inverted, simulated", found.target, found.response.displacement)
    plot = _over_time(found.target.time, shown, "displacement [µm]")
    return [Picture("Path and response", plot), _voltage(found.response, limits)]


def trial_pictures(found: CorrectedInput) -> list[Picture]:
    """Return path and measured trial, and the voltages played and corrected."""
    shown = _path_and("trial, measured", found.target, found.measured)
    plot = _over_time(found.target.time, shown, "displacement [µm]")
    played: Line = ("played in the trial", found.played, BASE_COLOUR, 1.4)
    return [Picture("Path and trial", plot), _voltage(found.response, found.limits, played)]


def move_pictures(found: QuickMove) -> list[Picture]:
    """Return the displacement of a quickest move with its hold, and the voltage."""
    shown: Line = ("simulated", 1e6 * found.response.displacement, EXTENDED_COLOUR, 1.8)
    plot = _over_time(found.response.time, [shown], "displacement [µm]").across(1e6 * found.end)
    note = "Dashed: the position to reach. The voltage holds its last value behind the move."
    pictures = [Picture("Move and hold", plot, note), _voltage(found.response, found.limits)]
    for picture in pictures:
        picture.panel.axes({"range": [0.0, _SHOWN * 1e3 * found.move_time]})
    return pictures


def _over_time(time: FloatArray, shown: Sequence[Line], label: str) -> Panel:
    """Return curves over time [ms]."""
    plot, part = (
        Panel("time [ms]", label, _HEIGHT),
        slice(None, None, max(1, len(time) // _MOST_POINTS)),
    )
    for name, values, colour, width in shown:
        plot.line(1e3 * time[part], values[part], name, colour, width)
    return plot


def _path_and(name: str, target: Target, displacement: FloatArray) -> list[Line]:
    return [
        ("path", 1e6 * target.displacement, MEASURED_COLOUR, 3.0),
        (name, 1e6 * displacement, EXTENDED_COLOUR, 1.4),
    ]


def _voltage(response: Response, limits: AmplifierLimits, *others: Line) -> Picture:
    """Return the voltage over time with its limits, and other voltages beside it."""
    shown: list[Line] = [*others, ("designed", response.voltage, EXTENDED_COLOUR, 1.6)]
    bounds = [v for v in (limits.min_voltage, limits.max_voltage) if np.isfinite(v)]
    return Picture("Voltage", _over_time(response.time, shown, "voltage [V]").across(*bounds))


# Experiments


def write_experiment_page(
    path: str | os.PathLike[str],
    design: Separated | Informative,
    model: Model,
    responses: Mapping[str, FloatArray],
    live: LiveModel | None = None,
) -> None:
    """Write the page of a designed experiment; `responses` are what each rival predicts [m].

    `live` is the model that runs in the page on the designed voltage. Raises InputError where the
    page cannot be written.
    """
    several = isinstance(design, Separated)
    write_design_page(
        path,
        title="Experiment that separates effects" if several else "Experiment for the parameters",
        summary=sentences(design, model.values.get("C_p")),
        tables=design_tables(design, model),
        figures=(_applied(design.record), _responses(design.record, responses)),
        badges=(f"{design.record.n} samples", f"{number(design.limits.duration)} s"),
        live=live,
    )


def _applied(record: Record) -> Picture:
    plot = Panel("time [s]", "voltage [V]", 320).line(
        record.time, record.voltage, colour=MEASURED_COLOUR
    )
    return Picture("The voltage to apply", plot)


def _responses(record: Record, responses: Mapping[str, FloatArray]) -> Picture:
    """Return the plot of predicted displacements, less their mean where there are several."""
    several = len(responses) > 1
    middle = np.mean(list(responses.values()), axis=0) if several else np.zeros(record.n)
    shown = {n: y - middle for n, y in responses.items()}
    scale = length_scale(max(float(np.max(np.abs(y))) for y in shown.values()))
    plot = Panel("time [s]", f"displacement [{scale.unit}]", 340)
    for (name, y), colour in zip(shown.items(), _COLOURS * len(shown), strict=False):
        plot.line(record.time, scale.factor * y, plain(name), colour)
    caption = "Where the predictions part" if several else "Predicted displacement"
    note = (
        "Each rival's prediction less the mean of all, before it is fitted again; the design"
        " maximises what such a fit leaves."
    )
    return Picture(caption, plot, note if several else "")


# Mechanisms


def write_mechanism_page(
    d: MechanismDesign, path: str | os.PathLike[str], model: Model, *, still: bool = False
) -> None:
    """Write the design as an HTML page; `model` is the stack.

    Unless it is to be `still`, the stack with its mechanism runs in the page. Raises InputError if
    it cannot be written.
    """
    why, live = [], None
    try:
        live = None if still else _mounted(d, model)
    except InputError as error:
        why = [f"The model does not run in this page. {error}"]
    acts = (
        "A mechanism acts as feedback around the mechanics (position, velocity and acceleration"
        " by its stiffness, damping and mass); the lag stands before the loop."
    )
    locus = "The poles as the whole mechanism grows; those beyond the picture are in the table."
    linear = "Linear answer in closed form, with the lag and the amplifier, without hysteresis."
    write_design_page(
        path,
        title=f"Prestress mechanism for {model.name}",
        summary=[*mechanism_sentences(d), *why],
        live=live,
        tables=(Titled("Mechanism", mechanism_table(d)), Titled("Poles", pole_table(d), acts)),
        figures=(
            Picture("Root locus", _root_locus(d), locus),
            Picture("Step of the rated voltage", _step(d), linear),
        ),
    )


def _mounted(d: MechanismDesign, model: Model) -> LiveModel:
    """Begin what lets the mounted stack run in the page, on a step of the rated voltage."""
    whole = mounted_model(model, d)
    end = 2.0 * float(response_times(d.mechanics, d.mounting)[-1])
    time = np.linspace(0.0, end, _STEP_SAMPLES)
    voltage = np.where(time > 0.02 * end, model.values["u_rated"], 0.0)
    played = respond(whole, time, voltage)
    return live_design(whole, (time, voltage, played.displacement), rest=True)


def _root_locus(d: MechanismDesign) -> Panel:
    """Poles in the complex plane as the mechanism grows from nothing to four times its size."""
    gains = np.concatenate([[0.0], np.geomspace(1e-4, 4.0, 300)])
    branches = root_locus(d, gains)[1 if d.acts_on == "tip" else 0 :]
    plot = Panel("real part [1000 rad/s]", "imaginary part [1000 rad/s]", 520)
    for k, branch in enumerate(branches.T):
        name = "size 0 to 4 times" if k == 0 else ""
        plot.line(1e-3 * branch.real, 1e-3 * branch.imag, name, NOISE_COLOUR)
    lag = np.array([complex(d.lag_pole)])
    for poles, name, colour, symbol in (
        (d.free_poles, "free stack", BASE_COLOUR, "x"),
        (d.poles, "with the mechanism", EXTENDED_COLOUR, "circle"),
        (lag, "lag, cannot be moved", INK, "square"),
    ):
        plot.marks(1e-3 * poles.real, 1e-3 * poles.imag, name, colour, 10, symbol)
    shown = np.concatenate([d.free_poles, d.poles, lag])
    shown = shown[np.abs(shown) < 4.0 * np.abs(d.free_poles).max()]
    reach = 1.15e-3 * max(float(np.abs(shown.real).max()), float(np.abs(shown.imag).max()))
    left = max(1.3e-3 * float(np.abs(shown.real).max()), 0.3 * reach)
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
        (_FREE, "free stack", BASE_COLOUR),
        (d.mounting, "with the mechanism", EXTENDED_COLOUR),
    ):
        x = 1e6 * step_response(d.mechanics, mounting, time).displacement
        plot.line(1e3 * time, x, name, colour, 1.8)
    return plot
