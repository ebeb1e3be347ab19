"""What a file looks like: first rows, columns, a small curve. Read in a process of its own.

A damaged file may end the process that reads it, and a large one fills its memory; neither is to
end the page.
"""

import contextlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from psa_casadi.children import end_with_parent, heard, started_python
from psa_casadi.errors import InputError, MachineError
from psa_casadi.records.read.apart import Head, head_of
from psa_casadi.records.read.columns import TABLE, columns_of, parse_columns
from psa_casadi.records.read.reading import read_records
from psa_casadi.records.record import Record

#: Time [s] that a file may take, and the stretches a curve is drawn in.
_LIMIT_S, _STRETCHES = 120.0, 300
_MODULE = "psa_casadi.workbench.previews"


def preview(
    folder: Path, path: Path, columns: str | None, sample_time: float | None, *, held: bool
) -> dict[str, Any]:
    """Return the head of a file, the problems that it is read with, and the record as a curve.

    `folder` is where the process runs that reads it: none that holds files of others. `columns` is
    the text of --columns, `sample_time` [s] that of --sample-time; a file that is `held` out needs
    no voltage that changes.
    """
    file = path.relative_to(folder).as_posix()
    asked = {"file": file, "columns": columns, "sample_time": sample_time, "held": held}
    try:
        with started_python(_MODULE, json.dumps(asked), directory=folder) as child:
            done = heard(child, limit=_LIMIT_S)
    except subprocess.TimeoutExpired:
        return _problem(f"{path.name}: reading it comes to no end; save it again.")
    except MachineError as error:
        return _problem(str(error))
    if done.returncode:
        return _problem(
            f"{path.name}: the process that read it has ended; the file is damaged or too large."
        )
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def looked_at(
    file: str, columns: str | None, sample_time: float | None, *, held: bool
) -> dict[str, Any]:
    """Return what `preview` returns of a file in this folder, read in this process."""
    head, problems, record = None, [], None
    try:
        wanted = parse_columns(columns) if columns else {}
        chosen = columns_of(wanted, Path(file).name).get(TABLE)
        head = head_of(file, table=chosen.array if chosen else "")
        record, *_ = read_records(
            [file], columns=wanted, sample_time=sample_time, need_excitation=not held
        )
    except InputError as error:
        problems = list(error.problems)
    return {
        "head": None if head is None else _head(head),
        "problems": problems,
        "record": None if record is None else _curve(record),
    }


def _problem(sentence: str) -> dict[str, Any]:
    return {"head": None, "problems": [sentence], "record": None}


def _head(head: Head) -> dict[str, Any]:
    return {
        "names": head.names,
        "units": head.units,
        "rows": head.rows,
        "guess": {name: [f.index, f.unit] for name, f in head.guess.items()},
        "tables": head.tables,
    }


def _curve(record: Record) -> dict[str, Any]:
    """Return times [s], voltages [V] and displacements [m] that show every turn of a record."""
    measured = record.displacement
    x = np.full(record.n, np.nan) if measured is None else measured
    kept = {0, record.n - 1}
    for part in np.array_split(np.arange(record.n), min(_STRETCHES, record.n)):
        for values in (record.voltage[part], x[part]):
            if np.isfinite(values).any():
                kept |= {int(part[np.nanargmin(values)]), int(part[np.nanargmax(values)])}
    chosen = np.array(sorted(kept))
    others = ("load_force", "current", "temperature", "monitor_voltage", "charge",
              "displacement_2", "strain")  # fmt: skip
    return {
        "n": record.n,
        "seconds": float(record.time[-1] - record.time[0]),
        "unit": record.displacement_unit,
        "others": [name for name in others if getattr(record, name) is not None],
        "t": record.time[chosen].tolist(),
        "v": record.voltage[chosen].tolist(),
        "x": [float(v) if np.isfinite(v) else None for v in x[chosen]],
    }


def main() -> None:
    """Read what is asked for on the command line and write the answer to standard output."""
    end_with_parent()
    asked = json.loads(sys.argv[1])
    out = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):  # libraries may say something
        found = looked_at(asked["file"], asked["columns"], asked["sample_time"], held=asked["held"])
    json.dump(found, out, allow_nan=False)


if __name__ == "__main__":
    main()
