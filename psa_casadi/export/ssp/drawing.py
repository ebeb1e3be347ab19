"""The wiring of a system as a picture, drawn by matplotlib as SVG or PNG."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from psa_casadi.errors import InputError
from psa_casadi.files import atomic_path
from psa_casadi.model.compose import Model
from psa_casadi.variables import Publication

Point = tuple[float, float]

#: Name of the system itself where the name of a part is asked for.
OUTSIDE = ""

_PITCH, _TITLE, _GAP, _CHAR, _EDGE = 8.0, 12.0, 6.0, 2.0, 12.0


@dataclass(frozen=True)
class Port:
    """A port of a part, or of the system itself where `part` is `OUTSIDE`."""

    part: str
    name: str


@dataclass(frozen=True)
class Wire:
    """A connection from an output (or the system's input) to an input (or the system's output)."""

    start: Port
    end: Port


@dataclass(frozen=True)
class WiredParts:
    """A system as SSP sees it: models by the names of the parts, wires, and its own ports.

    A wire from or to `OUTSIDE` makes a port of the system, with the unit of the part's port.
    """

    name: str
    parts: Mapping[str, Model]
    wires: tuple[Wire, ...]
    publication: Publication = field(default_factory=Publication)

    def unit(self, port: Port) -> str:
        """Return the unit of a port; that of the system is the unit of what it is wired to."""
        if port.part == OUTSIDE:
            ends = [w.end for w in self.wires if w.start == port]
            port = ends[0] if ends else next(w.start for w in self.wires if w.end == port)
        s = self.parts[port.part].structure
        units = {v.name: v.unit for v in s.inputs} | {v.name: v.unit for v in s.outputs}
        return units[port.name]

    def ports(self, part: str) -> tuple[tuple[str, str], ...]:
        """Return (name, kind) of the connected ports of a part, or of the system, inputs first."""
        ends = dict.fromkeys(w.end.name for w in self.wires if w.end.part == part)
        starts = dict.fromkeys(w.start.name for w in self.wires if w.start.part == part)
        if part == OUTSIDE:
            ends, starts = starts, ends
        return (*((n, "input") for n in ends), *((n, "output") for n in starts))


@dataclass(frozen=True)
class Box:
    """The rectangle of a part: lower left and upper right corner."""

    name: str
    x1: float
    y1: float
    x2: float
    y2: float


@dataclass(frozen=True)
class Layout:
    """A drawing: its extent, the boxes, the places of all ports, and the way of each wire.

    `paths` holds the corners of each wire, both ends included, in the order of the wires.
    """

    lower: float
    upper: float
    width: float
    boxes: tuple[Box, ...]
    places: Mapping[Port, Point]
    wires: tuple[Wire, ...]
    paths: tuple[tuple[Point, ...], ...]

    def relative(self, port: Port) -> Point:
        """Return the place of a port in its box, or in the drawing: 0, 0 to 1, 1."""
        x, y = self.places[port]
        box = next((b for b in self.boxes if b.name == port.part), None)
        if box is None:
            return x / self.width, (y - self.lower) / (self.upper - self.lower)
        return (x - box.x1) / (box.x2 - box.x1), (y - box.y1) / (box.y2 - box.y1)


def layout_of(wiring: WiredParts) -> Layout:
    """Return the drawing of a system: its parts in a row, ports of its own level with a wire."""
    routes, counts = _routes(wiring)
    boxes = _boxes(wiring, counts)
    width = boxes[-1].x2 + _EDGE + _GAP + _PITCH / 2 * counts[-1]
    places: dict[Port, Point] = {}
    for b in boxes:
        for kind, x in (("input", b.x1), ("output", b.x2)):
            names = [n for n, found in wiring.ports(b.name) if found == kind]
            for k, name in enumerate(names):
                places[Port(b.name, name)] = (x, b.y2 - _TITLE - _PITCH * k)
    starts = [_EDGE, *(b.x2 + _GAP for b in boxes)]
    bottom, above, below, paths = min(b.y1 for b in boxes), 0, 0, []
    for wire, ((leaves, first), (arrives, last)) in zip(wiring.wires, routes, strict=True):
        lane = None  # where it does not go straight
        if arrives > leaves:
            above += 1
            lane = _PITCH * above
        elif arrives < leaves:
            below += 1
            lane = bottom - _PITCH * below
        for port, other, x in ((wire.start, wire.end, 0.0), (wire.end, wire.start, width)):
            if port not in places:
                places[port] = (x, places[other][1] if lane is None else lane)
        begin, end = places[wire.start], places[wire.end]
        left, right = starts[leaves] + _PITCH / 2 * first, starts[arrives] + _PITCH / 2 * last
        level = begin[1] if lane is None else lane
        corners = (begin, (left, begin[1]), (left, level), (right, level), (right, end[1]), end)
        paths.append(_corners(corners))
    heights = [y for path in paths for _, y in path]
    lower, upper = min([*heights, bottom]) - _PITCH, max([*heights, 0.0]) + _PITCH
    return Layout(lower, upper, width, boxes, places, wiring.wires, tuple(paths))


def _routes(wiring: WiredParts) -> tuple[list[tuple[tuple[int, int], tuple[int, int]]], list[int]]:
    """Return gap and number in it where each wire leaves and arrives, and the wires in each gap.

    The gaps in the row are numbered from 0 at the left edge.
    """
    columns = {name: k for k, name in enumerate(wiring.parts)}
    used, routes = [0] * (len(columns) + 1), []
    for wire in wiring.wires:
        leaves = columns.get(wire.start.part, -1) + 1
        arrives = columns.get(wire.end.part, len(columns))
        routes.append(((leaves, used[leaves]), (arrives, used[arrives])))
        for gap in {leaves, arrives}:
            used[gap] += 1
    return routes, used


def _boxes(wiring: WiredParts, counts: Sequence[int]) -> tuple[Box, ...]:
    boxes, x = [], _EDGE
    for name, count in zip(wiring.parts, counts, strict=False):
        ports = wiring.ports(name)
        sides = [[n for n, found in ports if found == kind] for kind in ("input", "output")]
        longest = sum(max(map(len, side), default=0) for side in sides)
        width = max(_CHAR * (longest + 4), 2.6 * (len(name) + 2))
        x += _GAP + _PITCH / 2 * max(count, 1)
        boxes.append(Box(name, x, -_TITLE - _PITCH * max(map(len, sides)), x + width, 0.0))
        x += width
    return tuple(boxes)


def _corners(points: Sequence[Point]) -> tuple[Point, ...]:
    """Return a polyline without repeated points and without corners on a straight line."""
    kept = [points[0], *(b for a, b in pairwise(points) if a != b)]
    inner = [
        b
        for a, b, c in zip(kept, kept[1:], kept[2:], strict=False)
        if not (a[0] == b[0] == c[0] or a[1] == b[1] == c[1])
    ]
    return (kept[0], *inner, kept[-1])


_INK, _FACE, _FRAME, _LANE, _FEEDBACK = "#222222", "#eef3f7", "#5b666f", "#0072b2", "#d55e00"
_FONT, _TITLE_FONT, _MARGIN = 3.1, 4.2, 8.0
#: Points on a drawing's unit of length, and pixels on an inch.
_SCALE, _DPI = 2.83, 200


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
    # letters stay letters, and the same drawing gives the same bytes
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "psa_casadi"}):
        _figure(wiring, layout).savefig(content, format=kind, dpi=_DPI, metadata=undated)
    return content.getvalue()


def _figure(wiring: WiredParts, layout: Layout) -> Figure:
    """Draw boxes, wires and labels, with room for the outer labels."""
    outer = [len(p.name) for p in layout.places if p.part == OUTSIDE]
    side = _MARGIN + 1.9 * (max(outer, default=0) + 5)
    bottom, width = layout.lower - _MARGIN / 2, layout.width + 2.0 * side
    height = layout.upper - layout.lower + _MARGIN
    figure = Figure(figsize=(width * _SCALE / 72.0, height * _SCALE / 72.0))
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(-side, -side + width)
    axes.set_ylim(bottom, bottom + height)
    axes.set_axis_off()
    order = {b.name: k for k, b in enumerate(layout.boxes)}
    for w, path in zip(layout.wires, layout.paths, strict=True):  # what leads back stands out
        back = order.get(w.end.part, len(order)) <= order.get(w.start.part, -1)
        axes.plot(*zip(*path, strict=True), color=_FEEDBACK if back else _LANE, linewidth=1.4)
    style: dict[str, Any] = {"va": "center", "color": _INK, "zorder": 4}
    for b in layout.boxes:
        extent = (b.x2 - b.x1, b.y2 - b.y1)
        axes.add_patch(
            Rectangle((b.x1, b.y1), *extent, facecolor=_FACE, edgecolor=_FRAME, zorder=2)
        )
        axes.text(
            (b.x1 + b.x2) / 2, b.y2 - 4.5, b.name.replace("_", " "), ha="center",
            fontsize=_TITLE_FONT * _SCALE, fontweight="bold", **style,
        )  # fmt: skip
    lefts = {b.name: b.x1 for b in layout.boxes}
    for p, (x, y) in layout.places.items():
        axes.add_patch(Circle((x, y), 0.9, color=_FRAME if p.part else _LANE, zorder=3))
        unit = wiring.unit(p)
        text = f"{p.name} [{unit}]" if unit and p.part == OUTSIDE else p.name
        begins = x == lefts[p.part] if p.part else x > 0.0
        axes.text(
            x + (2.2 if begins else -2.2), y, text, ha="left" if begins else "right",
            fontsize=_FONT * _SCALE, **style,
        )  # fmt: skip
    return figure
