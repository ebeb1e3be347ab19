"""Colours of the pages' plots, for paper and for a dark screen, and what all plots share."""

import math
from typing import Any

from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.series import (
    BASE_COLOUR,
    EXTENDED_COLOUR,
    HELD_OUT_COLOUR,
    MEASURED_COLOUR,
    NOISE_COLOUR,
)

INK, GRID, AXIS = "#222222", "#e4e7ea", "#9aa1a8"
WEAK_COLOUR, BOUND_COLOUR = "#e69f00", "#a8568f"

#: What takes a colour's place on a dark screen. Every colour in a plot is a key of this table.
DARK = {
    INK: "#e4e6e8",
    GRID: "#2c343b",
    AXIS: "#69747e",
    MEASURED_COLOUR: "#d9dcdf",
    BASE_COLOUR: "#ff8a45",
    EXTENDED_COLOUR: "#56b4e9",
    NOISE_COLOUR: "#8f979e",
    HELD_OUT_COLOUR: "#3a3521",
    WEAK_COLOUR: "#f0b849",
    BOUND_COLOUR: "#d58abd",
}

#: A picture without type: plotly ships no type information.
Plot = Any


def styled(plot: Plot, height: int) -> Plot:
    """Give a plot the look of all plots; its background is that of the page."""
    clear = "rgba(0,0,0,0)"
    plot.update_layout(
        template="none",
        height=height,
        margin={"l": 62, "r": 10, "t": 46, "b": 46},
        font={"size": 13, "color": INK, "family": "system-ui, -apple-system, sans-serif"},
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0.0, "bgcolor": clear},
        paper_bgcolor=clear,
        plot_bgcolor=clear,
        hovermode="closest",
    )
    axes = {
        "zeroline": False, "showline": True, "linecolor": AXIS, "mirror": True, "ticks": "outside",
        "tickcolor": AXIS, "ticklen": 4, "gridcolor": GRID, "title_standoff": 8,
    }  # fmt: skip
    plot.update_xaxes(**axes)
    plot.update_yaxes(**axes)
    return plot


def logarithmic(values: tuple[float, float]) -> dict[str, Any]:
    """Return the settings of a logarithmic axis over `values`, labelled without crowding."""
    low, high = values
    if high < 50.0 * low:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        ticks = [digit * 10.0**power for power in powers for digit in (1, 2, 5)]
        return {"type": "log", "tickvals": ticks, "ticktext": [number(t, 1) for t in ticks]}
    written = "none" if low >= 1e-3 and high < 1e5 else "power"
    return {"type": "log", "dtick": 1, "exponentformat": written}
