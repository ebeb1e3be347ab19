"""Pictures of results: measured, base and extended, loop, residual, evidence."""

import math
import os
import textwrap
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.files import atomic_path
from psa_casadi.identification.identify import Identification
from psa_casadi.report.plots.narrow_figure import narrow_figure
from psa_casadi.report.words.phrases import in_brackets, length_scale, plain, share_text
from psa_casadi.report.words.series import (
    EXTENDED_COLOUR,
    HELD_OUT_COLOUR,
    MEASURED_COLOUR,
    NOISE_COLOUR,
    FloatArray,
    Series,
    bar_colour,
    kept,
    most_telling,
    series_of,
    series_of_fit,
    spans,
    telling_window,
)
from psa_casadi.report.words.verdict_words import verdict_sentence
from psa_casadi.simulation.simulate import Trajectory

#: What all pictures share.
SIZE_INCHES, DPI = (16.0, 10.0), 100
FONT = 13.0
_STILL_INCHES, _STILL_DPI, _STILL_POINTS = (12.0, 6.4), 80, 4000
#: Room around the plots of a still picture, for labels of any size that they have there.
_STILL_ROOM = {
    "left": 0.075,
    "right": 0.99,
    "top": 0.935,
    "bottom": 0.09,
    "hspace": 0.42,
    "wspace": 0.3,
}


def save_figure(
    diagnosis: Diagnosis,
    path: str | os.PathLike[str],
    *,
    origin: str = "measured",
    narrow: bool = False,
) -> None:
    """Write the picture of a diagnosis as a PNG of 1600 x 1000 points, whole or not at all.

    Of several records it shows the one that the base model misses most. `origin`, "measured" or
    "synthetic", names the record's curve. A `narrow` one has two panels and 720 x 880 points, for
    a phone. Raises InputError when `path` cannot be written to.
    """
    make = narrow_figure if narrow else diagnosis_figure
    with atomic_path(path) as temporary:
        make(diagnosis, origin=origin).savefig(temporary, format="png")


def diagnosis_figure(diagnosis: Diagnosis, *, origin: str = "measured") -> Figure:
    """Return the picture of a diagnosis: records, loop, residual and evidence."""
    series = series_of(diagnosis)
    shown = most_telling(series)
    figure, grid = _sheet()
    _record(figure, grid, shown, origin)
    draw_residual(figure.add_subplot(grid[1, :2]), shown, "measured")
    _evidence(figure.add_subplot(grid[1, 2]), diagnosis)
    figure.suptitle(_title(diagnosis, series, shown, origin), fontsize=FONT + 3)
    return figure


def record_figure(s: Series, *, origin: str = "measured") -> Figure:
    """Return the picture of one record: measured against model, loop and residual."""
    s = _fewer(s)
    figure = Figure(figsize=_STILL_INCHES, dpi=_STILL_DPI)
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3, height_ratios=(1.15, 1.0), **_STILL_ROOM)
    above = grid[0, :2] if s.against else grid[0, :]
    draw_time(figure.add_subplot(above), s, slice(None), origin, None, beside=True)
    if s.against:
        _loop(figure.add_subplot(grid[0, 2]), s, origin, told=True)
    draw_residual(figure.add_subplot(grid[1, :]), s, origin)
    return figure


def fit_figure(found: Identification, *, origin: str = "measured") -> Figure:
    """Return the picture of an identification: the record it misses most, loop and residual."""
    series = series_of_fit(found)
    shown = most_telling(series)
    figure, grid = _sheet()
    _record(figure, grid, shown, origin)
    draw_residual(figure.add_subplot(grid[1, :]), shown, "measured")
    which = f"{origin} record: {shown.name}"
    if len(series) > 1:
        which += f" (the one of {len(series)} that the model misses most)"
    figure.suptitle(which, fontsize=FONT + 3)
    return figure


def trajectory_figure(run: Trajectory) -> Figure:
    """Return the picture of a simulation: displacement over time and over the voltage."""
    return response_figure(run.time, run.voltage, run.displacement)


