"""Pictures of results by matplotlib, for files and notebooks."""

import os
import textwrap
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.gridspec import GridSpec

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_path
from psa_casadi.common.units import FloatArray
from psa_casadi.design.linear import Linear
from psa_casadi.diagnosis.remedy import Signature
from psa_casadi.diagnosis.result import Diagnosis, StackDiagnosis
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.result import Identification
from psa_casadi.model.component import Component
from psa_casadi.model.variables import nominal_value
from psa_casadi.posterior.chains import column_of
from psa_casadi.posterior.sample import HDI, Figures, Posterior
from psa_casadi.posterior.task import Block
from psa_casadi.records.signals import Signals
from psa_casadi.report.plots import records
from psa_casadi.report.plots.findings import evidence_plot, signature_plot
from psa_casadi.report.plots.panel import FONT, Panel, draw, sheet, style
from psa_casadi.report.words import colours, phrases
from psa_casadi.report.words.catalogue import TITLES
from psa_casadi.report.words.series import (
    Series,
    most_telling,
    series_of,
    series_of_fit,
    telling_window,
    time_scale,
)
from psa_casadi.report.words.verdict_words import VERDICTS
from psa_casadi.simulation.simulate import Trajectory

Compared = Diagnosis | Identification
Plotted = Compared | Trajectory | Posterior | Signals

#: What all pictures share.
SIZE_INCHES, DPI = (16.0, 10.0), 100
#: Room around the plots of a still picture, for labels of any size that they have there.
_STILL_ROOM = {
    "left": 0.075, "right": 0.99, "top": 0.935, "bottom": 0.09, "hspace": 0.42, "wspace": 0.3,
}  # fmt: skip
#: Samples of a record, bars of effects for which there is room, parameters and their bins.
_MOST_POINTS, _MOST_BARS, _MOST_PARAMETERS, _BINS = 8000, 9, 12, 40
_COLUMNS = 4
#: Outputs or columns of a record in one picture.
_MOST_ROWS = 8
#: A legend above the plot, right of its title, and one over the curves.
_LEGEND = {"fontsize": FONT - 1.5, "ncols": 4, "columnspacing": 1.2, "handlelength": 1.4}
_OVER = _LEGEND | {"loc": "upper center"}
_ABOVE = _LEGEND | {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98), "frameon": False}


def save_figure(
    diagnosis: Diagnosis,
    path: str | os.PathLike[str],
    *,
    origin: str = "measured",
    narrow: bool = False,
) -> None:
    """Write the picture of a diagnosis, 1600 x 1000 points, whole or not at all.

    It is an SVG or a PDF where `path` ends so, else a PNG. Of several records it shows the one that
    the base model misses most. `origin`, "measured" or "synthetic", names the record's curve. A
    `narrow` one has two panels and 720 x 880 points, for a phone. Raises InputError when `path`
    cannot be written to.
    """
    make = narrow_figure if narrow else diagnosis_figure
    write_figure(make(diagnosis, origin=origin), path)


