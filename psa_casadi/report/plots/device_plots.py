"""Plots over devices: parameters with intervals, error budgets, errors over time and voltage."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from psa_casadi.common.units import FloatArray, convert
from psa_casadi.model.variables import NORMAL_95
from psa_casadi.population.population import Difference, Finding, Population, Spread, display_unit
from psa_casadi.population.statistics import mixed_regression
from psa_casadi.report.plots.panel import Panel
from psa_casadi.report.words import colours
from psa_casadi.report.words.phrases import handy_scale, in_brackets, length_scale, plain
from psa_casadi.report.words.series import time_scale

#: Colours of devices side by side, with dashes and symbols where there are more of them.
_COLOURS = (colours.EXTENDED, colours.BASE, colours.WEAK, colours.BOUND, colours.MEASURED)
_DASHES = ("solid", "dash", "dot", "dashdot")
_SYMBOLS = ("circle", "square", "diamond", "triangle-up")
_HEIGHT = 340
#: Devices that stand out and are named in a picture, those furthest out.
_MOST_NAMED = 6
#: Devices whose names stand along an axis, and letters of a name there.
_MOST_TICKS, _LONGEST = 12, 16


def _look(k: int) -> tuple[str, str, str]:
    """Return colour, dash and symbol of the device at place k."""
    n = len(_COLOURS)
    return _COLOURS[k % n], _DASHES[k // n % len(_DASHES)], _SYMBOLS[k // n % len(_SYMBOLS)]


def _bar(value: FloatArray, low: FloatArray, high: FloatArray, colour: str) -> dict[str, Any]:
    """Return the error bar of an interval."""
    return {"type": "data", "symmetric": False, "array": high - value, "arrayminus": value - low,
            "color": colour}  # fmt: skip


def difference_plot(findings: Sequence[Finding], rows: Sequence[Difference]) -> Panel:
    """Every shared parameter over the weighted mean of the devices [%], with intervals."""
    height = 150 + max(34, 16 * len(findings)) * len(rows)
    plot = Panel("from the mean of the devices [%]", height=height)
    names = [f"{d.estimates.name}{' *' if d.differs else ''}" for d in rows]
    room = 0.7 / max(1, len(findings))
    for k, f in enumerate(findings):
        points = []
        for i, d in enumerate(rows):
            e = d.estimates
            if k in e.places:
                j = e.places.index(k)
                mean = e.value(float(mixed_regression(e.theta, e.errors).b[0]))
                ends = e.theta[j] + NORMAL_95 * e.errors[j] * np.array([0.0, -1.0, 1.0])
                percents = (100.0 * (e.value(float(t)) - mean) / (abs(mean) or 1.0) for t in ends)
                points.append((i, *percents))
        if not points:
            continue
        place, value, low, high = np.array(points).T
        colour, _, symbol = _look(k)
        plot.marks(
            value, place + room * (k - 0.5 * (len(findings) - 1)), f.device, colour, 8, symbol,
            error_x={**_bar(value, low, high, colour), "thickness": 1.6, "width": 3},
            hovertemplate="%{x:.3g} %<extra></extra>",
        )  # fmt: skip
    plot.upright(0.0, colour=colours.NOISE, width=1.0)
    rows_axis = {"tickvals": list(range(len(names))), "ticktext": names, "automargin": True,
                 "autorange": "reversed", "showgrid": False}  # fmt: skip
    return plot.axes(y=rows_axis, margin={"l": 20, "r": 10, "t": 46, "b": 46})


def budget_plot(findings: Sequence[Finding]) -> Panel:
    """Shares of the base model's held-out error that each cause removes, one bar for a device."""
    diagnosed = [f for f in findings if f.budget]
    title = "removed of the error's power above the noise [%]"
    plot = Panel(
        title, height=130 + 34 * len(diagnosed), barmode="group" if len(diagnosed) < 3 else "stack"
    )
    for k, what in enumerate(dict.fromkeys(s.what for f in diagnosed for s in f.budget)):
        shares = [next((s.share for s in f.budget if s.what == what), 0.0) for f in diagnosed]
        plot.bars(
            [100.0 * max(0.0, s) for s in shares], [f.device for f in diagnosed], plain(what),
            _look(k)[0], width=0.6, hovertemplate="%{x:.0f} %<extra></extra>",
        )  # fmt: skip
    named = {"autorange": "reversed", "automargin": True, "showgrid": False, "type": "category"}
    return plot.axes(y=named)


