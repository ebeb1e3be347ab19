"""A system of models as an SSP archive: an FMU for each part, wires, parameters, a drawing.

Source: SSP 1.0, section 4.1 (packaging).
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from psa_casadi.common.characters import check_text
from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_path, temporary_folder
from psa_casadi.common.units import FloatArray, parse_unit
from psa_casadi.export.common import markup
from psa_casadi.export.common.parameter_sets import Row, parameter_rows, set_text
from psa_casadi.export.common.templates import filled
from psa_casadi.export.fmu.archive import export_fmu, write_archive
from psa_casadi.model.compose import Model
from psa_casadi.model.system import System
from psa_casadi.model.variables import Publication

Point = tuple[float, float]

#: Name of the system itself in the place of the name of a part.
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
    """A system as SSP has it: models by the names of the parts, wires, and the system's ports.

    A wire from or to `OUTSIDE` makes a port of the system, with the unit of the part's port.
    `names` are other names of ports in their FMU.
    """

    name: str
    parts: Mapping[str, Model]
    wires: tuple[Wire, ...]
    publication: Publication = field(default_factory=Publication)
    names: Mapping[Port, str] = field(default_factory=dict)

    def called(self, port: Port) -> str:
        """Return the name of a port in its FMU."""
        return self.names.get(port, port.name)

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

    `paths` holds the corners of each wire, both ends included, in the order of the wiring's.
    """

    lower: float
    upper: float
    width: float
    boxes: tuple[Box, ...]
    places: Mapping[Port, Point]
    paths: tuple[tuple[Point, ...], ...]

    def relative(self, port: Port) -> Point:
        """Return the place of a port in its box, or in the drawing: 0, 0 to 1, 1."""
        x, y = self.places[port]
        box = next((b for b in self.boxes if b.name == port.part), None)
        if box is None:
            return x / self.width, (y - self.lower) / (self.upper - self.lower)
        return (x - box.x1) / (box.x2 - box.x1), (y - box.y1) / (box.y2 - box.y1)


def layout_of(wiring: WiredParts) -> Layout:
    """Return the drawing of a system: its parts in a row, the system's ports level with a wire."""
    routes, counts = _routes(wiring)
    boxes = _boxes(wiring, counts)
    width = boxes[-1].x2 + _EDGE + _GAP + _PITCH / 2 * counts[-1]
    places: dict[Port, Point] = {}
    for b in boxes:
        for kind, x in (("input", b.x1), ("output", b.x2)):
            names = [n for n, result in wiring.ports(b.name) if result == kind]
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
    return Layout(lower, upper, width, boxes, places, tuple(paths))


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
        sides = [[n for n, result in ports if result == kind] for kind in ("input", "output")]
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
    for w, path in zip(wiring.wires, layout.paths, strict=True):  # feedback has its colour
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
        starts = x == lefts[p.part] if p.part else x > 0.0
        axes.text(
            x + (2.2 if starts else -2.2), y, text, ha="left" if starts else "right",
            fontsize=_FONT * _SCALE, **style,
        )  # fmt: skip
    return figure


#: Relative tolerance that its master asks of the parts.
TOLERANCE = 1e-6
#: Rows of its table of results.
_ROWS = 1000
#: What SSP calls otherwise than FMI does.
_PUBLISHED = {"version": "fileversion"}


@dataclass(frozen=True)
class Binding:
    """Files in the archive that set parameters: of one part, or of the system (`OUTSIDE`)."""

    part: str
    values: str
    mapping: str | None = None


def _decimal(value: float) -> str:
    """Return a number without exponent."""
    return f"{value:.15f}".rstrip("0")


def _place(*values: float) -> str:
    return " ".join(f"{round(value, 6):.6g}" for value in values)


def shared_parameters(parts: Mapping[str, Model]) -> dict[str, tuple[str, ...]]:
    """Return the parts of each shared parameter by its name: same name, unit and value."""
    owners: dict[tuple[str, str, float], list[str]] = {}
    for part, model in parts.items():
        for p in model.structure.parameters:
            owners.setdefault((p.name, p.unit, model.values[p.name]), []).append(part)
    names = [name for name, _, _ in owners]
    return {
        name: tuple(result)
        for (name, _, _), result in owners.items()
        if len(result) > 1 and names.count(name) == 1
    }


