"""Text that instruments write in a form of their own, as a plain table.

LabVIEW measurement files (`.lvm`), the data recorders of PI controllers (GCS arrays) and
oscilloscopes by Rigol and Tektronix keep the names of the columns and the sample time in a head, or
beside the numbers. The table has the same number of lines, so that a mistake is told with the line
of the file.

Sources: National Instruments, "Specification for the LabVIEW Measurement File (.lvm)"; Physik
Instrumente, "GCS Array Data Format".
"""

import math
import re
from collections.abc import Mapping, Sequence

from psa_casadi.errors import InputError
from psa_casadi.records.read.columns import unit_named
from psa_casadi.units import to_si

_END = "***End_of_Header***"
_ENTRY = re.compile(r"#\s*(?P<key>[A-Z_]+[0-9]*)\s*=\s*(?P<value>.*?)\s*")
#: Lines in which a head is looked for.
_MOST_LINES = 500
#: How a head states the time between samples, or their rate, with a unit before or behind it.
_STEP = re.compile(
    r"""\W*(?P<name>[\w ]*?(?:(?P<rate>rate|freq\w*|\bfs)|interval|period|increment|\bx ?incr?|
        \bdt|\bts|step|delta[_ ]?[xt]|sample[_ ]?time|sampling[_ ]?time))\s*
        [\[(]?(?P<before>[A-Za-zµ/]+)?[\])]?[\s:=,;"']+(?P<number>[\d.,]+(?:[eE][+-]?\d+)?)"?
        [\s,;"\[(]*(?P<unit>[A-Za-zµ]+(?:/s|PS)?)?.*""",
    re.I | re.X,
)
_SAMPLES = ("sampl", "acqui", "record", "scan", "adc", "time", "x", "delta", "dt",
            "fs", "ts", "wf", "incr")  # fmt: skip


Form = tuple[Sequence[str], tuple[str, ...], float | None]


def instrument_lines(path: str, lines: Sequence[str]) -> Form:
    """Return the lines of a table where an instrument wrote them in its form, else the same lines.

    With them come the header of a table that has none among its lines, and the time between samples
    [s] that the head states.

    Raises:
        InputError: the head is damaged, or the channels were sampled at different instants.
    """
    if lines[0].strip().startswith("LabVIEW Measurement"):
        return _labview(path, lines), (), None
    names = [cell.strip() for cell in lines[0].strip().rstrip(",").split(",")]
    if names[0] == "Record Length" and len(names) > 4:
        return _tektronix(lines)
    if names[0] == "X" and names[-2:] == ["Start", "Increment"] and len(lines) > 1:
        return _rigol(path, lines, names[1:-2])
    head = lines[:_MOST_LINES]
    ends = (k for k, line in enumerate(head) if re.fullmatch(r"#\s*END_HEADER\s*", line))
    end = next(ends, None)
    return (lines, (), None) if end is None else _data_recorder(path, lines, end)


def stated_step(lines: Sequence[str]) -> float | None:
    """Return the time between samples [s] that the lines above a table state, None without one."""
    found = set()
    for line in lines[:_MOST_LINES]:
        match = _STEP.fullmatch(line)
        if match is None or not match["name"].lower().lstrip("# ").startswith(_SAMPLES):
            continue
        number, is_rate = _number(match["number"].rstrip(",")), match["rate"] is not None
        unit = unit_named(match["unit"] or "") or unit_named(match["before"] or "")
        unit = unit or ("Hz" if is_rate else "s")
        try:
            value = to_si(number, unit)
        except InputError:
            continue
        if 0.0 < value < 1e12:
            found.add(1.0 / value if unit.endswith("Hz") or is_rate else value)
    return found.pop() if len(found) == 1 else None


def _tektronix(lines: Sequence[str]) -> Form:
    """Return the time and the value of a channel, which stand beside the settings."""
    rows = [[cell.strip() for cell in line.split(",")] for line in lines]
    told = {row[0]: row[1] for row in rows if len(row) > 1 and row[0]}
    unit, clock = (unit_named(told.get(f"{axis} Units", "")) for axis in ("Vertical", "Horizontal"))
    name = told.get("Source") or "value"
    header = (f"time [{clock or 's'}]", f"{name} [{unit}]" if unit else name)
    return [",".join(row[3:5]) if len(row) > 4 else "" for row in rows], header, None


