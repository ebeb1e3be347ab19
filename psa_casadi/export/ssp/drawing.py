"""The wiring of a system as a picture, drawn by matplotlib as SVG or PNG."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from pathlib import Path

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from psa_casadi.errors import InputError
from psa_casadi.export.ssp.structure import WiredParts
from psa_casadi.files import atomic_path

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
class Box:
    """The rectangle of a part, lower left and upper right corner, and its ports from the top."""

    name: str
    x1: float
    y1: float
    x2: float
    y2: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


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


def arrange(parts: Sequence[str], wires: Sequence[Wire]) -> Layout:
    """Return the drawing of a system from the names of its parts, in their order, and its wires."""
    ports = {name: _ports(name, wires) for name in (*parts, OUTSIDE)}
    columns = {name: k for k, name in enumerate(parts)}
    routes = [_channels(w, columns) for w in wires]
    slots = _numbered(len(parts) + 1, routes)
    counts = [sum(c in route for route in routes) for c in range(len(parts) + 1)]
    boxes = _boxes(parts, ports, counts)
    width = boxes[-1].x2 + _EDGE + _GAP + _PITCH / 2 * counts[-1]
    places = {
        Port(b.name, name): (x, b.y2 - _TITLE - _PITCH * k)
        for b in boxes
        for x, names in ((b.x1, b.inputs), (b.x2, b.outputs))
        for k, name in enumerate(names)
    }
    lanes = _lanes(routes, min(b.y1 for b in boxes), max(b.y2 for b in boxes))
    places |= _edges(wires, lanes, places, width)
    starts = [_EDGE if c == 0 else boxes[c - 1].x2 + _GAP for c in range(len(parts) + 1)]
    paths = []
    for wire, route, lane, slot in zip(wires, routes, lanes, slots, strict=True):
        (begin, end), (first, last) = (places[wire.start], places[wire.end]), slot
        left = starts[route[0]] + _PITCH / 2 * first
        right = starts[route[1]] + _PITCH / 2 * last
        level = begin[1] if lane is None else lane
        corners = (begin, (left, begin[1]), (left, level), (right, level), (right, end[1]), end)
        paths.append(_corners(corners))
    heights = [y for path in paths for _, y in path]
    lower = min([*heights, *(b.y1 for b in boxes)]) - _PITCH
    upper = max([*heights, *(b.y2 for b in boxes)]) + _PITCH
    return Layout(lower, upper, width, boxes, places, tuple(wires), tuple(paths))


def _ports(part: str, wires: Sequence[Wire]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the connected inputs and outputs of a part, or of the system."""
    ends = tuple(dict.fromkeys(w.end.name for w in wires if w.end.part == part))
    starts = tuple(dict.fromkeys(w.start.name for w in wires if w.start.part == part))
    return ends, starts


def _channels(wire: Wire, columns: Mapping[str, int]) -> tuple[int, int]:
    """Return the gaps in the row through which a wire leaves and arrives; 0 is at the left edge."""
    leaves = 0 if wire.start.part == OUTSIDE else columns[wire.start.part] + 1
    arrives = len(columns) if wire.end.part == OUTSIDE else columns[wire.end.part]
    return leaves, arrives


def _numbered(gaps: int, routes: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the number of each wire in the gaps where it leaves and arrives."""
    used = [0] * gaps
    found = []
    for leaves, arrives in routes:
        first = used[leaves]
        used[leaves] += 1
        last = first
        if arrives != leaves:
            last = used[arrives]
            used[arrives] += 1
        found.append((first, last))
    return found


def _boxes(
    parts: Sequence[str],
    ports: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]],
    counts: Sequence[int],
) -> tuple[Box, ...]:
    boxes, x = [], _EDGE
    for name, count in zip(parts, counts, strict=False):
        inputs, outputs = ports[name]
        longest = max((len(n) for n in inputs), default=0)
        longest += max((len(n) for n in outputs), default=0)
        width = max(_CHAR * (longest + 4), 2.6 * (len(name) + 2))
        height = _TITLE + _PITCH * max(len(inputs), len(outputs))
        x += _GAP + _PITCH / 2 * max(count, 1)
        boxes.append(Box(name, x, -height, x + width, 0.0, inputs, outputs))
        x += width
    return tuple(boxes)


def _lanes(routes: Sequence[tuple[int, int]], bottom: float, top: float) -> list[float | None]:
    """Return the height of the lane of each wire; None for one that goes straight."""
    above = below = 0
    lanes: list[float | None] = []
    for leaves, arrives in routes:
        if leaves == arrives:
            lanes.append(None)
        elif arrives > leaves:
            above += 1
            lanes.append(top + _PITCH * above)
        else:
            below += 1
            lanes.append(bottom - _PITCH * below)
    return lanes


def _edges(
    wires: Sequence[Wire],
    lanes: Sequence[float | None],
    places: Mapping[Port, Point],
    width: float,
) -> dict[Port, Point]:
    """Return the places of the system's own ports: level with their first wire."""
    found: dict[Port, Point] = {}
    for wire, lane in zip(wires, lanes, strict=True):
        for port, other, x in ((wire.start, wire.end, 0.0), (wire.end, wire.start, width)):
            if port.part == OUTSIDE and port not in found:
                found[port] = (x, places[other][1] if lane is None else lane)
    return found


def _corners(points: Sequence[Point]) -> tuple[Point, ...]:
    """Return a polyline without repeated points and without corners on a straight line."""
    kept = [points[0]]
    kept += [b for a, b in pairwise(points) if a != b]
    inner = [
        b
        for a, b, c in zip(kept, kept[1:], kept[2:], strict=False)
        if not (a[0] == b[0] == c[0] or a[1] == b[1] == c[1])
    ]
    return (kept[0], *inner, kept[-1])


_INK, _FACE, _EDGE_wiring_picture, _LANE, _FEEDBACK = (
    "#222222",
    "#eef3f7",
    "#5b666f",
    "#0072b2",
    "#d55e00",
)
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
        axes.add_patch(
            Rectangle(corner, *extent, facecolor=_FACE, edgecolor=_EDGE_wiring_picture, zorder=2)
        )
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
    return [
        (point, _EDGE_wiring_picture if p.part else _LANE) for p, point in layout.places.items()
    ]


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
