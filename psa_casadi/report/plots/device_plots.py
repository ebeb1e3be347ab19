"""Plots over devices: parameters with intervals, error budgets, errors over time and voltage."""

from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go

from psa_casadi.characters import plain as carried
from psa_casadi.population.finding import NORMAL_95, Finding, Trace
from psa_casadi.population.population import Difference, Population, Spread, display_unit
from psa_casadi.population.statistics import mixed_regression
from psa_casadi.report.plots.theme import BOUND_COLOUR, GRID, INK, WEAK_COLOUR, Plot, styled
from psa_casadi.report.words.phrases import handy_scale, length_scale, plain
from psa_casadi.report.words.series import (
    BASE_COLOUR,
    EXTENDED_COLOUR,
    MEASURED_COLOUR,
    NOISE_COLOUR,
    compact,
    time_scale,
)
from psa_casadi.units import FloatArray, convert

#: Colours of devices side by side, with dashes and symbols where there are more of them.
_COLOURS = (EXTENDED_COLOUR, BASE_COLOUR, WEAK_COLOUR, BOUND_COLOUR, MEASURED_COLOUR)
_DASHES = ("solid", "dash", "dot", "dashdot")
_SYMBOLS = ("circle", "square", "diamond", "triangle-up")
_HEIGHT = 340
#: Devices that stand out and are named in a picture, those furthest out.
_MOST_NAMED = 6


def label(name: str) -> str:
    """Return a name as plotly shows it: text, never markup."""
    return escape(carried(name), quote=False)


