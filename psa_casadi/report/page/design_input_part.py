"""What the page of a designed input shows: path and response, error, voltage, limits."""

from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from psa_casadi.design.tracking.inversion import CorrectedInput, InvertedInput
from psa_casadi.design.tracking.minimum_time import QuickMove
from psa_casadi.design.tracking.targets import (
    AmplifierLimits,
    Response,
    Target,
    TrackingError,
    usage,
)
from psa_casadi.design.tracking.tracking import TrackedInput
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.theme import INK, Plot, styled
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.series import BASE_COLOUR, EXTENDED_COLOUR, MEASURED_COLOUR, FloatArray
from psa_casadi.report.words.tables import Table

_HEIGHT, _MOST_POINTS = 360, 4000
#: Time shown of a move and its hold at first, over the move's; the rest is behind the zoom.
_SHOWN = 2.5


@dataclass(frozen=True)
class Titled:
    """A table under a title, with a note."""

    title: str
    table: Table
    note: str = ""


Curve = tuple[str, FloatArray, str, float]


def curves(time: FloatArray, shown: list[Curve], label: str, bounds: list[float]) -> Plot:
    """Return curves (name, values, colour, width) over time [ms], and limits as dashed lines."""
    plot = go.Figure()
    part = slice(None, None, max(1, len(time) // _MOST_POINTS))
    for name, values, colour, width in shown:
        plot.add_scatter(
            x=1e3 * time[part], y=values[part], mode="lines", name=name,
            line={"color": colour, "width": width},
        )  # fmt: skip
    for bound in bounds:
        if np.isfinite(bound):
            plot.add_hline(bound, line={"color": INK, "dash": "dash", "width": 1.2})
    styled(plot, _HEIGHT)
    plot.update_xaxes(title_text="time [ms]")
    plot.update_yaxes(title_text=label)
    return plot


def tracking_pictures(found: TrackedInput, uncompensated: FloatArray) -> list[Picture]:
    """Return path and response, the error, and the voltage with its limits."""
    t, wanted = found.target.time, found.target.displacement
    share = 100.0 / found.target.span
    paths: list[Curve] = [
        ("path", 1e6 * wanted, MEASURED_COLOUR, 3.0),
        ("designed, simulated", 1e6 * found.response.displacement, EXTENDED_COLOUR, 1.4),
        ("uncompensated, simulated", 1e6 * uncompensated, BASE_COLOUR, 1.4),
    ]
    errors: list[Curve] = [
        ("simulated", share * (found.response.displacement - wanted), EXTENDED_COLOUR, 1.4),
    ]
    if found.by_program:
        predicted = share * (found.predicted - wanted)
        errors.append(("predicted by the program", predicted, BASE_COLOUR, 1.2))
    return [
        Picture("Path and response", curves(t, paths, "displacement [µm]", [])),
        Picture("Error of the designed input", curves(t, errors, "error [% of range]", [])),
        voltage_picture(found.response, found.limits),
    ]


def inversion_pictures(found: InvertedInput, limits: AmplifierLimits) -> list[Picture]:
    """Return path and response of an inverted input, and the voltage with its limits."""
    shown = _path_and("inverted, simulated", found.target, found.response.displacement)
    plot = curves(found.target.time, shown, "displacement [µm]", [])
    return [Picture("Path and response", plot), voltage_picture(found.response, limits)]


def trial_pictures(found: CorrectedInput) -> list[Picture]:
    """Return path and measured trial, and the voltages played and corrected."""
    shown = _path_and("trial, measured", found.target, found.measured)
    plot = curves(found.target.time, shown, "displacement [µm]", [])
    played: Curve = ("played in the trial", found.played, BASE_COLOUR, 1.4)
    voltage = voltage_picture(found.response, found.limits, played)
    return [Picture("Path and trial", plot), voltage]


def _path_and(name: str, target: Target, displacement: FloatArray) -> list[Curve]:
    return [
        ("path", 1e6 * target.displacement, MEASURED_COLOUR, 3.0),
        (name, 1e6 * displacement, EXTENDED_COLOUR, 1.4),
    ]


def voltage_picture(response: Response, limits: AmplifierLimits, *others: Curve) -> Picture:
    """Return the voltage over time with its limits, and other voltages beside it."""
    shown: list[Curve] = [*others, ("designed", response.voltage, EXTENDED_COLOUR, 1.6)]
    bounds = [limits.min_voltage, limits.max_voltage]
    return Picture("Voltage", curves(response.time, shown, "voltage [V]", bounds))


def move_pictures(found: QuickMove) -> list[Picture]:
    """Return the displacement of a quickest move with its hold, and the voltage."""
    shown: list[Curve] = [
        ("simulated", 1e6 * found.response.displacement, EXTENDED_COLOUR, 1.8),
    ]
    plot = curves(found.response.time, shown, "displacement [µm]", [1e6 * found.end])
    note = "Dashed: the position to reach. The voltage holds its last value behind the move."
    pictures = [
        Picture("Move and hold", plot, note),
        voltage_picture(found.response, found.limits),
    ]
    for picture in pictures:
        picture.plot.update_xaxes(range=[0.0, _SHOWN * 1e3 * found.move_time])
    return pictures


def error_table(rows: list[tuple[str, TrackingError]]) -> Titled:
    """Return errors in percent of the path's range, rms and largest, by who says so."""
    body = tuple((n, number(e.rms_percent), number(e.largest_percent)) for n, e in rows)
    return Titled("Errors", Table(("voltage, judged by", "rms [% of range]", "largest [%]"), body))


def limits_table(response: Response, limits: AmplifierLimits) -> Titled:
    """Return what the response takes of each limit, and the margin that is left."""
    rows = []
    for name, low, high, limit, unit in usage(response, limits):
        used = high if name == "voltage" else max(abs(low), abs(high))
        given = number(limit) if np.isfinite(limit) else "none"
        margin = number(limit - used) if np.isfinite(limit) else ""
        if name == "voltage" and np.isfinite(limits.min_voltage):
            given = f"{number(limits.min_voltage)} to {given if margin else 'any'}"
            margin = number(min(limit - high, low - limits.min_voltage))
        rows.append((f"{name} [{unit}]", number(low), number(high), given, margin))
    head = ("quantity", "least", "largest", "limit", "margin")
    return Titled("Limits and margins", Table(head, tuple(rows)))
