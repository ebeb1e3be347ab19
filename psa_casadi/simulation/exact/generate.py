"""The generated half of the C code of exact steps: a model's functions, its split as tables."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from psa_casadi.common.units import BoolArray
from psa_casadi.model.component import Expression
from psa_casadi.simulation.exact.printing import Printer
from psa_casadi.simulation.exact.split import Split, closure, dependence

_OF_NUMBERS = "real t, const real *x, const real *v, real w, const real *k, real *out"
_OF_COLUMNS = "const real *d, const column *x, column w, const column *p, column *out"
#: Rows whose sums fit in the processor's registers together with their terms.
CHUNK = 8


@dataclass(frozen=True)
class Entry:
    """A partial derivative that is not zero: of which row, by a state (0), the rate (1), p (2)."""

    row: int
    kind: int
    index: int


def dispatch(name: str, count: int, text: str = _OF_NUMBERS) -> str:
    """Return a function that calls the one with the number `which`."""
    passed = [q.split()[-1].lstrip("*") for q in text.split(",")]
    unused = ", ".join(f"(void){q}" for q in passed)
    calls = ", ".join(passed)
    cases = "".join(f"    case {k}: {name}_{k}({calls}); break;\n" for k in range(count))
    return (
        f"static inline void {name}(int which, {text}) {{\n    {unused};\n"
        f"    switch (which) {{\n{cases}    default: break;\n    }}\n}}\n"
    )


def chain(name: str, entries: Sequence[Entry], rows: int = 1, last: Sequence[int] = ()) -> str:
    """Return the chain rule as C: partial derivatives `d` times columns of what they are by.

    Terms by the states `last` stand at the end: what comes before does not wait for them.
    """
    terms: list[list[tuple[bool, str]]] = [[] for _ in range(rows)]
    for place, e in enumerate(entries):
        by = ("x[{}]", "w", "p[{}]")[e.kind].format(e.index)
        terms[e.row].append((e.kind == 0 and e.index in last, f"d[{place}] * {by}"))
    lines = [
        f"    out[{i}] = {' + '.join(term for _, term in sorted(row)) or '(column){0.0}'};\n"
        for i, row in enumerate(terms)
    ]
    unused = "    (void)d, (void)x, (void)w, (void)p;\n"
    return f"static inline void {name}({_OF_COLUMNS}) {{\n{unused}{''.join(lines)}}}\n"


def chains(name: str, texts: Sequence[str]) -> str:
    """Return chains and the function that calls one of them; with lanes there are none."""
    text = "".join(texts) + dispatch(name, len(texts), _OF_COLUMNS)
    return sensitive(text)


def sensitive(text: str) -> str:
    """Return text that is compiled only with derivatives: not with lanes nor on a GPU."""
    return f"#if PSA_SENSITIVE\n{text}#endif\n"


def of_linear_part(reach: BoolArray, needed: Sequence[int], linear: Sequence[int]) -> str:
    """Return what the linear part does to columns x, and its matrices' derivatives, as C.

    Rows are those of the whole step and then those `needed` inside it; `reach` marks the entries
    of a row that are not zero, `linear` which state each is of.

        out = x + F x: F by columns `f`, and by the rows `half` of the half of the step
        out += dF l + the other matrices' derivatives times the tail, a chunk of rows a time

    `d` holds for each chunk the tail's factors, then those of L by its columns.
    """
    rows, product, derivatives = [*range(len(linear)), *needed], [], []
    for place, i in enumerate(rows):
        inside = place - len(linear)
        factors = [
            (f"f[{j} * EX_ROWS + {i}]" if inside < 0 else f"half[{inside}][{j}]", j)
            for j in np.flatnonzero(reach[i]).tolist()
        ]
        terms = [f"x[{linear[i]}]", *(f"{q} * x[{linear[j]}]" for q, j in factors)]
        product.append(f"    out[{place}] = {' + '.join(terms)};")
    for first in range(0, len(rows), CHUNK):
        chunk = range(first, min(first + CHUNK, len(rows)))
        entries = [(r, j) for j in range(len(reach)) for r in chunk if reach[rows[r], j]]
        derivatives += ["    {", *(f"        column a{r} = {{0.0}};" for r in chunk)]
        derivatives += [f"        for (int k = 0; k < tails; ++k, d += {len(chunk)}) {{"]
        derivatives += [f"            a{r} += tail[k] * d[{r - first}];" for r in chunk]
        derivatives += ["        }"]
        derivatives += [f"        a{r} += l[{j}] * d[{k}];" for k, (r, j) in enumerate(entries)]
        derivatives += [f"        d += {len(entries)};"]
        derivatives += [*(f"        out[{r}] += a{r};" for r in chunk), "    }"]
    text = "const real *f, const real *const *half, const column *x, column *out"
    last = "const real *l, const double *tail, int tails, const column *d, column *out"
    lines = [f"static inline void ex_linear_columns({text}) {{", "    (void)half;", *product, "}"]
    lines += [f"static inline void ex_own_columns({last}) {{", *derivatives, "}"]
    return sensitive("\n".join([*lines, ""]))


_KINDS = {"group": "EX_GROUP", "port": "EX_PORT", "loop": "EX_LOOP"}


def generate(split: Split, outputs: Sequence[str]) -> str:
    """Return the text of `exact_model.h`; sensitivities are computed of the `outputs`."""
    s = split.structure
    rate = ca.SX.sym("rate")
    printer = Printer({"t": s.time, "x": s.x, "v": s.u, "w": rate, "p": s.p})
    tables: list[str] = []
    m, b, c = split.matrices
    linear = ca.vertcat(*[ca.vec(q.T) for q in (m, b)], c)
    thetas = [k for k in range(s.p.numel()) if ca.depends_on(linear, s.p[k])]
    printer.of_parameters("psa_linear", [linear])
    printer.of_parameters("psa_linear_slopes", [ca.jacobian(linear, s.p[k]) for k in thetas])
    printer.functions.append(sensitive(printer.functions.pop()))
    group_size, rate_size = _groups(split, printer, rate)
    port_size = _ports(split, printer, tables)
    names = [o.name for o in s.outputs]
    requested = [s.y[names.index(n)] for n in outputs]
    partials, entries = _partials(split, requested, None)
    printer.function("ex_outputs", [s.y])
    printer.function("ex_shown", requested)
    printer.function("ex_shown_slopes", [*requested, *partials])
    rule = chain("ex_shown_chain_0", entries, len(requested))
    printer.functions.append(chains("ex_shown_chain", [rule]))
    kept, prepare = printer.kept()
    place = {state: k for k, state in enumerate(split.linear)}
    chords = [k for k, q in enumerate(split.ports) if q.chord >= 0]
    # [k, j]: a change of the linear state j reaches k through M, in the order of L
    reach = closure(ca.DM(ca.sparsify(m).sparsity(), 1).full() != 0)
    sizes = {
        "EX_NX": len(s.states), "EX_NL": len(split.linear), "EX_NU": len(s.inputs),
        "EX_NP": len(s.parameters), "EX_NY": len(s.outputs), "EX_NG": len(split.groups),
        "EX_NPORT": len(split.ports), "EX_NCH": len(chords), "EX_NTHETA": len(thetas),
        "EX_NK": kept, "EX_NITEMS": len(split.order), "EX_GROUP_OUT": group_size,
        "EX_PORT_OUT": port_size, "EX_RATE_OUT": rate_size, "EX_NSHOWN": len(requested),
        "EX_SHOWN_OUT": len(requested) + len(entries), "EX_NRATED": printer.rated,
        "EX_CONSTANT": int(not c.is_zero()),
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
    # for every port which groups' drivers or states it reads
    read = [_read(split, q.value) for q in split.ports]
    along = [[int(bool(r & {g.driver, *g.states})) for g in split.groups] or [0] for r in read]
    feeds = [
        [j for j, q in enumerate(split.ports) if reach[place[split.ports[k].chord], place[q.state]]]
        for k in chords
    ]
    sizes |= {
        "EX_NFEED": max((len(f) for f in feeds), default=0),
        "EX_NDRIVE": max((lists["ex_reads"][k] for k in lists["ex_chord_driver"]), default=0),
    }
    sizes |= {"EX_NEED": len(needed), "EX_NPATH": len(path), "EX_CHUNK": CHUNK}
    sizes["EX_NOWN"] = int(reach.sum()) + int(reach[lists["ex_need"]].sum())
    printer.functions.append(of_linear_part(reach, lists["ex_need"], split.linear))
    items = ", ".join(
        f"{{{_KINDS[kind]}, {len(members)}, ex_members_{k}}}"
        for k, (kind, members) in enumerate(split.order)
    )
    head = ["#ifndef PSA_EXACT_MODEL_H", "#define PSA_EXACT_MODEL_H", '#include "exact_math.h"']
    head += [f"#define {name} {value}" for name, value in sizes.items()]
    head += ["#define EX_ROWS ((EX_NL + COLUMNS - 1) / COLUMNS * COLUMNS)"]
    head += [
        "enum { EX_GROUP, EX_PORT, EX_LOOP };",
        "typedef struct { int kind, count; const int *members; } psa_item;",
        *(_integers(name, values) for name, values in lists.items()),
        _table("ex_reach", reach.astype(int).tolist(), len(split.linear)),
        _table("ex_feed", feeds, sizes["EX_NFEED"] + 1),
        _table("ex_port_along", along, max(1, len(split.groups))),
        *(_table(f"ex_group_{name}", *rows) for name, rows in _behind(split).items()),
        *tables,
        *(_integers(f"ex_members_{k}", members) for k, (_, members) in enumerate(split.order)),
        f"static const psa_item ex_items[{max(1, len(split.order))}] = {{{items or '{0, 0, 0}'}}};",
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


def _partials(
    split: Split, rows: Sequence[Expression], rate: Expression | None
) -> tuple[list[Expression], list[Entry]]:
    """Return the partial derivatives that are not zero, with their entries."""
    s = split.structure
    sources = [(0, s.x), (1, rate), (2, s.p)]
    result, entries = [], []
    for row, expression in enumerate(rows):
        for kind, by in sources:
            if by is None:
                continue
            slopes = ca.jacobian(expression, by)
            for k in range(by.numel()):
                if slopes.sparsity().has_nz(0, k):
                    result.append(slopes[0, k])
                    entries.append(Entry(row, kind, k))
    return result, entries


_OF_RATE = "real w, real *k"


def _printed(
    split: Split, printer: Printer, name: str, k: int, rows: Sequence[Expression],
    rate: Expression | None = None, last: Sequence[int] = (),
) -> tuple[list[Entry], str]:  # fmt: skip
    """Print the k-th function of a name and its slopes; return their entries and the chain."""
    partials, entries = _partials(split, rows, rate)
    printer.function(f"{name}_{k}", rows)
    printer.function(f"{name}_slopes_{k}", [*rows, *partials])
    return entries, chain(f"{name}_chain_{k}", entries, len(rows), last)


def _groups(split: Split, printer: Printer, rate: Expression) -> tuple[int, int]:
    s, texts, rate_texts, largest, rate_size = split.structure, [], [], 1, 1
    for k, group in enumerate(split.groups):
        slopes = ca.substitute(group.slopes, group.rate, rate)
        rows = [slopes[i] for i in range(len(group.states))]
        entries, text = _printed(split, printer, "ex_group", k, rows, rate, group.states)
        printer.of_rate(f"ex_group_rate_{k}")
        moved, rate_text = _printed(split, printer, "ex_rate", k, [s.xdot[group.driver]])
        largest, rate_size = max(largest, len(rows) + len(entries)), max(rate_size, 1 + len(moved))
        texts.append(text)
        rate_texts.append(rate_text)
    for name in ("ex_group", "ex_group_slopes", "ex_rate", "ex_rate_slopes"):
        printer.functions.append(dispatch(name, len(split.groups)))
    printer.functions.append(dispatch("ex_group_rate", len(split.groups), _OF_RATE))
    printer.functions.append(chains("ex_group_chain", texts))
    printer.functions.append(chains("ex_rate_chain", rate_texts))
    return largest, rate_size


def _ports(split: Split, printer: Printer, tables: list[str]) -> int:
    texts, by_state, largest = [], [], 1
    for k, port in enumerate(split.ports):
        entries, text = _printed(split, printer, "ex_port", k, [port.value])
        texts.append(text)
        at = [-1] * len(split.linear)
        for place, entry in enumerate(entries):
            if entry.kind == 0 and entry.index in split.linear:
                at[split.linear.index(entry.index)] = 1 + place
        by_state.append(at)
        largest = max(largest, 1 + len(entries))
    tables.append(_table("ex_port_by_linear", by_state, max(1, len(split.linear))))
    for name in ("ex_port", "ex_port_slopes"):
        printer.functions.append(dispatch(name, len(split.ports)))
    printer.functions.append(chains("ex_port_chain", texts))
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


def _behind(split: Split) -> dict[str, tuple[list[list[int]], int]]:
    """Return for every group which parameters and states it, or its driver's way, depends on."""
    s = split.structure
    reach = closure(dependence(s.xdot, s.x))
    by = dependence(s.xdot, s.p)
    states = [np.any(reach[[*g.states, g.driver]], axis=0) for g in split.groups]
    parameters = [np.any(by[behind], axis=0) for behind in states]
    return {
        "behind": ([row.astype(int).tolist() for row in states], len(s.states)),
        "by": ([row.astype(int).tolist() for row in parameters], max(1, len(s.parameters))),
    }
