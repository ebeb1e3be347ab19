"""A plot, described once in plotly's terms: pages give it to plotly, pictures to matplotlib."""

import base64
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from psa_casadi.common.characters import plain as carried
from psa_casadi.report.words import colours
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.series import compact

_CLEAR = "rgba(0,0,0,0)"
_LOOK = {
    "margin": {"l": 62, "r": 10, "t": 46, "b": 46},
    "font": {"size": 13, "color": colours.INK, "family": "system-ui, -apple-system, sans-serif"},
    "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0.0, "bgcolor": _CLEAR},
    "paper_bgcolor": _CLEAR,
    "plot_bgcolor": _CLEAR,
    "hovermode": "closest",
}
_AXIS_LOOK = {
    "zeroline": False, "showline": True, "linecolor": colours.AXIS, "mirror": True,
    "ticks": "outside", "tickcolor": colours.AXIS, "ticklen": 4, "gridcolor": colours.GRID,
}  # fmt: skip
#: Arrays of fewer numbers are written as numbers.
_SHORT = 40
#: What holds words that somebody else may have written.
_WORDS = ("name", "text", "hovertext", "ticktext", "x", "y", "categoryarray")

#: The look of pictures by matplotlib: font, and points for a pixel of plotly.
FONT, _POINTS = 13.0, 0.9
_DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}
_SYMBOLS = {"circle": "o", "square": "s", "diamond": "D", "triangle-up": "^", "x": "x"}

Settings = Mapping[str, Any]


class Panel:
    """Traces, lines across, shaded bands and two axes; `data` and `layout` are plotly's."""

    def __init__(self, x: str = "", y: str = "", height: int = 330, **layout: Any) -> None:
        self.data: list[dict[str, Any]] = []
        axes = {
            f"{which}axis": {**_AXIS_LOOK, "title": {"text": text, "standoff": 8}}
            for which, text in (("x", x), ("y", y))
        }
        self.layout: dict[str, Any] = {**_LOOK, "height": height, **axes, "shapes": [], **layout}

    def line(
        self, x: Any, y: Any, name: str = "", colour: str = colours.EXTENDED, width: float = 1.4,
        dash: str = "solid", **more: Any,
    ) -> "Panel":  # fmt: skip
        """Add a line; `more` are settings of plotly's scatter trace."""
        look = {"color": colour, "width": width, "dash": dash}
        return self._scatter("lines", x, y, name, line=look, **more)

    def marks(
        self, x: Any, y: Any, name: str = "", colour: str = colours.EXTENDED, size: float = 6,
        symbol: str = "circle", **more: Any,
    ) -> "Panel":  # fmt: skip
        """Add markers, and with `line` a line through them."""
        look = {"color": colour, "size": size, "symbol": symbol}
        mode = "lines+markers" if "line" in more else "markers"
        return self._scatter(mode, x, y, name, marker=look, **more)

    def texts(self, x: Any, y: Any, texts: Sequence[str], position: str, **more: Any) -> "Panel":
        """Add texts next to points."""
        return self._scatter(
            "text", x, y, "", text=list(texts), textposition=position, hoverinfo="skip", **more
        )

    def bars(self, values: Any, names: Any, name: str, fill: Any, **more: Any) -> "Panel":
        """Add horizontal bars."""
        look = {"color": fill} if isinstance(fill, str | list) else fill
        self.data.append(
            {"type": "bar", "orientation": "h", "x": values, "y": names, "name": name,
             "showlegend": bool(name), "marker": look, **more}
        )  # fmt: skip
        return self

    def across(
        self, *heights: float, name: str = "", colour: str = colours.INK, dash: str = "dash",
        width: float = 1.2,
    ) -> "Panel":  # fmt: skip
        """Add lines over the whole width."""
        ends, look = {"xref": "x domain", "x0": 0, "x1": 1}, (colour, dash, width)
        return self._lines(name, [{**ends, "y0": y, "y1": y} for y in heights], look)

    def upright(
        self, *places: float, colour: str = colours.AXIS, dash: str = "dot", width: float = 1.2
    ) -> "Panel":
        """Add lines over the whole height."""
        ends, look = {"yref": "y domain", "y0": 0, "y1": 1}, (colour, dash, width)
        return self._lines("", [{**ends, "x0": x, "x1": x} for x in places], look)

    def bands(self, spans: Iterable[tuple[float, float]], name: str = "") -> "Panel":
        """Shade stretches over the whole height."""
        for low, high in spans:
            place = {"yref": "y domain", "y0": 0, "y1": 1, "x0": low, "x1": high}
            self.layout["shapes"].append(
                {"type": "rect", "name": name, "fillcolor": colours.HELD_OUT, "layer": "below",
                 "line": {"width": 0}, **place}
            )  # fmt: skip
        return self

    def axes(self, x: Settings | None = None, y: Settings | None = None, **layout: Any) -> "Panel":
        """Change settings of plotly's axes and layout."""
        self.layout["xaxis"].update(x or {})
        self.layout["yaxis"].update(y or {})
        self.layout.update(layout)
        return self

    def _scatter(self, mode: str, x: Any, y: Any, name: str, **more: Any) -> "Panel":
        self.data.append({"type": "scatter", "mode": mode, "x": x, "y": y, "name": name,
                          "showlegend": bool(name), **more})  # fmt: skip
        return self

    def _lines(
        self, name: str, places: Iterable[Settings], look: tuple[str, str, float]
    ) -> "Panel":
        line = dict(zip(("color", "dash", "width"), look, strict=True))
        self.layout["shapes"] += [{"type": "line", "name": name, "line": line, **p} for p in places]
        return self