def error_plots(findings: Sequence[Finding]) -> tuple[Panel, Panel, Panel]:
    """Return measured less model over time and over voltage, and the loops, of every device."""
    traced = [
        (k, f.device, *np.array([t.time, t.voltage, t.measured, t.model]))
        for k, f in enumerate(findings)
        if (t := f.trace) is not None
    ]
    clock = time_scale(max(time[-1] - time[0] for _, _, time, *_ in traced))
    small = length_scale(max(float(np.nanmax(np.abs(x - y))) for *_, x, y in traced))
    length = handy_scale(max(float(np.nanmax(x) - np.nanmin(x)) for *_, x, _ in traced))
    error = f"measured less model [{small.unit}]"
    plots = (
        Panel(f"time [{clock.unit}]", error, _HEIGHT),
        Panel("voltage [V]", error, _HEIGHT),
        Panel("voltage [V]", f"measured displacement [{length.unit}]", _HEIGHT),
    )
    for k, device, time, voltage, x, y in traced:
        residual, stroke = small.factor * (x - y), length.factor * (x - np.nanmin(x))
        colour, dash, _ = _look(k)
        clocked = clock.factor * (time - time[0])
        curves = ((clocked, residual), (voltage, residual), (voltage, stroke))
        for plot, (along, up) in zip(plots, curves, strict=True):
            plot.line(along, up, device, colour, 1.3, dash).axes(y={"automargin": True})
    return plots


def spread_plot(p: Population, s: Spread) -> Panel:
    """A parameter over the devices in the order of its values, with intervals and the others' band.

    Devices that stand out, as the population has them, have another colour and symbol, and their
    names.
    """
    order = np.argsort(s.estimates.theta)
    plot, in_unit = _over_devices(p, s, np.arange(order.size), order, "devices, in order")
    names = [p.findings[s.estimates.places[k]].device for k in order]
    if len(names) <= _MOST_TICKS:
        places = list(range(len(names)))
        ticks = [n if len(n) <= _LONGEST else f"{n[: _LONGEST - 3]}..." for n in names]
    else:
        every = math.ceil(len(names) / _MOST_TICKS)
        places = list(range(every - 1, len(names), every))
        ticks = [str(k + 1) for k in places]
    plot.axes({"tickvals": places, "ticktext": ticks, "automargin": True})
    mean = float(s.common.b[0])
    reach = NORMAL_95 * s.common.tau
    middle, low, high = (float(v) for v in in_unit(np.array([mean, mean - reach, mean + reach])))
    return plot.across(middle, dash="solid", width=1.0).across(low, high, width=1.0)


def drift_plot(p: Population, s: Spread) -> Panel:
    """A parameter over the date of the devices."""
    order = np.arange(len(s.estimates.places))
    days = [d for k in s.estimates.places if (d := p.findings[k].day) is not None]
    plot, _ = _over_devices(p, s, np.array([d.isoformat() for d in days]), order, "date")
    return plot.axes({"type": "date"})


def _over_devices(
    p: Population, s: Spread, x: Any, order: Any, title: str
) -> tuple[Panel, Callable[[FloatArray], FloatArray]]:
    """Return the plot, and what shows a parameter's coordinate in its unit."""
    e = s.estimates
    unit = display_unit(e.name, e.unit)

    def in_unit(theta: FloatArray) -> FloatArray:
        return np.array([float(convert(e.value(float(t)), e.unit, unit)) for t in theta])

    half = NORMAL_95 * e.errors[order]
    middle, low, high = (in_unit(e.theta[order] + sign * half) for sign in (0.0, -1.0, 1.0))
    plot = Panel(title, in_brackets(e.name, unit if unit != "1" else ""), _HEIGHT)
    devices = np.array([p.findings[e.places[k]].device for k in order], dtype=object)
    apart = {o.device: abs(o.z) for o in p.outliers if o.parameter == e.name}
    named = set(sorted(apart, key=apart.__getitem__, reverse=True)[:_MOST_NAMED])
    far = np.array([d in apart for d in devices])
    # names lie towards the middle of the plot
    sides = np.where(np.arange(order.size) < 0.5 * order.size, "middle right", "middle left")
    for name, which, colour, symbol in (
        ("belongs to the others", ~far, colours.EXTENDED, "circle"),
        ("outlier", far, colours.BASE, "diamond"),
    ):
        if not which.any():
            continue
        bar = _bar(middle[which], low[which], high[which], colour)
        plot.marks(
            x[which], middle[which], name, colour, 7, symbol,
            error_y={**bar, "thickness": 1.2, "width": 0},
            text=[f" {d} " if d in named else "" for d in devices[which]],
            textposition=sides[which].tolist(), cliponaxis=False,
            hovertext=devices[which].tolist(),
            hovertemplate="%{hovertext}: %{y:.4g}<extra></extra>",
        )  # fmt: skip
        if which is far:
            plot.data[-1]["mode"] = "markers+text"
    return plot.axes({"showgrid": False}, {"automargin": True}), in_unit
