"""Plots of the HTML page that show what a residual depends on, and the signature of an effect."""

from typing import Any

import numpy as np
import plotly.graph_objects as go

from psa_casadi.diagnosis.misfit import Misfit, Spectrum
from psa_casadi.diagnosis.signature import Signature
from psa_casadi.diagnosis.views import View
from psa_casadi.report.plots.theme import INK, Plot, logarithmic, styled
from psa_casadi.report.words.misfit_words import AXES
from psa_casadi.report.words.phrases import Scale, length_scale
from psa_casadi.report.words.series import (
    BASE_COLOUR,
    EXTENDED_COLOUR,
    NOISE_COLOUR,
    FloatArray,
    compact,
)

_HEIGHT = 300
#: Samples of a signature that are drawn behind its means.
_SAMPLES = 1000


def view_named(m: Misfit, name: str) -> View | None:
    """Return the view of that name, None where the record has none or nothing to show in it."""
    rows = (*m.views, *((m.holds,) if m.holds else ()))
    return next((v for v in rows if v.name == name and v.x.size), None)


def label_of(view: View) -> tuple[str, float]:
    """Return the label of a view's coordinate, and what the coordinate is multiplied by for it."""
    unit, factor = ("µm", 1e6) if view.x_unit == "m" else (view.x_unit, 1.0)
    return f"{AXES[view.name].label} [{unit}]", factor


def is_logarithmic(name: str) -> bool:
    """Say whether a view of that name is shown over the logarithm of its coordinate."""
    return name.startswith(("since_reversal", "holds", "spectrum"))


def view_plot(before: View, after: View | None, *, counts: bool) -> Plot:
    """Binned means of the residual with two standard errors, before and after the extension."""
    scale = length_scale(float(np.max(np.abs(before.mean))), counts=counts)
    rows = [(before, BASE_COLOUR, "base model")]
    rows += [(after, EXTENDED_COLOUR, "extended model")] if after is not None else []
    plot = go.Figure()
    label, factor = label_of(before)
    for view, colour, name in rows:
        plot.add_scatter(
            x=compact(factor * view.x), y=compact(scale.factor * view.mean), mode="lines+markers",
            name=name, line={"color": colour, "width": 1.8}, marker={"color": colour, "size": 6},
            error_y={"array": compact(2.0 * scale.factor * view.spread), "color": colour,
                     "thickness": 1.0, "width": 2},
        )  # fmt: skip
    return _finished(plot, before.name, label, scale, [factor * v.x for v, _, _ in rows])


def spectrum_view_plot(before: Spectrum, after: Spectrum | None, *, counts: bool) -> Plot:
    """Amplitude density of the residual before and after the extension, above the noise's."""
    scale = length_scale(float(np.max(before.density)), counts=counts)
    rows = [(before.density, before.frequency, BASE_COLOUR, "base model", "solid")]
    if after is not None:
        rows.append((after.density, after.frequency, EXTENDED_COLOUR, "extended model", "solid"))
    rows.append((before.floor, before.frequency, INK, "noise", "dash"))
    plot = go.Figure()
    for density, frequency, colour, name, dash in rows:
        plot.add_scatter(
            x=compact(frequency), y=compact(scale.factor * density), mode="lines", name=name,
            line={"color": colour, "width": 1.5, "dash": dash},
        )  # fmt: skip
    _finished(plot, "spectrum", "frequency [Hz]", scale, [before.frequency])
    values = scale.factor * np.concatenate([density for density, *_ in rows])
    shown = logarithmic((float(np.min(values[values > 0])), float(np.max(values))))
    return plot.update_yaxes(**shown, title_text=f"residual [{scale.unit}/√Hz]")


def signature_plot(seen: Signature) -> Plot:
    """What an effect adds along its telling coordinate: samples behind their binned means."""
    view, scale = seen.telling, length_scale(float(np.max(np.abs(seen.difference))))
    label, factor = label_of(view)
    plot, (low, high) = go.Figure(), (float(np.min(view.x)), float(np.max(view.x)))
    if seen.coordinate.size:
        on = np.flatnonzero((seen.coordinate >= low) & (seen.coordinate <= high))
        on = on[:: max(1, on.size // _SAMPLES)]
        plot.add_scatter(
            x=compact(factor * seen.coordinate[on]), y=compact(scale.factor * seen.counted[on]),
            mode="markers", name="samples", marker={"color": NOISE_COLOUR, "size": 3},
        )  # fmt: skip
    mode = "lines+markers" if seen.coordinate.size else "lines"
    plot.add_scatter(
        x=compact(factor * view.x), y=compact(scale.factor * view.mean), mode=mode,
        name="binned means" if seen.coordinate.size else "difference",
        line={"color": EXTENDED_COLOUR, "width": 1.8},
        marker={"color": EXTENDED_COLOUR, "size": 6},
    )  # fmt: skip
    _finished(plot, view.name, label, scale, [factor * view.x])
    plot.update_yaxes(title_text=f"difference [{scale.unit}]")
    if view.name == "spectrum":
        top = scale.factor * float(np.max(view.mean))
        plot.update_layout(showlegend=False)
        plot.update_yaxes(
            **logarithmic((1e-4 * top, top)), title_text=f"difference [{scale.unit}/√Hz]",
            range=[float(np.log10(top)) - 4.0, float(np.log10(top)) + 0.4],
        )  # fmt: skip
    return plot


def _finished(plot: Plot, name: str, label: str, scale: Scale, shown: list[FloatArray]) -> Plot:
    """Give a view's plot its axes; `shown` are the coordinates in it."""
    styled(plot, _HEIGHT)
    plot.update_layout(showlegend=True)
    axis: dict[str, Any] = {"title_text": label}
    if is_logarithmic(name):
        values = np.concatenate(shown)
        axis |= logarithmic((float(values.min()), float(values.max())))
    plot.update_xaxes(**axis)
    return plot.update_yaxes(
        title_text=f"residual [{scale.unit}]", zeroline=True, zerolinecolor=NOISE_COLOUR
    )