def stacked(above: Panel, below: Panel, height: int) -> Panel:
    """Return both plots in one, over the same x."""
    both = Panel(height=height)
    both.data = [*above.data, *({**t, "yaxis": "y2", "showlegend": False} for t in below.data)]
    for part, axis in ((above.layout, "y"), (below.layout, "y2")):
        both.layout["shapes"] += [
            {**s, "yref": s.get("yref", "y").replace("y", axis)}
            | ({"xref": "x domain"} if s.get("xref") else {})
            for s in part["shapes"]
        ]
    both.layout["yaxis"] = {**above.layout["yaxis"], "domain": [0.44, 1.0]}
    both.layout["yaxis2"] = {**below.layout["yaxis"], "domain": [0.0, 0.37]}
    both.layout["xaxis"] = {**below.layout["xaxis"], "anchor": "y2", "mirror": "all"}
    return both


def logarithmic(values: tuple[float, float]) -> dict[str, Any]:
    """Return the settings of a logarithmic axis over `values`, labelled without crowding."""
    low, high = values
    if high < 50.0 * low:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        ticks = [digit * 10.0**power for power in powers for digit in (1, 2, 5)]
        return {"type": "log", "tickvals": ticks, "ticktext": [number(t, 1) for t in ticks]}
    written = "none" if low >= 1e-3 and high < 1e5 else "power"
    return {"type": "log", "dtick": 1, "exponentformat": written}


def plotly_figure(panel: Panel, hold: Callable[[str], Any] = str) -> dict[str, Any]:
    """Return the figure for plotly; `hold` stores a long array and returns its key."""
    content: dict[str, Any] = _encoded({"data": panel.data, "layout": panel.layout}, "", hold)
    return content


def _encoded(value: Any, key: str, hold: Callable[[str], Any]) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
        if value.size < _SHORT:
            return [float(v) if math.isfinite(v) else None for v in value]
        small = compact(value.astype(np.float64))
        kept = base64.b64encode(np.ascontiguousarray(small).tobytes()).decode("ascii")
        return {"dtype": f"f{small.itemsize}", "bdata": hold(kept)}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {k: _encoded(v, k, hold) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_encoded(v, key, hold) for v in value]
    if isinstance(value, str) and key in _WORDS:
        return label(value)
    return float(value) if isinstance(value, np.floating) else value


