"""Plots of the HTML pages that show one record: time, loop, window, and its residual."""

from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from psa_casadi.report.plots.theme import INK, Plot, logarithmic, styled
from psa_casadi.report.words.phrases import in_brackets
from psa_casadi.report.words.series import (
    HELD_OUT_COLOUR,
    MEASURED_COLOUR,
    NOISE_COLOUR,
    FloatArray,
    IndexArray,
    Series,
    autocorrelation,
    compact,
    distribution,
    kept,
    noise_density,
    shown_lines,
    spans,
    spectrum,
    telling_window,
    white_band,
)

#: Points of a part of a record, measured samples shown one by one, and of a spectrum.
_ZOOM_POINTS, _SPECTRUM_POINTS = 1500, 800
_FULL, _HALF = 500, 330
#: A residual is far off if it is so many times wider than the one that is to be read.
_FAR = 6.0


def _shown(s: Series, limit: int) -> IndexArray:
    """Return the samples of a record that plots over all of it show.

    They are the same in all of them: so the page holds each curve once.
    """
    return kept([s.voltage, s.measured, *(s.residual(c) for c in s.curves)], limit)


def time_plot(s: Series, origin: str, limit: int) -> Plot:
    """What was measured over time above the residual over the same time, held-out part shaded."""
    plot = make_subplots(
        rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06, row_heights=[0.6, 0.4]
    )
    residuals = [s.residual(c) for c in s.curves]
    shown = _shown(s, limit)
    scale, small, clock = s.scale, s.residual_scale, s.time_scale
    time = compact(clock.factor * s.time[shown])

    def line(row: int, values: FloatArray, look: dict[str, Any], name: str, legend: bool) -> None:
        trace = go.Scatter(
            x=time, y=compact(values[shown]), mode="lines", name=name, legendgroup=name,
            showlegend=legend, line=look,
        )  # fmt: skip
        plot.add_trace(trace, row=row, col=1)

    line(1, scale.factor * s.measured, {"color": MEASURED_COLOUR, "width": 3.0}, origin, True)
    for curve, residual in zip(s.curves, residuals, strict=True):
        look = {"color": curve.colour, "width": 1.4}
        line(1, scale.factor * curve.values, look, curve.label, True)
        line(2, small.factor * residual, {**look, "width": 1.0}, curve.label, False)
    for edge in (-2.0, 2.0):
        y = edge * s.noise * small.factor
        plot.add_hline(y, row=2, col=1, line={"color": INK, "dash": "dash", "width": 1.2})
    for first, last in spans(s.held_out):
        left, right = clock.factor * s.time[first], clock.factor * s.time[last]
        plot.add_vrect(left, right, fillcolor=HELD_OUT_COLOUR, layer="below", line_width=0)
    styled(plot, _FULL)
    plot.update_yaxes(title_text=s.label, row=1, col=1)
    plot.update_yaxes(title_text=in_brackets("residual", small.unit), row=2, col=1)
    plot.update_xaxes(title_text=f"time [{clock.unit}]", row=2, col=1)
    return plot


