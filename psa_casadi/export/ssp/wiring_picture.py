"""The wiring of a system as a picture, drawn by matplotlib as SVG or PNG."""

import os
from io import BytesIO
from pathlib import Path

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from psa_casadi.errors import InputError
from psa_casadi.export.ssp.layout import OUTSIDE, Layout, Point, Port
from psa_casadi.export.ssp.structure import WiredParts
from psa_casadi.files import atomic_path

_INK, _FACE, _EDGE, _LANE, _FEEDBACK = "#222222", "#eef3f7", "#5b666f", "#0072b2", "#d55e00"
_FONT, _TITLE_FONT, _MARGIN = 3.1, 4.2, 8.0
#: Points on a drawing's unit of length, and pixels on an inch.
_SCALE, _DPI = 2.83, 200
#: Letters stay letters, and the same drawing gives the same bytes.
_SVG = {"svg.fonttype": "none", "svg.hashsalt": "psa_casadi"}


def save_wiring(wiring: WiredParts, layout: Layout, path: str | os.PathLike[str]) -> Path:
    """Write the wiring as SVG or PNG, by the suffix of the path.

    Raises InputError for another suffix, or if the path cannot be written to.
    """
    target, kind = Path(path), Path(path).suffix.lower().removeprefix(".")
    if kind not in ("svg", "png"):
        raise InputError(f"{target}: a picture of the wiring is .svg or .png; name it so.")
    with atomic_path(target) as temporary:
        temporary.write_bytes(wiring_picture(wiring, layout, kind))
    return target


def wiring_picture(wiring: WiredParts, layout: Layout, kind: str) -> bytes:
    """Return the wiring as svg or png: boxes, ports with units, wires."""
    content = BytesIO()
    undated = {"Date": None} if kind == "svg" else None
    with rc_context(_SVG):
        _figure(wiring, layout).savefig(content, format=kind, dpi=_DPI, metadata=undated)
    return content.getvalue()


def _figure(wiring: WiredParts, layout: Layout) -> Figure:
    left, bottom, width, height = _extent(layout)
    figure = Figure(figsize=(width * _SCALE / 72.0, height * _SCALE / 72.0))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(left, left + width)
    axes.set_ylim(bottom, bottom + height)
    axes.set_axis_off()
    for path, colour in _wires(layout):
        axes.plot([x for x, _ in path], [y for _, y in path], color=colour, linewidth=1.4)
    for b in layout.boxes:
        corner, extent = (b.x1, b.y1), (b.x2 - b.x1, b.y2 - b.y1)
        axes.add_patch(Rectangle(corner, *extent, facecolor=_FACE, edgecolor=_EDGE, zorder=2))
    for point, colour in _dots(layout):
        axes.add_patch(Circle(point, 0.9, color=colour, zorder=3))
    sides = {"start": "left", "middle": "center", "end": "right"}
    for text, (x, y), anchor, bold in _labels(wiring, layout):
        size = (_TITLE_FONT if bold else _FONT) * _SCALE
        axes.text(
            x, y, text, fontsize=size, ha=sides[anchor], va="center", color=_INK, zorder=4,
            fontweight="bold" if bold else "normal",
        )  # fmt: skip
    return figure


def _extent(layout: Layout) -> tuple[float, float, float, float]:
    """Return left, bottom, width and height of the picture, with room for the outer labels."""
    outer = [len(p.name) for p in layout.places if p.part == OUTSIDE]
    side = _MARGIN + 1.9 * (max(outer, default=0) + 5)
    height = layout.upper - layout.lower + _MARGIN
    return -side, layout.lower - _MARGIN / 2, layout.width + 2.0 * side, height


def _wires(layout: Layout) -> list[tuple[tuple[Point, ...], str]]:
    """Return the paths with their colours: those that lead back stand out."""
    order = {b.name: k for k, b in enumerate(layout.boxes)}
    last = len(order)
    return [
        (path, _FEEDBACK if order.get(w.end.part, last) <= order.get(w.start.part, -1) else _LANE)
        for w, path in zip(layout.wires, layout.paths, strict=True)
    ]


def _dots(layout: Layout) -> list[tuple[Point, str]]:
    return [(point, _EDGE if p.part else _LANE) for p, point in layout.places.items()]


def _labels(wiring: WiredParts, layout: Layout) -> list[tuple[str, Point, str, bool]]:
    """Return text, place, anchor and weight of all labels."""
    found = [
        (b.name.replace("_", " "), ((b.x1 + b.x2) / 2, b.y2 - 4.5), "middle", True)
        for b in layout.boxes
    ]
    lefts = {Port(b.name, n) for b in layout.boxes for n in b.inputs}
    for port, (x, y) in layout.places.items():
        unit = wiring.unit(port)
        text = f"{port.name} [{unit}]" if unit and port.part == OUTSIDE else port.name
        begins = port in lefts if port.part else x > 0.0
        shift = 2.2 if begins else -2.2
        found.append((text, (x + shift, y), "start" if begins else "end", False))
    return found