def look(k: int) -> tuple[str, str, str]:
    """Return colour, dash and symbol of the device at place k."""
    n = len(_COLOURS)
    return _COLOURS[k % n], _DASHES[k // n % len(_DASHES)], _SYMBOLS[k // n % len(_SYMBOLS)]


def difference_plot(findings: Sequence[Finding], rows: Sequence[Difference]) -> Plot:
    """Every shared parameter over the weighted mean of the devices [%], with intervals."""
    plot = go.Figure()
    names = [f"{d.estimates.name}{' *' if d.differs else ''}" for d in rows]
    room = 0.7 / max(1, len(findings))
    for k, f in enumerate(findings):
        points = [(i, *_relative(d, k)) for i, d in enumerate(rows) if k in d.estimates.places]
        if not points:
            continue
        place, value, low, high = np.array(points).T
        colour, _, symbol = look(k)
        plot.add_scatter(
            x=compact(value), y=compact(place + room * (k - 0.5 * (len(findings) - 1))),
            error_x={"type": "data", "symmetric": False, "array": compact(high - value),
                     "arrayminus": compact(value - low), "thickness": 1.6, "width": 3,
                     "color": colour},
            mode="markers", marker={"color": colour, "symbol": symbol, "size": 8},
            name=label(f.device), hovertemplate="%{x:.3g} %<extra></extra>",
        )  # fmt: skip
    plot.add_vline(0.0, line={"color": NOISE_COLOUR, "width": 1.0, "dash": "dot"})
    styled(plot, 150 + max(34, 16 * len(findings)) * len(rows))
    plot.update_layout(margin={"l": 20, "r": 10, "t": 46, "b": 46})
    plot.update_xaxes(title_text="from the mean of the devices [%]")
    return plot.update_yaxes(
        tickvals=list(range(len(names))), ticktext=names, automargin=True, autorange="reversed",
        showgrid=False,
    )  # fmt: skip


def _relative(d: Difference, device: int) -> tuple[float, float, float]:
    """Return value, low and high of a device in percent of the mean's size."""
    e = d.estimates
    k = e.places.index(device)
    mean = float(mixed_regression(e.theta, e.errors).b[0])
    half = NORMAL_95 * float(e.errors[k])
    value = [e.value(t) for t in (e.theta[k], e.theta[k] - half, e.theta[k] + half)]
    size = abs(e.value(mean)) or 1.0
    first, low, high = (100.0 * (v - e.value(mean)) / size for v in value)
    return first, low, high


def budget_plot(findings: Sequence[Finding]) -> Plot:
    """Shares of the base model's held-out error that each cause removes, one bar for a device."""
    told = [f for f in findings if f.budget]
    plot = go.Figure()
    for k, what in enumerate(dict.fromkeys(s.what for f in told for s in f.budget)):
        shares = [next((s.share for s in f.budget if s.what == what), 0.0) for f in told]
        plot.add_bar(
            x=[100.0 * max(0.0, s) for s in shares], y=[label(f.device) for f in told],
            orientation="h", name=label(plain(what)), marker={"color": look(k)[0]}, width=0.6,
            hovertemplate="%{x:.0f} %<extra></extra>",
        )  # fmt: skip
    styled(plot, 130 + 34 * len(told))
    plot.update_layout(barmode="group" if len(told) < 3 else "stack")
    plot.update_xaxes(title_text="removed of the error's power above the noise [%]")
    return plot.update_yaxes(autorange="reversed", automargin=True, showgrid=False, type="category")


def error_plots(findings: Sequence[Finding]) -> tuple[Plot, Plot, Plot]:
    """Return measured less model over time and over voltage, and the loops, of every device."""
    traced = [(k, f.device, f.trace) for k, f in enumerate(findings) if f.trace is not None]
    clock = time_scale(max(t.time[-1] - t.time[0] for _, _, t in traced))
    largest = max(float(np.nanmax(np.abs(_error(t)))) for _, _, t in traced)
    span = max(float(np.nanmax(t.measured) - np.nanmin(t.measured)) for _, _, t in traced)
    small, length = length_scale(largest), handy_scale(span)
    plots = tuple(go.Figure() for _ in range(3))
    for k, device, t in traced:
        time = clock.factor * (np.array(t.time) - t.time[0])
        voltage, error = np.array(t.voltage), small.factor * _error(t)
        stroke = length.factor * (np.array(t.measured) - np.nanmin(t.measured))
        for plot, x, y in zip(plots, (time, voltage, voltage), (error, error, stroke), strict=True):
            plot.add_scatter(**_line(k, device, x, y))
    titles = (
        (f"time [{clock.unit}]", f"measured less model [{small.unit}]"),
        ("voltage [V]", f"measured less model [{small.unit}]"),
        ("voltage [V]", f"measured displacement [{length.unit}]"),
    )
    for plot, (x_title, y_title) in zip(plots, titles, strict=True):
        styled(plot, _HEIGHT)
        plot.update_xaxes(title_text=x_title)
        plot.update_yaxes(title_text=y_title, automargin=True)
    return plots[0], plots[1], plots[2]


def _line(k: int, device: str, x: FloatArray, y: FloatArray) -> dict[str, Any]:
    colour, dash, _ = look(k)
    return {
        "x": compact(x), "y": compact(y), "mode": "lines", "name": label(device),
        "line": {"color": colour, "dash": dash, "width": 1.3},
    }  # fmt: skip


def _error(t: Trace) -> FloatArray:
    return np.asarray(np.array(t.measured) - np.array(t.model))


def spread_plot(p: Population, s: Spread) -> Plot:
    """A parameter over the devices in the order of its values, with intervals and the others' band.

    Devices that stand out, as the population has them, have another colour and symbol, and their
    names.
    """
    order = np.argsort(s.estimates.theta)
    return _over_devices(p, s, np.arange(order.size), order, "devices, in order")


def drift_plot(p: Population, s: Spread) -> Plot:
    """A parameter over the date of the devices."""
    findings = p.findings
    order = np.arange(len(s.estimates.places))
    days = [d for k in s.estimates.places if (d := findings[k].day) is not None]
    plot = _over_devices(p, s, [d.isoformat() for d in days], order, "date", band=False)
    return plot.update_xaxes(type="date")


def _over_devices(
    p: Population,
    s: Spread,
    x: Any,
    order: Any,
    title: str,
    *,
    band: bool = True,
) -> Plot:
    e, c = s.estimates, s.common
    unit = display_unit(e.name, e.unit)
    half = NORMAL_95 * e.errors[order]
    shown = _shown(e.value, e.unit, unit)
    middle, low, high = (shown(e.theta[order] + sign * half) for sign in (0.0, -1.0, 1.0))
    plot = go.Figure()
    devices = [p.findings[e.places[k]].device for k in order]
    apart = {o.device: abs(o.z) for o in p.outliers if o.parameter == e.name}
    named = set(sorted(apart, key=apart.__getitem__, reverse=True)[:_MOST_NAMED])
    far = np.array([d in apart for d in devices])
    names = np.array([label(d) for d in devices], dtype=object)
    # names lie towards the middle of the plot
    sides = np.where(np.arange(order.size) < 0.5 * order.size, "middle right", "middle left")
    for name, which, colour, symbol in (
        ("belongs to the others", ~far, EXTENDED_COLOUR, "circle"),
        ("stands out", far, BASE_COLOUR, "diamond"),
    ):
        if not which.any():
            continue
        plot.add_scatter(
            x=np.asarray(x)[which].tolist(), y=compact(middle[which]), name=name,
            mode="markers+text" if which is far else "markers",
            text=[f" {n} " if d in named else "" for d, n in zip(devices, names, strict=True)
                  if (d in apart) == (which is far)],
            textposition=sides[which].tolist(), cliponaxis=False,
            marker={"color": colour, "symbol": symbol, "size": 7},
            error_y={"type": "data", "symmetric": False, "array": compact((high - middle)[which]),
                     "arrayminus": compact((middle - low)[which]), "thickness": 1.2, "width": 0,
                     "color": colour},
            hovertext=names[which].tolist(),
            hovertemplate="%{hovertext}: %{y:.4g}<extra></extra>",
        )  # fmt: skip
    if band:
        mean = float(c.b[0])
        ends = [mean, mean - NORMAL_95 * c.tau, mean + NORMAL_95 * c.tau]
        for value, dash in zip(shown(np.array(ends)), ("solid", "dash", "dash"), strict=True):
            plot.add_hline(float(value), line={"color": INK, "width": 1.0, "dash": dash})
    styled(plot, _HEIGHT)
    plot.update_xaxes(title_text=title, showgrid=False, gridcolor=GRID)
    return plot.update_yaxes(
        title_text=f"{e.name} [{unit}]" if unit != "1" else e.name, automargin=True
    )


def _shown(
    value: Callable[[float], float], unit: str, display: str
) -> Callable[[FloatArray], FloatArray]:
    def shown(theta: FloatArray) -> FloatArray:
        return np.array([float(convert(value(float(t)), unit, display)) for t in theta])

    return shown
