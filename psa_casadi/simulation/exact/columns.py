"""The derivatives of a step as C, for columns of sensitivities, four at a time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

_GIVEN = "real t, const real *x, const real *v, real w, const real *k, real *out"
_OF_COLUMNS = "const real *d, const column *x, column w, const column *p, column *out"
#: Rows whose sums stand in the processor's registers together, beside what they are made of.
CHUNK = 8


@dataclass(frozen=True)
class Entry:
    """A partial derivative that is not zero: of which row, by a state (0), the rate (1), p (2)."""

    row: int
    kind: int
    index: int


def dispatch(name: str, count: int, given: str = _GIVEN) -> str:
    """Return a function that calls the one with the number it is given."""
    passed = [q.split()[-1].lstrip("*") for q in given.split(",")]
    unused = ", ".join(f"(void){q}" for q in passed)
    calls = ", ".join(passed)
    cases = "".join(f"    case {k}: {name}_{k}({calls}); break;\n" for k in range(count))
    return (
        f"static inline void {name}(int which, {given}) {{\n    {unused};\n"
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
    """Return text that stands only where there are derivatives: not with lanes nor on a GPU."""
    return f"#if PSA_SENSITIVE\n{text}#endif\n"


def of_linear_part(
    reach: npt.NDArray[np.bool_], needed: Sequence[int], linear: Sequence[int]
) -> str:
    """Return what the linear part does to columns x, and its matrices' own derivatives, as C.

    Rows are those of the whole step and then those `needed` inside it; `reach` says which entries
    of a row are not zero, `linear` which state each is of.
    """
    rows = [*range(len(linear)), *needed]
    return sensitive("\n".join([*_product(reach, rows, linear), *_own(reach, rows), ""]))


def _product(reach: npt.NDArray[np.bool_], rows: Sequence[int], linear: Sequence[int]) -> list[str]:
    """Return out = x + F x: F by columns `f`, and by the rows `half` of the half of the step."""
    lines = []
    for place, i in enumerate(rows):
        inside = place - len(linear)
        factors = [
            (f"f[{j} * EX_ROWS + {i}]" if inside < 0 else f"half[{inside}][{j}]", j)
            for j in np.flatnonzero(reach[i]).tolist()
        ]
        terms = [f"x[{linear[i]}]", *(f"{q} * x[{linear[j]}]" for q, j in factors)]
        lines.append(f"    out[{place}] = {' + '.join(terms)};")
    given = "const real *f, const real *const *half, const column *x, column *out"
    return [f"static inline void ex_linear_columns({given}) {{", "    (void)half;", *lines, "}"]


def _own(reach: npt.NDArray[np.bool_], rows: Sequence[int]) -> list[str]:
    """Return out += dF l + the other matrices' derivatives times the tail, a chunk of rows a time.

    `d` holds for each chunk the tail's factors, then those of L by its columns.
    """
    lines = []
    for first in range(0, len(rows), CHUNK):
        chunk = range(first, min(first + CHUNK, len(rows)))
        entries = [(r, j) for j in range(len(reach)) for r in chunk if reach[rows[r], j]]
        lines += ["    {", *(f"        column a{r} = {{0.0}};" for r in chunk)]
        lines += [f"        for (int k = 0; k < tails; ++k, d += {len(chunk)}) {{"]
        lines += [f"            a{r} += tail[k] * d[{r - first}];" for r in chunk]
        lines += ["        }"]
        lines += [f"        a{r} += l[{j}] * d[{k}];" for k, (r, j) in enumerate(entries)]
        lines += [
            f"        d += {len(entries)};",
            *(f"        out[{r}] += a{r};" for r in chunk),
            "    }",
        ]
    given = "const real *l, const double *tail, int tails, const column *d, column *out"
    return [f"static inline void ex_own_columns({given}) {{", *lines, "}"]
