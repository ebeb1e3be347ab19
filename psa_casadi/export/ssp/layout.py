"""Where the parts of a system stand in its drawing, and which way its wires go.

The parts stand in one row, in the order of the signal flow. A wire to the next part goes straight;
one that skips a part runs in a lane above the row, one that goes back runs in a lane below it.
Every wire has its own lane and its own place between two parts, so that no two wires lie on each
other. Lengths have no unit; x points right, y up, as in SSP.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

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
