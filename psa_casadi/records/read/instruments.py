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
    r"""\W*(?P<name>[\w ]*?(?:(?P<rate>rate|freq\w*|\bfs)|interval|period|increment|\bx ?incr?|\bdt|
        time step|step|delta[_ ]?[xt]|sample[_ ]?time|sampling[_ ]?time))\s*
        [\[(]?(?P<before>[A-Za-zµ/]+)?[\])]?[\s:=,;"']+(?P<number>[\d.,]+(?:[eE][+-]?\d+)?)"?
        [\s,;"\[(]*(?P<unit>[A-Za-zµ]+(?:/s|PS)?)?.*""",
    re.I | re.X,
)
_SAMPLES = ("sampl", "acqui", "record", "scan", "adc", "time", "x", "delta", "dt", "fs", "incr")


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
    head = _entries(lines[: ends[0]], None)
    mark = "," if head.get("Separator", [""])[0].lower() == "comma" else "\t"
    columns = (head.get("X_Columns") or ["One"])[0].strip()
    table, header = [""] * len(lines), ""
    for start, end, stop in zip(ends, ends[1:], [*ends[2:], len(lines)], strict=False):
        segment = _entries(lines[start + 1 : end], mark)
        if end + 1 >= stop:
            raise InputError(f"{path}: line {end + 1}: no columns follow; save the file again.")
        names = _names(lines[end + 1].split(mark), segment, columns)
        if header and names != header:
            raise InputError(
                f"{path}: line {end + 2}: this part has other columns than the one before; save"
                " each part as a file of its own."
            )
        if not header:
            table[end + 1] = header = names
        # what stands before the next part's end is its head: it begins with the channels
        body = _body(lines, end + 2, stop)
        for k, row in enumerate(body, end + 2):
            table[k] = _row(f"{path}: line {k + 1}", row, segment, (columns, mark), k - end - 2)
    width = header.count("\t")
    return [row + "\t" * (width - row.count("\t")) if row else row for row in table]


def _body(lines: Sequence[str], start: int, stop: int) -> Sequence[str]:
    """Return the rows of one part: they end where the next part's head begins."""
    rows = lines[start:stop]
    ends = (k for k, row in enumerate(rows) if not row.strip() or row.startswith("Channels"))
    return rows[: next(ends, len(rows))]


def _entries(lines: Sequence[str], mark: str | None) -> dict[str, list[str]]:
    found = {}
    for line in lines:
        key, *values = re.split(r"[\t,]", line, maxsplit=1) if mark is None else line.split(mark)
        found[key.strip()] = [value.strip() for value in values]
    return found


def _names(cells: Sequence[str], segment: Mapping[str, Sequence[str]], columns: str) -> str:
    """Return the header of a part: the time, and the channels with the units that are stated."""
    names, units = [], iter(segment.get("Y_Unit_Label", ()))
    for cell in cells:
        if cell.strip() == "X_Value":
            names.append("" if "time [s]" in names else "time [s]")
        elif cell.strip() == "Comment":
            names.append("Comment")
        else:
            unit = unit_named(next(units, ""))
            names.append(f"{cell.strip()} [{unit}]" if unit else cell.strip())
    return "\t".join(names)


def _row(
    where: str,
    row: str,
    segment: Mapping[str, Sequence[str]],
    form: tuple[str, str],
    k: int,
) -> str:
    """Return one row with its time; row k of a part without times has the time that steps give."""
    columns, mark = form
    cells = row.split(mark)
    if columns == "No":
        first, step = (segment.get(key, [""])[0] for key in ("X0", "Delta_X"))
        start = _number(first) if first else 0.0
        time = (start or 0.0) + k * _positive(where, "Delta_X", step)
        return "\t".join([_written(time, row), *cells[1:]])
    if columns == "Multi":
        times = {c.strip() for c in cells[: 2 * (len(cells) // 2) : 2] if c.strip()}
        if len(times) > 1:
            raise InputError(
                f"{where}: the channels were sampled at different instants"
                f" ({', '.join(sorted(times))[:60]}); save them on one time axis."
            )
    return "\t".join(cells)


def _written(time: float, row: str) -> str:
    """Return a time with the decimal sign of its row."""
    return f"{time:.12g}".replace(".", "," if "," in row and "." not in row else ".")


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
