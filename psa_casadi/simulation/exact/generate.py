"""The generated half of the C code of exact steps: a model's functions, its split as tables."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.component import Expression
from psa_casadi.simulation.exact.dependence import closure
from psa_casadi.simulation.exact.emit import Printer
from psa_casadi.simulation.exact.split import Split

_KINDS = {"group": "EX_GROUP", "port": "EX_PORT", "loop": "EX_LOOP"}


@dataclass(frozen=True)
class _Entry:
    """A partial derivative that is not zero: of which row, by a state (0), the rate (1), p (2)."""

    row: int
    kind: int
    index: int


def generate(split: Split, output: str) -> str:
    """Return the text of `exact_model.h`; `output` is the one whose sensitivities are computed."""
    s = split.structure
    rate = ca.SX.sym("rate")
    printer = Printer({"t": s.time, "x": s.x, "v": s.u, "w": rate, "p": s.p})
    tables: list[str] = []
    m, b, c = split.matrices
    linear = ca.vertcat(*[ca.vec(q.T) for q in (m, b)], c)
    thetas = [k for k in range(s.p.numel()) if ca.depends_on(linear, s.p[k])]
    printer.of_parameters("psa_linear", [linear])
    printer.of_parameters("psa_linear_slopes", [ca.jacobian(linear, s.p[k]) for k in thetas])
    group_size, rate_size = _groups(split, printer, rate, tables)
    port_size = _ports(split, printer, tables)
    shown = s.y[[o.name for o in s.outputs].index(output)]
    partials, entries = _partials(split, [shown], None)
    printer.function("ex_outputs", [s.y])
    printer.function("ex_shown", [shown])
    printer.function("ex_shown_slopes", [shown, *partials])
    tables.append(_entries("ex_shown_entries", entries))
    kept, prepare = printer.kept()
    place = {state: k for k, state in enumerate(split.linear)}
    chords = [k for k, q in enumerate(split.ports) if q.chord >= 0]
    reach = _linear_reach(split)
    sizes = {
        "EX_NX": len(s.states), "EX_NL": len(split.linear), "EX_NU": len(s.inputs),
        "EX_NP": len(s.parameters), "EX_NY": len(s.outputs), "EX_NG": len(split.groups),
        "EX_NPORT": len(split.ports), "EX_NCH": len(chords), "EX_NTHETA": len(thetas),
        "EX_NK": kept, "EX_NITEMS": len(split.order), "EX_GROUP_OUT": group_size,
        "EX_PORT_OUT": port_size, "EX_RATE_OUT": rate_size, "EX_SHOWN_OUT": 1 + len(entries),
        "EX_NLOOP": sum(kind == "loop" for kind, _ in split.order),
    }  # fmt: skip
    needed, path = _needed(split)
    lists = {
        "ex_linear": split.linear,
        "ex_need": [place[i] for i in needed],
        "ex_path": path,
        "ex_theta": thetas,
        "ex_reads": [int(np.flatnonzero(row)[-1]) + 1 for row in reach],
        "ex_port_timed": [int(ca.depends_on(q.value, s.time)) for q in split.ports],
        "ex_port_reaches": [int(np.flatnonzero(reach[:, place[q.state]])[0]) for q in split.ports],
        "ex_port_row": [place[q.state] for q in split.ports],
        "ex_port_chord": [chords.index(k) if k in chords else -1 for k in range(len(split.ports))],
        "ex_chord_port": chords,
        "ex_chord_driver": [place[split.ports[k].chord] for k in chords],
        "ex_chord_row": [place[split.ports[k].state] for k in chords],
        "ex_group_driver": [place[g.driver] for g in split.groups],
        "ex_group_first": np.cumsum([0, *(len(g.states) for g in split.groups)])[:-1].tolist(),
        "ex_group_size": [len(g.states) for g in split.groups],
        "ex_group_states": split.along,
    }
    feeds = [
        [j for j, q in enumerate(split.ports) if reach[place[split.ports[k].chord], place[q.state]]]
        for k in chords
    ]
    sizes |= {
        "EX_NFEED": max((len(f) for f in feeds), default=0),
        "EX_NDRIVE": max((lists["ex_reads"][k] for k in lists["ex_chord_driver"]), default=0),
    }
    sizes |= {"EX_NEED": len(needed), "EX_NPATH": len(path)}
    head = ["#ifndef PSA_EXACT_MODEL_H", "#define PSA_EXACT_MODEL_H", '#include "exact_math.h"']
    head += [f"#define {name} {value}" for name, value in sizes.items()]
    head += [
        "enum { EX_GROUP, EX_PORT, EX_LOOP };",
        "typedef struct { short row, kind, index; } psa_entry;",
        "typedef struct { int kind, count; const int *members; } psa_item;",
        *(_integers(name, values) for name, values in lists.items()),
        _table("ex_feed", feeds, sizes["EX_NFEED"] + 1),
        _table("ex_port_along", _along(split), max(1, len(split.groups))),
        *tables,
        *_items(split),
    ]  # fmt: skip
    return "\n".join([*head, *printer.functions, prepare, "#endif", ""])


def _integers(name: str, values: Sequence[int]) -> str:
    listed = ", ".join(str(v) for v in values) or "0"
    return f"static const int {name}[{max(1, len(values))}] = {{{listed}}};"


def _table(name: str, rows: Sequence[Sequence[int]], width: int) -> str:
    """Return a table of integers whose rows are filled up with -1."""
    filled = [[*row, *[-1] * (width - len(row))] for row in rows] or [[-1] * width]
    text = ", ".join("{" + ", ".join(str(v) for v in row) + "}" for row in filled)
    return f"static const int {name}[{len(filled)}][{width}] = {{{text}}};"


def _entries(name: str, entries: Sequence[_Entry]) -> str:
    text = ", ".join(f"{{{e.row}, {e.kind}, {e.index}}}" for e in entries) or "{0, 0, 0}"
    return f"static const psa_entry {name}[{max(1, len(entries))}] = {{{text}}};"


def _items(split: Split) -> list[str]:
    lines, rows = [], []
    for k, (kind, members) in enumerate(split.order):
        lines.append(_integers(f"ex_members_{k}", members))
        rows.append(f"{{{_KINDS[kind]}, {len(members)}, ex_members_{k}}}")
    listed = ", ".join(rows) or "{0, 0, 0}"
    return [*lines, f"static const psa_item ex_items[{max(1, len(rows))}] = {{{listed}}};"]


def _partials(
    split: Split, rows: Sequence[Expression], rate: Expression | None
) -> tuple[list[Expression], list[_Entry]]:
    """Return the partial derivatives that are not zero, with their entries."""
    s = split.structure
    sources = [(0, s.x), (1, rate), (2, s.p)]
    found, entries = [], []
    for row, expression in enumerate(rows):
        for kind, by in sources:
            if by is None:
                continue
            slopes = ca.jacobian(expression, by)
            for k in range(by.numel()):
                if slopes.sparsity().has_nz(0, k):
                    found.append(slopes[0, k])
                    entries.append(_Entry(row, kind, k))
    return found, entries


def _dispatch(name: str, count: int) -> str:
    """Return a function that calls the one with the number it is given."""
    cases = "".join(f"    case {k}: {name}_{k}(t, x, v, w, k, out); break;\n" for k in range(count))
    return (
        f"static inline void {name}(int which, real t, const real *x, const real *v, real w,\n"
        f"        const real *k, real *out) {{\n"
        f"    (void)t, (void)x, (void)v, (void)w, (void)k, (void)out;\n"
        f"    switch (which) {{\n{cases}    default: break;\n    }}\n}}\n"
    )


def _groups(split: Split, printer: Printer, rate: Expression, tables: list[str]) -> tuple[int, int]:
    s, counts, rate_counts, largest, rate_size = split.structure, [], [], 1, 1
    for k, group in enumerate(split.groups):
        slopes = ca.substitute(group.slopes, group.rate, rate)
        rows = [slopes[i] for i in range(len(group.states))]
        partials, entries = _partials(split, rows, rate)
        printer.function(f"ex_group_{k}", rows)
        printer.function(f"ex_group_slopes_{k}", [*rows, *partials])
        driver = s.xdot[group.driver]
        moved, rate_entries = _partials(split, [driver], None)
        printer.function(f"ex_rate_{k}", [driver])
        printer.function(f"ex_rate_slopes_{k}", [driver, *moved])
        tables.append(_entries(f"ex_rate_entries_{k}", rate_entries))
        rate_counts.append(len(rate_entries))
        rate_size = max(rate_size, 1 + len(moved))
        tables.append(_entries(f"ex_group_entries_{k}", entries))
        counts.append(len(entries))
        largest = max(largest, len(rows) + len(partials))
    tables.append(_pointers("ex_group", len(counts)))
    tables.append(_integers("ex_group_count", counts))
    tables.append(_pointers("ex_rate", len(counts)))
    tables.append(_integers("ex_rate_count", rate_counts))
    for name in ("ex_group", "ex_group_slopes", "ex_rate", "ex_rate_slopes"):
        printer.functions.append(_dispatch(name, len(counts)))
    return largest, rate_size


def _pointers(name: str, count: int) -> str:
    listed = ", ".join(f"{name}_entries_{k}" for k in range(count)) or "0"
    return f"static const psa_entry *const {name}_entries[{max(1, count)}] = {{{listed}}};"


def _ports(split: Split, printer: Printer, tables: list[str]) -> int:
    counts, largest = [], 1
    for k, port in enumerate(split.ports):
        partials, entries = _partials(split, [port.value], None)
        printer.function(f"ex_port_{k}", [port.value])
        printer.function(f"ex_port_slopes_{k}", [port.value, *partials])
        tables.append(_entries(f"ex_port_entries_{k}", entries))
        counts.append(len(entries))
        largest = max(largest, 1 + len(partials))
    tables.append(_pointers("ex_port", len(counts)))
    tables.append(_integers("ex_port_count", counts))
    for name in ("ex_port", "ex_port_slopes"):
        printer.functions.append(_dispatch(name, len(counts)))
    return largest


def _read(split: Split, expression: Expression) -> set[int]:
    sparsity = ca.jacobian_sparsity(expression, split.structure.x)
    return {int(j) for j in np.flatnonzero(np.any(ca.DM(sparsity, 1).full() != 0, axis=0))}


def _needed(split: Split) -> tuple[list[int], list[int]]:
    """Return the linear states wanted inside a step, and those along whose way groups go."""
    path: set[int] = set()
    inside: set[int] = set()
    for group in split.groups:
        path |= _read(split, group.slopes) - set(split.along)
        inside |= _read(split, split.structure.xdot[group.driver]) | {group.driver}
    for port in split.ports:
        inside |= _read(split, port.value) | ({port.chord} if port.chord >= 0 else set())
    return sorted((inside | path) - set(split.along)), sorted(path)


def _along(split: Split) -> list[list[int]]:
    """Return for every port which groups' drivers or states it reads."""
    read = [_read(split, q.value) for q in split.ports]
    return [[int(bool(r & {g.driver, *g.states})) for g in split.groups] or [0] for r in read]


def _linear_reach(split: Split) -> npt.NDArray[np.bool_]:
    """Return [k, j]: a change of the linear state j reaches k through M, in the order of L."""
    m, _, _ = split.matrices
    return closure(ca.DM(ca.sparsify(m).sparsity(), 1).full() != 0)