def parameter_files(
    parts: Mapping[str, Model], name: str
) -> tuple[dict[str, bytes], tuple[Binding, ...]]:
    """Return the files of all parameter sets by their place in the archive, and their bindings."""
    shared = shared_parameters(parts)
    entries: dict[str, str] = {}
    bindings, lifted = [], dict[str, Row]()
    for part, model in parts.items():
        rows = parameter_rows(model)
        items = [row for row in rows if part not in shared.get(row[0], ())]
        lifted |= {row[0]: row for row in rows if row not in items and row[0] not in lifted}
        if items:
            place = f"resources/{part}.ssv"
            entries[place] = set_text(model.name, items)
            bindings.append(Binding(part, place))
    if lifted:
        values, mapping = "resources/shared.ssv", "resources/shared.ssm"
        entries[values] = set_text(f"{name}_shared", [lifted[n] for n in sorted(lifted)])
        pairs = [(n, f"{part}.{n}") for n in sorted(shared) for part in shared[n]]
        tool = markup.generation_tool()
        entries[mapping] = markup.xml_text("shared.xml", tool=tool, pairs=pairs)
        bindings.append(Binding(OUTSIDE, values, mapping))
    return {place: text.encode("utf-8") for place, text in entries.items()}, tuple(bindings)


#: Growth of a step below which a system counts as stable: memories have the radius 1 itself.
_GROWTH = 1e-7
_STEPS_IN_SEARCH = 200


@dataclass(frozen=True)
class Linear:
    """All parts at rest, side by side: x' = A x + B u, and inputs K x at a communication point."""

    A: FloatArray
    B: FloatArray
    K: FloatArray

    def growth(self, h: float, *, rates: bool) -> float:
        """Return the spectral radius of the map of the states over a communication step [s]."""
        nx, nu = self.B.shape
        chain = np.zeros((nx + 2 * nu, nx + 2 * nu))
        chain[:nx, :nx], chain[:nx, nx : nx + nu] = self.A, self.B
        chain[nx : nx + nu, nx + nu :] = np.eye(nu)
        flow = scipy.linalg.expm(chain * h)[:nx]
        step = flow[:, :nx] + flow[:, nx : nx + nu] @ self.K
        if rates:
            step = step + flow[:, nx + nu :] @ self.K @ (self.A + self.B @ self.K)
        return float(np.abs(np.linalg.eigvals(step)).max(initial=0.0))


def linear(wiring: WiredParts) -> Linear:
    """Return the parts at rest, each state and port in units of its nominal size.

    Sampled parts hold their outputs, so they take no part in a loop.
    """
    pieces = []
    for model in wiring.parts.values():
        s, size = model.structure, model.state_nominals()
        rest = [[v.start for v in group] for group in (s.states, s.inputs)]
        held = [[v.start for v in s.sampled]] if s.sampled else []
        result = s.slopes(0.0, *rest, model.parameter_vector(), *held)
        a, b, c, d = (np.array(m, dtype=float).reshape(m.shape) for m in result)
        pieces.append((a / size[:, None] * size, b / size[:, None], c * size, d))
    a, b, c, d = (scipy.linalg.block_diag(*(p[k] for p in pieces)) for k in range(4))
    ends = [Port(part, n) for part, model in wiring.parts.items() for n in model.input_names]
    starts = [Port(part, n) for part, model in wiring.parts.items() for n in model.output_names]
    wires = np.zeros((len(ends), len(starts)))
    for wire in wiring.wires:
        if OUTSIDE not in (wire.start.part, wire.end.part):
            wires[ends.index(wire.end), starts.index(wire.start)] = 1.0
    exchange = np.linalg.solve(np.eye(len(wires)) - wires @ d, wires @ c)
    return Linear(a, b, np.asarray(exchange, dtype=float))


def stable_step(wiring: WiredParts, *, rates: bool) -> float:
    """Return the longest communication step [s] up to which all shorter ones are stable.

    With `rates` inputs have slopes. Infinity if no loop turns unstable: at up to 100 times
    the time of the slowest ordinary mode.
    """
    system = linear(wiring)
    speeds = np.abs(np.linalg.eigvals(system.A + system.B @ system.K))
    speeds = speeds[speeds > 1e-6 * speeds.max(initial=0.0)]
    if not speeds.size:
        return float("inf")

    def excess(step: float) -> float:
        return system.growth(step, rates=rates) - 1.0 - _GROWTH

    steps = np.geomspace(1e-2 / speeds.max(), 1e2 / speeds.min(), _STEPS_IN_SEARCH)
    for stable, unstable in pairwise([0.0, *steps.tolist()]):
        if excess(unstable) > 0.0:
            return float(scipy.optimize.bisect(excess, stable, unstable, xtol=1e-12 * unstable))
    return float("inf")