def zoom_plot(s: Series, origin: str, limit: int) -> Plot:
    """What was measured over time in the window where the curves are easiest to tell apart."""
    window = telling_window(s)
    shown = np.arange(len(s.time))[window]
    shown = shown[kept([s.measured[window]], min(limit // 2, _ZOOM_POINTS))]
    scale, clock, plot = s.scale, s.time_scale, go.Figure()
    time = compact(clock.factor * s.time[shown])
    plot.add_scatter(
        x=time, y=compact(scale.factor * s.measured[shown]), mode="lines+markers",
        name=origin, line={"color": NOISE_COLOUR, "width": 0.7},
        marker={"color": MEASURED_COLOUR, "size": 4},
    )  # fmt: skip
    for curve in s.curves:
        plot.add_scatter(
            x=time, y=compact(scale.factor * curve.values[shown]), mode="lines",
            name=curve.label, line={"color": curve.colour, "width": 2.2},
        )  # fmt: skip
    return _labelled(plot, f"time [{clock.unit}]", s.label)


def loop_plot(s: Series, origin: str, limit: int) -> Plot:
    """What was measured over what drives it, such as displacement over voltage."""
    shown = _shown(s, limit)
    scale, plot = s.scale, go.Figure()
    rows = [(s.measured, MEASURED_COLOUR, origin, 3.0)]
    rows += [(c.values, c.colour, c.label, 1.2) for c in s.curves]
    for values, colour, name, width in rows:
        plot.add_scatter(
            x=compact(s.voltage[shown]), y=compact(scale.factor * values[shown]),
            mode="lines", name=name, line={"color": colour, "width": width},
        )  # fmt: skip
    return _labelled(plot, s.against, s.label)


def error_loop_plot(s: Series, limit: int) -> Plot:
    """Residual over what drives the model: where in the loop the model goes wrong."""
    residuals = [s.residual(c) for c in s.curves]
    shown = _shown(s, limit)
    small, plot = s.residual_scale, go.Figure()
    for curve, residual in zip(s.curves, residuals, strict=True):
        plot.add_scatter(
            x=compact(s.voltage[shown]), y=compact(small.factor * residual[shown]), mode="lines",
            name=curve.label, line={"color": curve.colour, "width": 0.9},
        )  # fmt: skip
    for edge in (-2.0, 2.0):
        y = edge * s.noise * small.factor
        plot.add_hline(y, line={"color": INK, "dash": "dash", "width": 1.2})
    plot.update_layout(showlegend=len(s.curves) > 1)
    return _labelled(plot, s.against, in_brackets("residual", small.unit))


def spectrum_plot(s: Series, limit: int) -> Plot:
    """Amplitude density of every curve's residual, and of white noise of the record's level."""
    plot, small = go.Figure(), s.residual_scale
    floor = small.factor * noise_density(s)
    low, high, ends = floor, floor, [0.0, 0.0]
    for curve in s.curves:
        frequency, density = spectrum(s.time, s.residual(curve))
        ends = [float(frequency[0]), float(frequency[-1])]
        shown = shown_lines(frequency, density, min(limit // 2, _SPECTRUM_POINTS))
        values = small.factor * density[shown]
        low, high = min(low, float(np.min(values))), max(high, float(np.max(values)))
        plot.add_scatter(
            x=compact(frequency[shown]), y=compact(values), mode="lines",
            name=curve.label, line={"color": curve.colour, "width": 1.4},
        )  # fmt: skip
    plot.add_scatter(
        x=ends, y=[floor, floor], mode="lines", name="noise floor",
        line={"color": INK, "dash": "dash", "width": 1.4},
    )  # fmt: skip
    _labelled(plot, "frequency [Hz]", f"residual [{small.unit or 1}/√Hz]")
    plot.update_xaxes(**logarithmic((ends[0], ends[1])))
    return plot.update_yaxes(**logarithmic((low, high)))


def autocorrelation_plot(s: Series) -> Plot:
    """Autocorrelation of every curve's residual over the lag, and the band of white noise."""
    plot, clock, steps = go.Figure(), s.time_scale, np.diff(s.time)
    step = float(np.median(steps))
    even = float(np.max(np.abs(steps - step))) < 0.02 * step
    unit, size = (clock.unit, clock.factor * step) if even else ("samples", 1.0)
    band = ends = 0.0
    for curve in s.curves:
        lags, values = autocorrelation(s.residual(curve))
        band, ends = white_band(s.residual(curve)), float(lags[-1])
        plot.add_scatter(
            x=compact(size * lags.astype(np.float64)), y=compact(values), mode="lines",
            name=curve.label, line={"color": curve.colour, "width": 1.6},
        )  # fmt: skip
    for edge in (-band, band):
        plot.add_hline(edge, line={"color": INK, "dash": "dash", "width": 1.2})
    _labelled(plot, f"lag [{unit}]", "autocorrelation")
    plot.update_layout(showlegend=len(s.curves) > 1)
    plot.update_yaxes(range=[-1.05, 1.05], zeroline=True, zerolinecolor=NOISE_COLOUR)
    return plot.update_xaxes(**logarithmic((size, size * ends)))


def distribution_plot(s: Series) -> Plot:
    """Share of samples over the size of every curve's residual, beside a normal distribution.

    Where the others are far off, the axis is that of the last one; their names say how much of
    them lies outside.
    """
    plot, small = go.Figure(), s.residual_scale
    residuals = [s.residual(c) for c in s.curves]
    low, high = _readable(residuals)
    for curve, residual in zip(s.curves, residuals, strict=True):
        d = distribution(residual, low, high)
        beyond = 100.0 - float(np.sum(d.shares))
        said = f" ({beyond:.0f} % outside)" if beyond >= 0.5 else ""
        plot.add_scatter(
            x=compact(small.factor * d.centres), y=compact(d.shares), mode="lines",
            name=f"{curve.label}{said}", fill="tozeroy" if curve is s.curves[-1] else "none",
            line={"color": curve.colour, "width": 1.4, "shape": "hvh"},
        )  # fmt: skip
    mean, spread = float(np.nanmean(residuals[-1])), float(np.nanstd(residuals[-1]))
    if spread > 0:
        x = np.linspace(low, high, 161)
        normal = np.exp(-0.5 * ((x - mean) / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
        plot.add_scatter(
            x=compact(small.factor * x), y=compact(100.0 * d.width * normal), mode="lines",
            name="normal", line={"color": INK, "dash": "dash", "width": 1.4},
        )  # fmt: skip
    return _labelled(plot, in_brackets("residual", small.unit), "samples in a bin [%]")


def _readable(residuals: list[FloatArray]) -> tuple[float, float]:
    """Return the ends of an axis on which the last residual can be read: all, unless far wider."""
    low, high = (np.array([f(r) for r in residuals]) for f in (np.nanmin, np.nanmax))
    span = float(high[-1] - low[-1])
    if 0.0 < span * _FAR < float(high.max() - low.min()):
        return float(low[-1] - 0.5 * span), float(high[-1] + 0.5 * span)
    return float(low.min()), float(high.max())


def _labelled(plot: Plot, x: str, y: str) -> Plot:
    styled(plot, _HALF)
    return plot.update_xaxes(title_text=x).update_yaxes(title_text=y)