def _data_recorder(path: str, lines: Sequence[str], end: int) -> Form:
    """Return a PI data recorder's table: names and sample time stand in comments above it."""
    head = {m["key"]: m["value"] for line in lines[:end] if (m := _ENTRY.fullmatch(line))}
    names = tuple(value for key, value in head.items() if re.fullmatch(r"NAME\d+", key) and value)
    if not names:
        raise InputError(
            f"{path}: its head names no columns (NAME0, NAME1, ...); record the data again."
        )
    return [*[""] * (end + 1), *lines[end + 1 :]], names, stated_step(lines[:end])


def _rigol(path: str, lines: Sequence[str], channels: Sequence[str]) -> Form:
    """Return the channels of a Rigol oscilloscope, whose rows are counted."""
    units = [cell.strip() for cell in lines[1].strip().rstrip(",").split(",")]
    step = _positive(f"{path}: line 2", "Increment", units[-1])
    named = zip(channels, map(unit_named, units[1:]), strict=False)
    header = tuple(f"{name} [{unit}]" if unit else name for name, unit in named)
    rows = [",".join(line.split(",")[1 : 1 + len(channels)]) for line in lines[2:]]
    return ["", "", *rows], header, step


def _labview(path: str, lines: Sequence[str]) -> Sequence[str]:
    """Return the segments of a LabVIEW measurement as one table."""
    ends = [k for k, line in enumerate(lines) if line.startswith(_END)]
    if len(ends) < 2:
        raise InputError(f"{path}: the head of this LabVIEW file does not end; save it again.")
    head = _entries(lines[: ends[0]], "[\t,]")
    mark = "," if head.get("Separator", [""])[0].lower() == "comma" else "\t"
    columns = head.get("X_Columns", ["One"])[0]
    table, header = [""] * len(lines), ""
    for start, end, stop in zip(ends, ends[1:], [*ends[2:], len(lines)], strict=False):
        segment = _entries(lines[start + 1 : end], mark)
        if end + 1 >= stop:
            raise InputError(f"{path}: line {end + 1}: no columns follow; save the file again.")
        names = _labview_names(lines[end + 1].split(mark), segment.get("Y_Unit_Label", ()))
        if header and names != header:
            raise InputError(
                f"{path}: line {end + 2}: this part has other columns than the one before; save"
                " each part as a file of its own."
            )
        if not header:
            table[end + 1] = header = names
        for k, row in enumerate(lines[end + 2 : stop], end + 2):
            if not row.strip() or row.startswith("Channels"):  # the head of the next part
                break
            cells = row.split(mark)
            if columns == "No":
                cells[0] = _labview_time(f"{path}: line {k + 1}", row, segment, k - end - 2)
            elif columns == "Multi" and len({c for c in cells[: len(cells) // 2 * 2 : 2] if c}) > 1:
                raise InputError(
                    f"{path}: line {k + 1}: the channels were sampled at different instants; save"
                    " them on one time axis."
                )
            cells += [""] * (header.count("\t") + 1 - len(cells))
            table[k] = "\t".join(cells)
    return table


def _entries(lines: Sequence[str], mark: str) -> dict[str, list[str]]:
    found = [[cell.strip() for cell in re.split(mark, line)] for line in lines]
    return {key: values or [""] for key, *values in found}


def _labview_names(cells: Sequence[str], units: Sequence[str]) -> str:
    """Return the header: one time, and the channels with the units that are stated."""
    names: list[str] = []
    left = iter(units)
    for name in map(str.strip, cells):
        if name == "X_Value":
            names.append("" if names else "X_Value [s]")
        else:
            unit = unit_named(next(left, "")) if name != "Comment" else None
            names.append(f"{name} [{unit}]" if unit else name)
    return "\t".join(names)


def _labview_time(where: str, row: str, segment: Mapping[str, Sequence[str]], k: int) -> str:
    """Return the time that steps give to row k of a part, with the decimal sign of its row."""
    first, step = (segment.get(key, [""])[0] for key in ("X0", "Delta_X"))
    start = _number(first) if first else 0.0
    time = f"{start + k * _positive(where, 'Delta_X', step):.12g}"
    return time.replace(".", ",") if "," in row and "." not in row else time


def _number(text: str) -> float:
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return math.nan


def _positive(where: str, key: str, text: str) -> float:
    step = _number(text)
    if not 0.0 < step < 1e9:
        raise InputError(
            f"{where}: the head gives no sample time ({key} is '{text[:40]}'); record it again."
        )
    return step