def write_figure(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a picture, whole or not at all: SVG or PDF where `path` ends so, else PNG.

    Raises InputError when `path` cannot be written to.
    """
    ending = Path(path).suffix.lower().removeprefix(".")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=ending if ending in ("svg", "pdf") else "png")


def figure_of(result: Plotted) -> Figure:
    """Return the picture of a result."""
    if isinstance(result, StackDiagnosis):
        return diagnosis_figure(result)
    if isinstance(result, StackIdentification):
        series = series_of_fit(result)
        figure, grid, worst = _sheet(series, "measured", "model")
        _draw_residual(figure.add_subplot(grid[1, :]), worst)
        return figure
    if isinstance(result, Trajectory):
        return response_figure(result.time, result.voltage, result.displacement)
    if isinstance(result, Posterior):
        return posterior_figure(result)
    if isinstance(result, Signals):
        return columns_figure(result)
    series = _series(result)
    worst = most_telling(series)
    same = [s for s in series if s.record == worst.record]
    return outputs_figure(same) if len(same) > 1 else record_figure(worst)


def diagnosis_figure(diagnosis: Diagnosis, *, origin: str = "measured") -> Figure:
    """Return the picture of a diagnosis: records, loop, residual and evidence."""
    series = series_of(diagnosis)
    figure, grid, worst = _sheet(series, origin, "base model", f"{_headline(diagnosis)}; ")
    _draw_residual(figure.add_subplot(grid[1, :2]), worst)
    evidence = figure.add_subplot(grid[1, 2])
    count = len(diagnosis.candidates)
    part = f" ({_MOST_BARS} of {count})" if count > _MOST_BARS else ""
    draw(evidence, evidence_plot(diagnosis, _MOST_BARS), f"Evidence, each effect alone{part}")
    evidence.grid(visible=False, axis="y")
    return figure


def record_figure(s: Series, *, origin: str = "measured") -> Figure:
    """Return the picture of one record: measured against model, loop and residual."""
    figure = sheet((12.0, 6.4), 80, layout=None)
    grid = figure.add_gridspec(2, 3, height_ratios=(1.15, 1.0), **_STILL_ROOM)
    indices = records.samples(s, _MOST_POINTS)
    above = figure.add_subplot(grid[0, :2] if s.against else grid[0, :])
    draw(above, records.measured_plot(s, origin, indices), s.title, legend=_ABOVE)
    above.margins(x=0.01)
    if s.against:
        draw(figure.add_subplot(grid[0, 2]), records.loop_plot(s, origin, indices), "Loop")
    _draw_residual(figure.add_subplot(grid[1, :]), s, origin)
    return figure


def outputs_figure(outputs: Sequence[Series]) -> Figure:
    """Return the picture of several outputs of one record: measured against model, residual."""
    outputs = outputs[:_MOST_ROWS]
    figure = sheet((12.0, 2.6 * len(outputs)), 80)
    grid = figure.subplots(len(outputs), 2, width_ratios=(1.6, 1.0), squeeze=False)
    for s, (left, right) in zip(outputs, grid, strict=True):
        indices = records.samples(s, _MOST_POINTS)
        legend = _ABOVE if s is outputs[0] else None
        draw(left, records.measured_plot(s, "measured", indices), legend=legend)
        left.margins(x=0.01)
        draw(right, records.residual_plot(s, indices), f"Residual of {s.title}")
        right.margins(x=0.01)
    figure.suptitle(f"measured record: {outputs[0].record}", fontsize=FONT)
    return figure


def columns_figure(record: Signals, first: Sequence[str] = ()) -> Figure:
    """Return the picture of all columns of a record over time.

    Those named in `first` come first, where none is named the column to show.
    """
    names = [*dict.fromkeys((*(first or (record.main_column,)), *record.columns))][:_MOST_ROWS]
    figure = sheet((9.0, max(4.5, 2.2 * len(names))), 100)
    for name, axes in zip(names, np.ravel(figure.subplots(len(names), 1)), strict=True):
        _curve(axes, record.time, record.columns[name], name, record.units.get(name, ""))
    return figure


#: Styles by which curves that coincide stay visible; the relative size of a zero response.
_LINES, _NOTHING = ("-", "--", "-.", ":"), 1e-9


def bode_figure(linear: Linear) -> Figure:
    """Return gain and phase of every output over every input of a linearised model.

    A column for each input; frequencies from a decade below the slowest pole to one above the
    fastest.
    """
    sizes = np.abs(linear.poles)[np.abs(linear.poles) > 0] / (2 * np.pi)
    low, high = (float(f(sizes)) if sizes.size else 1.0 for f in (np.min, np.max))
    hertz = np.geomspace(0.1 * low, 10.0 * high, 1500)
    response = linear.response(2 * np.pi * hertz)
    figure = sheet((4.5 * max(2, len(linear.inputs)), 7.0), DPI)
    rows = figure.subplots(2, len(linear.inputs), sharex=True, squeeze=False)
    for k, i in enumerate(linear.inputs):
        for j, o in enumerate(linear.outputs):
            of_one = response[:, j, k]
            size, usual = (nominal_value(v.nominal, {}) for v in (i, o))
            if np.max(np.abs(of_one)) * size > _NOTHING * usual:  # else it is rounding
                style_of = {"color": f"C{j}", "linestyle": _LINES[j % len(_LINES)]}
                label = f"{o.name} [{o.unit}]"
                rows[0, k].loglog(hertz, np.abs(of_one), label=label, **style_of)
                rows[1, k].semilogx(hertz, np.rad2deg(np.unwrap(np.angle(of_one))), **style_of)
        rows[0, k].set_title(f"over {i.name} [{i.unit}]", loc="left")
        rows[0, k].legend(frameon=False, fontsize="small", loc="best")
        rows[1, k].set_xlabel("frequency [Hz]")
    for axes in rows.flat:
        axes.grid(visible=True, which="major", alpha=0.4)
    rows[0, 0].set_ylabel("gain")
    rows[1, 0].set_ylabel("phase [degrees]")
    return figure


def response_figure(time: FloatArray, voltage: FloatArray, displacement: FloatArray) -> Figure:
    """Return the picture of a displacement [m] over time [s] and over the voltage [V]."""
    figure = sheet((SIZE_INCHES[0], 0.5 * SIZE_INCHES[1]), DPI)
    over_time, loop = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
    scale = phrases.length_scale(float(np.ptp(displacement)))
    y, label = scale.factor * displacement, f"[{scale.unit}]"
    draw(over_time, Panel("time [s]", label).line(time, y), "Displacement")
    draw(loop, Panel("voltage [V]", label).line(voltage, y), "Loop")
    return figure


def _sheet(
    series: tuple[Series, ...], origin: str, model: str, head: str = ""
) -> tuple[Figure, GridSpec, Series]:
    """Return a picture with the record that the `model` misses most, and that record.

    In the upper row are the record, its telling window and its loop; `head` begins the title.
    """
    s = most_telling(series)
    figure = sheet(SIZE_INCHES, DPI)
    ratios = {"height_ratios": (1.15, 1.0), "width_ratios": (1.0, 1.0, 0.95)}
    grid = figure.add_gridspec(2, 3, **ratios)
    indices, window = records.samples(s, _MOST_POINTS), telling_window(s)
    whole, part, loop = (figure.add_subplot(grid[0, k]) for k in range(3))
    draw(
        whole, records.measured_plot(s, origin, indices), f"{s.title} (box: the part on the right)"
    )
    ends = s.time_scale.factor * s.time[window][[0, -1]]
    whole.axvspan(*ends, fill=False, edgecolor="black", linewidth=1.5, zorder=5)
    whole.margins(x=0.01)
    inside = (
        "In the box, where the error falls most" if len(s.curves) > 1 else "The part in the box"
    )
    draw(part, records.zoom_plot(s, origin, _MOST_POINTS), inside, legend={})
    draw(loop, records.loop_plot(s, origin, indices), "Loop", legend={"loc": "upper left"})
    which = f"{origin} record: {s.name}"
    if len(series) > 1:
        which += f" (of {len(series)}, the largest error of the {model})"
    figure.suptitle(_one_line(head + which, _TITLE), fontsize=FONT + 3)
    return figure, grid, s


def _draw_residual(axes: Axes, s: Series, origin: str = "measured") -> None:
    """Draw what the models leave of a record, with room for the legend above."""
    indices = records.samples(s, _MOST_POINTS)
    draw(axes, records.residual_plot(s, indices), f"Residual: {origin} minus model", legend=_OVER)
    axes.margins(x=0.005)
    largest = max(float(np.nanmax(np.abs(s.residual(c)))) for c in s.curves)
    largest = s.residual_scale.factor * largest or 1.0
    axes.set_ylim(-1.1 * largest, 1.45 * largest)


def narrow_figure(diagnosis: Diagnosis, *, origin: str = "measured") -> Figure:
    """Return two panels: the residual over a stretch of time, and the held-out errors as bars.

    At half its 720 x 880 points, the width of a phone, letters are still large enough.
    """
    figure, font = sheet((3.6, 4.4), 200), 9.0
    above, below = figure.subplots(2, 1, height_ratios=(2.2, 1.0))
    s = most_telling(series_of(diagnosis))
    window = telling_window(s)
    more = 3 * (window.stop - window.start)
    part = slice(max(0, window.start - more), min(len(s.time), window.stop + more))
    plot = records.residual_plot(s, part)
    plot.layout["shapes"] = []  # a shaded band is plainer than dashes
    noise = 2.0 * s.residual_scale.factor * s.noise
    above.axhspan(-noise, noise, color=colours.HELD_OUT, label="noise, 2 sigma")
    draw(above, plot, f"{origin.capitalize()} minus simulated", font=font)
    above.locator_params(axis="x", nbins=5)
    above.margins(x=0.0)
    low, high = above.get_ylim()
    above.set_ylim(low, high + 0.32 * (high - low))  # for the legend
    above.legend(fontsize=font - 0.5, loc="upper left", ncols=2, columnspacing=0.9,
                 handlelength=1.2, framealpha=0.0)  # fmt: skip
    below.set_title("Error on held-out samples, rms", fontsize=font + 1, loc="left")
    e = next(e for e in diagnosis.errors if e.output == s.quantity)
    rows = [("base model", colours.BASE, e.base)]
    if phrases.added(diagnosis):
        rows.append(("extended", colours.EXTENDED, e.extended))
    rows.append(("noise", colours.NOISE, e.noise))
    largest = max(rms for *_, rms in rows)
    scale = phrases.prefixed_scale(largest, e.unit)
    for k, (_, colour, rms) in enumerate(rows):
        below.barh(k, rms, color=colour, height=0.7)
        below.annotate(f" {scale.text(rms)}", (rms, k), va="center", fontsize=font)
    below.axvline(e.noise, color="black", linestyle="--", linewidth=1.0)
    below.set_yticks(range(len(rows)), [name for name, *_ in rows], fontsize=font)
    below.set(xlim=(0.0, 1.3 * largest), xticks=[])
    below.invert_yaxis()
    below.spines[["top", "right", "bottom"]].set_visible(False)
    figure.suptitle(_one_line(_headline(diagnosis), _NARROW), fontsize=font + 2)
    return figure


def _headline(diagnosis: Diagnosis) -> str:
    """Return the verdict and the causes."""
    causes = phrases.listing([phrases.plain(c.effect) for c in diagnosis.causes])
    verdict = VERDICTS[diagnosis.verdict].capitalize()
    return f"{verdict}: {causes}" if causes else verdict


#: Letters of a title in one line of a picture, and of a narrow one.
_TITLE, _NARROW = 110, 44


def _one_line(title: str, most: int) -> str:
    return textwrap.shorten(title, most, placeholder=" ...")


def one_output(result: Plotted, axes: Axes | None, output: str | None) -> Figure:
    """Return the figure of the axes on which one quantity of a result was drawn.

    Without an `output` it is the main one. Raises InputError for one that the result does not have.
    """
    if axes is None:
        axes = sheet((9.0, 4.5), 100).add_subplot()
    if isinstance(result, Trajectory):
        columns = {"voltage": result.voltage, **result.states, **result.outputs}
        name = _chosen(output, columns, result.sensor_output)
        _curve(axes, result.time, columns[name], name, result.units.get(name, ""))
    elif isinstance(result, Signals):
        name = _chosen(output, result.columns, result.main_column)
        _curve(axes, result.time, result.columns[name], name, result.units.get(name, ""))
    elif isinstance(result, Posterior):
        by_name = {f.name: f for f in result.figures}
        _draw_parameter(axes, result, by_name[_chosen(output, by_name, next(iter(by_name)))])
    else:
        series = _series(result)
        quantities = dict.fromkeys(s.quantity for s in series)
        name = _chosen(output, [*quantities, "residual"], most_telling(series).quantity)
        if name == "residual":
            _draw_residual(axes, most_telling(series))
        else:
            worst = most_telling([s for s in series if s.quantity == name])
            whole = replace(worst, held_out=np.zeros(len(worst.time), dtype=bool))
            draw(
                axes, records.measured_plot(whole, "measured", slice(None)), worst.title, legend={}
            )
            axes.margins(x=0.01)
    parent: Figure | SubFigure = axes.figure
    return parent if isinstance(parent, Figure) else parent.figure


def _series(result: Compared) -> tuple[Series, ...]:
    return series_of(result) if isinstance(result, Diagnosis) else series_of_fit(result)


def _chosen(output: str | None, there: Collection[str], usual: str) -> str:
    if output is None:
        return usual
    if output not in there:
        raise InputError(f"There is no output '{output}' to plot; there are {', '.join(there)}.")
    return output


def _curve(axes: Axes, time: FloatArray, values: FloatArray, name: str, unit: str) -> None:
    """Draw values in their SI unit over time, in a handy one."""
    size = float(np.nanmax(np.abs(values), initial=0.0))
    scale = phrases.any_scale(size, unit)
    label = phrases.in_brackets(name, scale.unit)
    draw(axes, Panel("time [s]", label).line(time, scale.factor * values, name))


def posterior_figure(posterior: Posterior) -> Figure:
    """Return the predictive bands for the record with the largest misfit, and the parameters."""
    block = _missed_most(posterior)
    figures = posterior.figures[:_MOST_PARAMETERS]
    rows = -(-len(figures) // _COLUMNS)
    figure = sheet((SIZE_INCHES[0], 4.6 + 2.6 * rows), DPI)
    parts = figure.subfigures(2, 1, height_ratios=(4.6, 2.6 * rows), squeeze=False)
    before, after = parts[0, 0].subplots(1, 2)
    _draw_predicted(before, posterior, block, "prior")
    _draw_predicted(after, posterior, block, "posterior")
    axes = np.atleast_1d(parts[1, 0].subplots(rows, min(_COLUMNS, len(figures)))).ravel()
    for each, f in zip(axes, figures, strict=False):
        _draw_parameter(each, posterior, f)
    for each in axes[len(figures) :]:
        each.set_axis_off()
    name = posterior.task.experiments[block.record].record.name
    more = len(posterior.figures) - len(figures)
    rest = f"; {more} more parameters are in the table" if more else ""
    figure.suptitle(
        f"Prior and posterior of {posterior.model.name}, record {name}{rest}", fontsize=FONT
    )
    return figure


def _missed_most(posterior: Posterior) -> Block:
    """Return the output of a record that the model misses most, over the output's range."""

    def share(b: Block) -> float:
        parts = [e.measured(b.channel)[e.at(b.channel)] for e in posterior.task.experiments]
        return b.level / max(float(np.ptp(np.concatenate(parts))), 1e-300)

    return max(posterior.task.density.blocks, key=share)


def _band(posterior: Posterior, group: str, b: Block) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the ends of the band that holds 94 % of what is predicted, and the median."""
    draws = posterior.tree[group][column_of(posterior.task, b)].to_numpy()
    draws = draws.reshape(-1, draws.shape[-1])
    low, high = 0.5 * (1.0 - HDI), 0.5 * (1.0 + HDI)
    ends: FloatArray = np.quantile(draws, [low, high, 0.5], axis=0)
    return ends[0], ends[1], ends[2]


def _draw_predicted(axes: Axes, posterior: Posterior, block: Block, group: str) -> None:
    """Draw a record in the band that prior or posterior predict, of the posterior less its median.

    The prior's is cut where it leaves the record too far behind.
    """
    if not posterior.tree[f"{group}_predictive"].sizes["draw"]:
        style(axes, "No draw of the prior can be simulated", "time [s]", "")
        return
    e, is_prior = posterior.task.experiments[block.record], group == "prior"
    time, y, name = e.record.time, e.measured(block.channel), "difference"
    low, high, middle = _band(posterior, f"{group}_predictive", block)
    title, look = "Posterior predictive, less its median", (colours.EXTENDED, 0.4, 3)
    if is_prior:
        title, look = "Prior predictive", (colours.BASE, 0.3, 1)
        middle, name = np.zeros_like(y), posterior.task.channel(block).column
    ends = np.array([np.nanmin(y), np.nanmax(y)])
    size = 3.0 * np.ptp(ends) if is_prior else np.nanmax(np.abs(y - middle))
    scale = phrases.any_scale(float(size), posterior.task.channel(block).unit)
    low, high, measured = (scale.factor * (v - middle) for v in (low, high, y))
    if not is_prior:  # measured comes first in its legend
        axes.plot(time, measured, color=colours.MEASURED, linewidth=0.8, label="measured")
    colour, alpha, order = look
    band = f"{group}, {100.0 * HDI:.0f} %"
    axes.fill_between(time, low, high, color=colour, alpha=alpha, label=band, zorder=order)
    if is_prior:
        axes.plot(time, measured, color=colours.MEASURED, linewidth=1.0, label="measured")
        axes.set_ylim(*(scale.factor * (np.mean(ends) + np.array([-1.5, 1.5]) * np.ptp(ends))))
    style(axes, title, "time [s]", phrases.in_brackets(name, scale.unit))
    axes.legend(fontsize=FONT - 1, loc="upper right")


def _draw_parameter(axes: Axes, posterior: Posterior, f: Figures) -> None:
    """Draw the posterior of a parameter, and its prior."""
    in_unit = partial(phrases.in_display_unit, posterior.model, f.name)
    values, before = (
        np.array(in_unit(*posterior.tree[group][f.name].to_numpy().ravel())[1])
        for group in ("posterior", "prior")
    )
    unit, (mean, *interval) = in_unit(f.mean, f.low, f.high)
    axes.hist(values, bins=_BINS, density=True, color=colours.EXTENDED, alpha=0.7)
    low, high = axes.get_xlim()
    inside = before[(before >= low) & (before <= high)]
    if len(inside) >= 0.2 * max(len(before), 1):
        weights = np.full(len(inside), _BINS / (2.0 * (high - low) * len(before)))
        axes.hist(inside, bins=_BINS // 2, weights=weights, histtype="step", color=colours.BASE)
    for end in interval:
        axes.axvline(end, color=colours.NOISE, linestyle="--", linewidth=1.0)
    title = f"{f.name} = {phrases.number(mean, 4)}"
    style(axes, title, phrases.in_brackets(f.name, unit), "")
    axes.set_yticks([])


def save_signature(effect: Component, signature: Signature, path: str | os.PathLike[str]) -> None:
    """Write the picture of an effect's signature, 1300 x 620 points, whole or not at all.

    It is an SVG or a PDF where `path` ends so, else a PNG. Left the difference over time above the
    voltage's ghost, right against its most telling coordinate. Raises InputError when `path`
    cannot be written to.
    """
    figure = sheet((13.0, 6.2), DPI)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    scale = phrases.length_scale(float(np.max(np.abs(signature.difference))))
    clock = time_scale(float(signature.time[-1]))
    time = clock.factor * signature.time
    behind = left.twinx()
    behind.fill_between(time, signature.voltage, color=colours.NOISE, alpha=0.18, linewidth=0)
    behind.set_ylabel("voltage [V] (grey)", fontsize=FONT, color=colours.NOISE)
    behind.tick_params(labelsize=FONT - 1, colors=colours.NOISE)
    left.set_zorder(behind.get_zorder() + 1)
    left.patch.set_visible(False)
    added_over_time = Panel(f"time [{clock.unit}]", f"difference [{scale.unit}]")
    added_over_time.line(time, scale.factor * signature.difference)
    draw(left, added_over_time, "What the effect adds, over time")
    left.margins(x=0.01)
    view = signature.telling
    title = f"{TITLES[view.name]}: explains {phrases.percent(view.share)} of it"
    if view.name == "spectrum":
        title = f"Spectrum: {phrases.percent(view.share)} of it in one peak"
    legend: dict[str, str] | None = None if view.name == "spectrum" else {}
    draw(right, signature_plot(signature), _one_line(title, 56), legend=legend)
    size = phrases.with_unit(phrases.number(signature.size), signature.unit)
    what = f"{phrases.plain(effect.name)}: {signature.stack} with {signature.gain} = {size}"
    figure.suptitle(_one_line(what, _TITLE), fontsize=FONT + 1)
    write_figure(figure, path)


def size_sentence(signature: Signature) -> str:
    """Say on what stack the signature is simulated, and how large the effect is."""
    size = phrases.with_unit(phrases.number(signature.size), signature.unit)
    largest = float(np.max(np.abs(signature.difference))) / signature.stroke
    return (
        f"Simulated on the stack {signature.stack} with {signature.gain} = {size}: at most"
        f" {phrases.number(100.0 * largest, 2)} % of the stroke, offset and slope re-fitted."
    )