def master_step(wiring: WiredParts, stop_time: float) -> float:
    """Return a communication step [s] for a master that holds the inputs: 1, 2 or 5 times 10^k.

    It is at most a twentieth of what stays stable, as the error of the coupling is of first order,
    and a thousandth of the time that is simulated.
    """
    longest = min(stable_step(wiring, rates=False) / 20.0, stop_time / 1000.0)
    size = 10.0 ** math.floor(math.log10(longest))
    return max(round(k * size, 15) for k in (1.0, 2.0, 5.0) if k * size <= longest)


#: Where the archive carries the picture of the wiring.
PICTURE_ENTRY = "documentation/wiring.svg"
#: What is simulated by default [s].
STOP_TIME = 0.1


def export_ssp(
    system: System,
    path: str | os.PathLike[str],
    *,
    platforms: Sequence[str] = ("host",),
    stop_time: float = STOP_TIME,
    publication: Publication | None = None,
) -> Path:
    """Write a system as an SSP archive (SSP 1.0, FMUs of FMI 2.0) and return its path.

    The archive holds `SystemStructure.ssd` with units, connectors, wires and their drawing; in
    `resources` the FMU of each part and the parameter sets; the picture of the wiring as SVG. The
    same system gives the same bytes. `platforms` are those of `export_fmu`. `publication` is
    who made the system and on what terms it is passed on, also for parts that state neither.

    Raises what `connect` and `export_fmu` raise.
    """
    system.model()
    wiring = wiring_of(system)
    if publication is not None:
        parts = {
            name: part if part.publication.stated else replace(part, publication=publication)
            for name, part in wiring.parts.items()
        }
        wiring = replace(wiring, parts=parts, publication=publication)
    files, bindings = parameter_files(wiring.parts, wiring.name)
    entries = system_entries(wiring, bindings, stop_time, master_step(wiring, stop_time)) | files
    with temporary_folder() as folder:
        for name, model in wiring.parts.items():
            entries[f"resources/{name}.fmu"] = part_fmu(model, name, folder, platforms).read_bytes()
    with atomic_path(path) as temporary:
        write_archive(temporary, entries)
    return Path(path)


def system_entries(
    wiring: WiredParts, bindings: Sequence[Binding], stop_time: float, step: float
) -> dict[str, bytes]:
    """Return SystemStructure.ssd and the picture of the wiring by place in the archive.

    FMUs are `resources/<part>.fmu`. SSP 1.0 has no place for a communication step: `step` [s] is in
    an annotation that OMSimulator reads, and without which it opens no archive. A SystemGeometry is
    one that it refuses; without it the drawing extends over all elements, as the standard has it.
    """
    used = {wiring.unit(port) for wire in wiring.wires for port in (wire.start, wire.end)} - {""}
    names = (name.replace("_", " ") for name in wiring.parts)
    layout, stated = layout_of(wiring), wiring.publication.stated
    text = filled(
        "SystemStructure.ssd",
        wiring=wiring,
        layout=layout,
        bindings=bindings,
        published={_PUBLISHED.get(name, name): text for name, text in stated.items()},
        tool=markup.generation_tool(),
        about=f"{wiring.name.replace('_', ' ')}: {', '.join(names)}",
        port=Port,
        place=_place,
        describe=markup.describe,
        wires=list(zip(wiring.wires, layout.paths, strict=True)),
        step=_decimal(step),
        tolerance=_decimal(TOLERANCE),
        units={name: markup.base_unit(parse_unit(name)) for name in sorted(used)},
        stop_time=markup.number(stop_time),
        interval=_decimal(stop_time / _ROWS),
    )
    check_text(text, "SystemStructure.ssd, an XML file,")
    picture = wiring_picture(wiring, layout, "svg")
    return {"SystemStructure.ssd": text.encode("utf-8"), PICTURE_ENTRY: picture}


def part_fmu(model: Model, name: str, folder: Path, platforms: Sequence[str]) -> Path:
    """Write the FMU of a part into a folder and return its path."""
    path = folder / f"{name}.fmu"
    return export_fmu(model, path, name=name, include_sensor=True, platforms=platforms)


def wiring_of(system: System) -> WiredParts:
    """Return the parts with all wires, those from and to the surroundings too.

    An input that has no wire and no name outside is no connector: it rests at its start value.
    """

    def port(text: str) -> Port:
        return Port(*text.split(".", 1))

    wires = [Wire(Port(OUTSIDE, name), port(end)) for name, end in system.inputs.items()]
    wires += [Wire(port(start), port(end)) for start, end in system.wires]
    wires += [Wire(port(start), Port(OUTSIDE, name)) for name, start in system.outputs.items()]
    return WiredParts(system.name, system.parts, tuple(wires))
