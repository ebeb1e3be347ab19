"""Kept answers: one file a kind, one line a case; and what differs from them."""

import math
import re
import subprocess
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from tests.studies.golden.cases import CASES, Row

ANSWERS = Path(__file__).parent / "answers"
SECONDS = "seconds"
#: Columns that hold numbers: the relative and the absolute difference that rounding may make. All
#: other columns are exact; the probabilities of the causes differ by less than PROBABILITY.
_ROUNDING = {
    "removed": (0.0, 0.01), "base": (0.01, 0.0), "extended": (0.01, 0.0),
    "numbers": (1e-5, 0.0), "parameters": (5e-3, 0.0), "errors": (0.05, 1e-8),
}  # fmt: skip
PROBABILITY = 0.02
#: A change of processor time by this factor, of a case of more than a second, is reported.
SLOWER = 1.25
_SURE = re.compile(r" (\d\.\d+)")


def kept() -> dict[str, Row]:
    """Return the kept answers by case."""
    return rows_of((path.stem, path.read_text("utf-8")) for path in sorted(ANSWERS.glob("*.tsv")))


def rows_of(files: Iterable[tuple[str, str]]) -> dict[str, Row]:
    """Return the answers by case, of files as pairs of kind and text."""
    rows: dict[str, Row] = {}
    for kind, text in files:
        head, *lines = text.splitlines()
        for line in lines:
            row = dict(zip(head.split("\t"), line.split("\t"), strict=True))
            rows[f"{kind}/{row.pop('case')}"] = row
    return rows


def history() -> list[tuple[str, str, str, str]]:
    """Return date, commit, processor time and its change over the cases of the commit before."""
    place = f"./{ANSWERS.relative_to(Path.cwd())}"
    lines, last = [], dict[str, Row]()
    for line in _git("log", "--reverse", "--format=%h %as", "--", place).splitlines():
        commit, date = line.split()
        names = _git("ls-tree", "--name-only", commit, f"{place}/").split()
        rows = rows_of((Path(n).stem, _git("show", f"{commit}:./{n}")) for n in names)
        both = [c for c in rows if c in last]
        old, new = (sum(float(r[c].get(SECONDS, 0)) for c in both) for r in (last, rows))
        total = sum(float(row.get(SECONDS, 0)) for row in rows.values())
        change = f"x{new / old:.2f}" if old else "-"
        lines.append((date, commit, f"{total:.0f} s, {len(rows)} cases", change))
        last = rows
    return lines


def _git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], capture_output=True, text=True, check=True).stdout


def keep(rows: Mapping[str, Row]) -> None:
    """Write answers; those not in `rows` stay, those without a case are removed."""
    every = {**kept(), **rows}
    ANSWERS.mkdir(exist_ok=True)
    for kind in dict.fromkeys(case.kind for case in CASES.values()):
        cases = [c for c in CASES.values() if c.kind == kind and c.id in every]
        names = [n for n in every[cases[0].id] if n != "hidden"] if cases else []
        table = [("case", "hidden", *names)]
        table += [(c.name, c.hidden, *(every[c.id][n] for n in names)) for c in cases]
        if cases:
            text = "\n".join("\t".join(row) for row in table) + "\n"
            (ANSWERS / f"{kind}.tsv").write_text(text, "utf-8")


def changes(before: Row, now: Row) -> list[tuple[str, str, str]]:
    """Return what differs by more than rounding: column, before, now; the time comes by itself."""
    return [
        (name, before.get(name, "none"), now[name])
        for name in now
        if name not in (SECONDS, "hidden") and not _same(name, before.get(name, "none"), now[name])
    ]


def slower(before: Row, now: Row) -> tuple[str, str, str] | None:
    """Return the processor time where it changed by more than a busy machine makes it."""
    old, new = (float(row.get(SECONDS, "nan")) for row in (before, now))
    if max(old, new) < 1.0 or 1.0 / SLOWER < new / old < SLOWER:
        return None
    return (f"time x{new / old:.2f}", f"{old:.1f} s", f"{new:.1f} s")


def _same(column: str, before: str, now: str) -> bool:
    if column == "causes":
        (old, new), sure = _parted(before, now), PROBABILITY
        return old[0] == new[0] and _near(old[1], new[1], 0.0, sure)
    if column in _ROUNDING and not {"-", "none"} & {before, now}:
        old_numbers, new_numbers = ([float(x) for x in text.split()] for text in (before, now))
        return _near(old_numbers, new_numbers, *_ROUNDING[column])
    return before == now


def _parted(*texts: str) -> list[tuple[str, list[float]]]:
    """Return the names and the probabilities of causes."""
    return [(_SURE.sub("", text), [float(p) for p in _SURE.findall(text)]) for text in texts]


def _near(before: list[float], now: list[float], relative: float, absolute: float) -> bool:
    return len(before) == len(now) and all(
        math.isclose(a, b, rel_tol=relative, abs_tol=absolute)
        for a, b in zip(before, now, strict=True)
    )


def table(
    before: Mapping[str, Row], now: Mapping[str, Row], *, times: bool = True
) -> list[tuple[str, str, str, str]]:
    """Return the lines of what changed: case, what, before, now."""
    lines = []
    for case, row in now.items():
        output = changes(before.get(case, {}), row)
        time = slower(before[case], row) if times and case in before else None
        lines += [(case, *change) for change in (*output, *([time] if time else []))]
    return lines


def totals(before: Mapping[str, Row], now: Mapping[str, Row]) -> list[tuple[str, str, str, str]]:
    """Return right marks by kind, processor time, and held-out errors, of the same cases."""
    both = [case for case in now if case in before]
    errors = [c for c in both if "extended" in now[c] and "extended" in before[c]]

    def line(what: str, cases: list[str], name: str, output: Callable[[list[Row]], str]) -> None:
        if cases:
            old, new = (output([rows[c] for c in cases]) for rows in (before, now))
            lines.append((f"{what}, {len(cases)} cases", name, old, new))

    lines: list[tuple[str, str, str, str]] = []
    for kind in dict.fromkeys(case.split("/")[0] for case in both):
        marked = [c for c in both if c.startswith(kind) and now[c].get("mark", "-") != "-"]
        line(kind, marked, "right", _right)
    line("all", both, "processor time", lambda r: f"{sum(float(x[SECONDS]) for x in r):.0f} s")
    line("all", errors, "held-out error, extended over base", lambda r: f"{_error_ratio(r):.4f}")
    return lines


def _right(rows: Iterable[Row]) -> str:
    marks = [row["mark"] for row in rows]
    return str(sum(m.startswith("right") and "wrong" not in m for m in marks))


def _error_ratio(rows: Iterable[Row]) -> float:
    """Return the geometric mean of the extended model's held-out errors over the base's."""
    logs = [
        math.log(float(extended) / float(base))
        for row in rows
        for extended, base in zip(row["extended"].split(), row["base"].split(), strict=True)
    ]
    return math.exp(sum(logs) / len(logs))


def twelfth(ids: Iterable[str], before: Mapping[str, Row]) -> list[str]:
    """Return the fastest of every twelve cases of a kind, in their order."""
    kinds: dict[str, list[str]] = {}
    for case in ids:
        kinds.setdefault(case.split("/")[0], []).append(case)
    dozens = (of[k : k + 12] for of in kinds.values() for k in range(0, len(of), 12))
    return [min(dozen, key=lambda c: float(before[c][SECONDS])) for dozen in dozens]