def label(name: str) -> str:
    """Return a name as plotly shows it: text, never markup, broken where it has a line end."""
    return "<br>".join(escape(carried(part), quote=False) for part in name.split("\n"))


def sheet(size: tuple[float, float], dpi: float, **how: Any) -> Figure:
    """Return an empty picture of a size in inches."""
    figure = Figure(figsize=size, dpi=dpi, **{"layout": "constrained", **how})
    FigureCanvasAgg(figure)
    return figure


def draw(
    axes: Axes, panel: Panel, title: str = "", *, legend: Settings | None = None, font: float = FONT
) -> None:
    """Draw a plot by matplotlib; without settings for a `legend` there is none."""
    for trace in panel.data:
        _draw_trace(axes, trace, font)
    for shape in panel.layout["shapes"]:
        _draw_shape(axes, shape)
    for which in ("x", "y"):
        _draw_axis(axes, which, panel.layout[f"{which}axis"])
    style(axes, title, *(panel.layout[f"{w}axis"]["title"]["text"] for w in "xy"), font=font)
    if legend is not None:
        axes.legend(**{"fontsize": font - 1, "framealpha": 0.85, **legend})


def style(axes: Axes, title: str, x: str, y: str, *, font: float = FONT) -> None:
    """Give axes the title, labels and look that all pictures share."""
    axes.set_title(title, fontsize=font + 1, loc="left")
    axes.set_xlabel(x, fontsize=font)
    axes.set_ylabel(y, fontsize=font)
    axes.tick_params(labelsize=font - 1)
    axes.grid(visible=True, color="#dddddd", linewidth=0.8)
    axes.set_axisbelow(True)


def _draw_trace(axes: Axes, t: Settings, font: float) -> None:
    label_text = t["name"] if t.get("showlegend", True) else None
    if t["type"] == "bar":
        axes.barh(t["y"], t["x"], color=t["marker"]["color"], label=label_text)
        return
    if t["mode"] == "text":
        for x, y, text in zip(t["x"], t["y"], t["text"], strict=True):
            axes.annotate(text, (x, y), va="center", fontsize=font - 1.5)
        return
    line, marker = t.get("line"), t.get("marker")
    look = line or marker or {}
    errors = t.get("error_y")
    axes.errorbar(
        t["x"], t["y"], yerr=None if errors is None else errors["array"], label=label_text,
        color=look["color"], linestyle=_DASHES[line.get("dash", "solid")] if line else "none",
        linewidth=_POINTS * line["width"] if line else 0.0, elinewidth=0.8,
        marker=_SYMBOLS[marker.get("symbol", "circle")] if marker else None,
        markersize=marker["size"] if marker else None,
        markeredgewidth=0.0 if marker else None,
        markerfacecolor=marker["color"] if marker else None,
    )  # fmt: skip


def _draw_shape(axes: Axes, s: Settings) -> None:
    name = s["name"] if s["name"] not in axes.get_legend_handles_labels()[1] else None
    if s["type"] == "rect":
        axes.axvspan(s["x0"], s["x1"], color=s["fillcolor"], label=name or None, zorder=0)
        return
    look = {"color": s["line"]["color"], "linestyle": _DASHES[s["line"]["dash"]]}
    put, place = (axes.axhline, s["y0"]) if "xref" in s else (axes.axvline, s["x0"])
    put(place, linewidth=_POINTS * s["line"]["width"], label=name or None, **look)


def _draw_axis(axes: Axes, which: str, settings: Settings) -> None:
    log = settings.get("type") == "log"
    if log:
        axes.set(**{f"{which}scale": "log"})
    if "range" in settings:
        axes.set(**{f"{which}lim": [10.0**v if log else v for v in settings["range"]]})
    if "tickvals" in settings:
        getattr(axes, f"set_{which}ticks")(settings["tickvals"], labels=settings["ticktext"])
    if settings.get("showticklabels") is False:
        getattr(axes, f"set_{which}ticks")([])
