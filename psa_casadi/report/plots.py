"""Plotly pictures of the HTML reports: time and residual, loop, spectrum, evidence."""

from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.report.phrases import plain, share_text
from psa_casadi.report.series import (
    HELD_OUT_COLOUR,
    MEASURED_COLOUR,
    NOISE_COLOUR,
    Series,
    bar_colour,
    kept,
    noise_density,
    spans,
    spectrum,
    telling_window,
)

#: Points of a part of a record, measured samples shown one by one.
_ZOOM_POINTS = 1500

#: A picture without type: plotly ships no type information.
Plot = Any


def time_plot(s: Series, origin: str, limit: int) -> Plot:
    """Displacement over time above the residual over the same time, held-out part shaded."""
    plot = make_subplots(
        rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.07, row_heights=[0.6, 0.4]
    )
    residuals = [s.residual(c) for c in s.curves]
    shown = kept([s.measured, *residuals], limit)
    scale, small = s.scale, s.residual_scale
    time = s.time[shown]

    def line(row: int, values: Any, colour: str, name: str, width: float, legend: bool) -> None:
        trace = go.Scatter(
            x=time, y=np.float32(values[shown]), mode="lines", name=name, legendgroup=name,
            showlegend=legend, line={"color": colour, "width": width},
        )  # fmt: skip
        plot.add_trace(trace, row=row, col=1)

    line(1, scale.factor * s.measured, MEASURED_COLOUR, origin, 3.0, True)
    for curve, residual in zip(s.curves, residuals, strict=True):
        line(1, scale.factor * curve.values, curve.colour, curve.label, 1.4, True)
        line(2, small.factor * residual, curve.colour, curve.label, 1.0, False)
    for edge in (-2.0, 2.0):
        y = edge * s.noise * small.factor
        plot.add_hline(y, row=2, col=1, line={"color": "black", "dash": "dash", "width": 1.2})
    for first, last in spans(s.held_out):
        plot.add_vrect(
            s.time[first], s.time[last], fillcolor=HELD_OUT_COLOUR, layer="below", line_width=0
        )
    plot.update_yaxes(title_text=f"displacement [{scale.unit}]", row=1, col=1)
    plot.update_yaxes(title_text=f"residual [{small.unit}]", row=2, col=1)
    plot.update_xaxes(title_text="time [s]", row=2, col=1)
    return _styled(plot, 560)


def zoom_plot(s: Series, origin: str) -> Plot:
    """Displacement over time in the window where the curves are easiest to tell apart."""
    window = telling_window(s)
    shown = np.arange(len(s.time))[window]
    shown = shown[kept([s.measured[window]], _ZOOM_POINTS)]
    scale, plot = s.scale, go.Figure()
    plot.add_scatter(
        x=s.time[shown], y=np.float32(scale.factor * s.measured[shown]), mode="lines+markers",
        name=origin, line={"color": NOISE_COLOUR, "width": 0.7},
        marker={"color": MEASURED_COLOUR, "size": 4},
    )  # fmt: skip
    for curve in s.curves:
        plot.add_scatter(
            x=s.time[shown], y=np.float32(scale.factor * curve.values[shown]), mode="lines",
            name=curve.label, line={"color": curve.colour, "width": 2.5},
        )  # fmt: skip
    plot.update_xaxes(title_text="time [s]")
    plot.update_yaxes(title_text=f"displacement [{scale.unit}]")
    return _styled(plot, 420)


def loop_plot(s: Series, origin: str, limit: int) -> Plot:
    """Displacement over voltage."""
    shown = kept([s.measured, *(c.values for c in s.curves)], limit)
    scale, plot = s.scale, go.Figure()
    rows = [(s.measured, MEASURED_COLOUR, origin, 3.0)]
    rows += [(c.values, c.colour, c.label, 1.2) for c in s.curves]
    for values, colour, name, width in rows:
        plot.add_scatter(
            x=np.float32(s.voltage[shown]), y=np.float32(scale.factor * values[shown]),
            mode="lines", name=name, line={"color": colour, "width": width},
        )  # fmt: skip
    plot.update_xaxes(title_text="voltage [V]")
    plot.update_yaxes(title_text=f"displacement [{scale.unit}]")
    return _styled(plot, 420)


def spectrum_plot(s: Series) -> Plot:
    """Amplitude density of the residual before and after, and of white noise of that level."""
    plot = go.Figure()
    small = s.residual_scale
    for curve in s.curves:
        frequency, density = spectrum(s.time, s.residual(curve))
        plot.add_scatter(
            x=np.float32(frequency), y=np.float32(small.factor * density), mode="lines",
            name=curve.label, line={"color": curve.colour, "width": 1.4},
        )  # fmt: skip
    floor = float(small.factor * noise_density(s))
    plot.add_scatter(
        x=[float(frequency[0]), float(frequency[-1])], y=[floor, floor], mode="lines",
        name="noise floor", line={"color": "black", "dash": "dash", "width": 1.4},
    )  # fmt: skip
    plot.update_xaxes(title_text="frequency [Hz]", type="log")
    plot.update_yaxes(title_text=f"residual [{small.unit}/√Hz]", type="log")
    return _styled(plot, 420)


def evidence_plot(d: Diagnosis) -> Plot:
    """One bar for every effect that was tried; text says the share of the excess it explains."""
    rows = d.candidates[::-1]
    causes = {c.effect for c in d.causes}
    # asinh shows small, large and negative evidence in one picture; the labels give the figures
    values = [float(np.arcsinh(c.evidence / 10.0)) for c in rows]
    plot = go.Figure(
        go.Bar(
            x=values,
            y=[plain(c.effect).replace("independent ", "independent<br>") for c in rows],
            orientation="h",
            marker={"color": [bar_colour(c, causes) for c in rows]},
            text=[f"{c.evidence:,.0f} ({share_text(c)})" for c in rows],
            textposition="auto",
            hoverinfo="y+text",
        )
    )
    largest = max([abs(v) for v in values], default=1.0) or 1.0
    plot.update_xaxes(
        title_text="evidence [ln units], compressed",
        showticklabels=False,
        range=[min([0.0, *values]) * 1.1, 1.35 * largest],
    )
    plot.update_yaxes(showgrid=False)
    styled = _styled(plot, 130 + 42 * len(rows))
    styled.update_layout(margin={"l": 10, "r": 8, "t": 16, "b": 44})
    styled.update_yaxes(automargin=True)
    return styled


def _styled(plot: Plot, height: int) -> Plot:
    plot.update_layout(
        template="plotly_white",
        height=height,
        margin={"l": 62, "r": 8, "t": 40, "b": 46},
        font={"size": 13, "color": "#222222"},
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0.0},
        hovermode="closest",
    )
    plot.update_xaxes(zeroline=False, linecolor="#999999", mirror=True, ticks="outside")
    plot.update_yaxes(zeroline=False, linecolor="#999999", mirror=True, ticks="outside")
    return plot