def response_figure(time: FloatArray, voltage: FloatArray, displacement: FloatArray) -> Figure:
    """Return the picture of a displacement [m] over time [s] and over the voltage [V]."""
    figure = Figure(figsize=(SIZE_INCHES[0], 0.5 * SIZE_INCHES[1]), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    over_time, loop = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
    scale = length_scale(float(np.ptp(displacement)))
    y = scale.factor * displacement
    for axes, x, label in ((over_time, time, "time [s]"), (loop, voltage, "voltage [V]")):
        axes.plot(x, y, color=EXTENDED_COLOUR, linewidth=1.2)
        style(axes, "Displacement" if axes is over_time else "Loop", label, f"[{scale.unit}]")
    return figure


def _fewer(s: Series) -> Series:
    """Return a record with as many samples as a still picture can show, extremes among them."""
    part = kept([s.voltage, s.measured, *(s.residual(c) for c in s.curves)], _STILL_POINTS)
    curves = tuple(replace(c, values=c.values[part]) for c in s.curves)
    columns = {n: getattr(s, n)[part] for n in ("time", "voltage", "measured", "held_out")}
    return replace(s, curves=curves, **columns)


def _sheet() -> tuple[Figure, GridSpec]:
    figure = Figure(figsize=SIZE_INCHES, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    ratios = {"height_ratios": (1.15, 1.0), "width_ratios": (1.0, 1.0, 0.95)}
    return figure, figure.add_gridspec(2, 3, **ratios)


def _record(figure: Figure, grid: GridSpec, s: Series, origin: str) -> None:
    window = telling_window(s)
    draw_time(figure.add_subplot(grid[0, 0]), s, slice(None), origin, window)
    draw_time(figure.add_subplot(grid[0, 1]), s, window, origin, None)
    _loop(figure.add_subplot(grid[0, 2]), s, origin)


def _title(d: Diagnosis, series: tuple[Series, ...], shown: Series, origin: str) -> str:
    which = f"{origin} record: {shown.name}"
    if len(series) > 1:
        which += f" (the one of {len(series)} that the base model misses most)"
    return "\n".join([*textwrap.wrap(verdict_sentence(d), 125), which])


def style(axes: Axes, title: str, x: str, y: str) -> None:
    """Give axes the title, labels and look that all pictures share."""
    axes.set_title(title, fontsize=FONT + 1, loc="left")
    axes.set_xlabel(x, fontsize=FONT)
    axes.set_ylabel(y, fontsize=FONT)
    axes.tick_params(labelsize=FONT - 1)
    axes.grid(visible=True, color="#dddddd", linewidth=0.8)
    axes.set_axisbelow(True)


def _shade_held_out(axes: Axes, s: Series) -> None:
    for index, (first, last) in enumerate(spans(s.held_out)):
        label = "held out" if index == 0 else None
        axes.axvspan(s.time[first], s.time[last], color=HELD_OUT_COLOUR, label=label, zorder=0)


def draw_time(
    axes: Axes, s: Series, part: slice, origin: str, zoom: slice | None, *, beside: bool = False
) -> None:
    """Draw a record or a part of it; its legend stands `beside` the title, or on the curves."""
    scale = s.scale
    time, dense = s.time[part], len(s.time[part]) > 400
    y = scale.factor * s.measured[part]
    if zoom is not None:
        axes.plot(time, y, color=MEASURED_COLOUR, linewidth=2.2, label=origin)
    elif dense:
        axes.plot(time, y, color=NOISE_COLOUR, linewidth=0.7, label=origin)
    else:
        axes.plot(time, y, color=MEASURED_COLOUR, linestyle="none", marker="o", label=origin)
    for curve in s.curves:
        width = 1.3 if zoom is not None else 2.6
        values = scale.factor * curve.values[part]
        axes.plot(time, values, color=curve.colour, linewidth=width, label=curve.label)
    if zoom is not None:
        _shade_held_out(axes, s)
        low, high = s.time[zoom][0], s.time[zoom][-1]
        axes.axvspan(low, high, fill=False, edgecolor="black", linewidth=1.5, zorder=5)
    inside = (
        "In the box, where the error falls most" if len(s.curves) > 1 else "The part in the box"
    )
    title = s.title if len(time) == len(s.time) else inside
    if zoom is not None:
        title = f"{s.title} (box: the part on the right)"
    style(axes, title, "time [s]", s.label)
    axes.margins(x=0.01)
    if beside:
        axes.legend(
            fontsize=FONT - 1.5, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 0.98),
            frameon=False, columnspacing=1.2, handlelength=1.4,
        )  # fmt: skip
    elif zoom is None:
        axes.legend(fontsize=FONT - 1, framealpha=0.85)


def _loop(axes: Axes, s: Series, origin: str, *, told: bool = False) -> None:
    """Draw a record over its voltage, with a legend unless the curves are told beside it."""
    scale = s.scale
    axes.plot(
        s.voltage, scale.factor * s.measured, color=MEASURED_COLOUR, linewidth=2.2, label=origin
    )
    for curve in s.curves:
        values = scale.factor * curve.values
        axes.plot(s.voltage, values, color=curve.colour, linewidth=0.9, label=curve.label)
    style(axes, "Loop", s.against, s.label)
    if not told:
        axes.legend(fontsize=FONT - 1, framealpha=0.85, loc="upper left")


def draw_residual(axes: Axes, s: Series, origin: str) -> None:
    """Draw what the models leave of a record."""
    scale = s.residual_scale
    _shade_held_out(axes, s)
    for curve in s.curves:
        values = scale.factor * s.residual(curve)
        axes.plot(s.time, values, color=curve.colour, linewidth=0.9, label=f"of the {curve.label}")
    band = 2.0 * scale.factor * s.noise
    for edge in (-band, band) if band > 0 else ():
        label = "noise (2 sigma)" if edge > 0 else None
        axes.axhline(edge, color="black", linewidth=1.3, linestyle="--", label=label)
    style(axes, f"Residual: {origin} minus model", "time [s]", in_brackets("residual", scale.unit))
    axes.margins(x=0.005)
    largest = max(float(np.nanmax(np.abs(s.residual(c)))) for c in s.curves) * scale.factor or 1.0
    axes.set_ylim(-1.1 * largest, 1.45 * largest)
    axes.legend(
        fontsize=FONT - 1.5, ncols=4, loc="upper center", columnspacing=1.2, handlelength=1.4
    )


def _evidence(axes: Axes, d: Diagnosis) -> None:
    causes = {c.effect for c in d.causes}
    shown = [c for k, c in enumerate(d.candidates) if k < _MOST_BARS or c.effect in causes]
    rows = shown[::-1]
    values = [c.evidence for c in rows]
    names = [textwrap.fill(plain(c.effect), 22) for c in rows]
    axes.barh(names, values, color=[bar_colour(c, causes) for c in rows])
    axes.set_xscale("symlog", linthresh=10.0)
    largest = max([abs(v) for v in values], default=1.0)
    room = 1e4 if len(causes) > 1 else 100.0
    axes.set_xlim(min([0.0, *values]) * 2.0, room * max(largest, 10.0))
    axes.xaxis.set_major_locator(FixedLocator(_TICKS))
    axes.xaxis.set_major_formatter(FuncFormatter(_power))
    axes.xaxis.set_minor_locator(NullLocator())
    for k, c in enumerate(rows):
        text = f" {share_text(c, d)}"
        axes.annotate(text, (max(c.evidence, 0.0), k), va="center", fontsize=FONT - 1.5)
    every = len(shown) == len(d.candidates)
    count = "" if every else f" ({len(shown)} of {len(d.candidates)})"
    title = f"Evidence, each effect alone{count}"
    style(axes, title, "evidence over the base [ln units]", "")
    axes.grid(visible=False, axis="y")


#: Bars for which there is room.
_MOST_BARS = 9
#: Every second power of ten: the scale is linear up to 10, logarithmic beyond.
_TICKS = [0.0] + [sign * 10.0**k for k in (1, 3, 5, 7, 9) for sign in (-1, 1)]


def _power(value: float, _position: int) -> str:
    if abs(value) < 1e4:
        return f"{value:.0f}"
    return rf"${'-' if value < 0 else ''}10^{{{math.log10(abs(value)):.0f}}}$"
