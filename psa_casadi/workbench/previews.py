"""What a file looks like: first rows, columns, a small picture. Read in a process of its own.

A damaged file may end the process that reads it, and a large one fills its memory; neither is to
end the page.
"""

import base64
import contextlib
import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from psa_casadi.children import end_with_parent, heard, started_python
from psa_casadi.errors import InputError, MachineError
from psa_casadi.records.read.apart import head_of
from psa_casadi.records.read.columns import TABLE, columns_of, parse_columns
from psa_casadi.records.read.reading import read_records
from psa_casadi.records.record import Record

#: Time [s] that a file may take.
_LIMIT_S = 120.0
_MODULE = "psa_casadi.workbench.previews"


def preview(
    folder: Path, path: Path, columns: str | None, sample_time: float | None, *, held: bool
) -> dict[str, Any]:
    """Return the head of a file, the problems that it is read with, and the record in a picture.

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
    found = _problem(*problems)
    if head is not None:
        guess = {name: [f.index, f.unit] for name, f in head.guess.items()}
        found["head"] = {n: getattr(head, n) for n in ("names", "units", "rows", "tables")}
        found["head"]["guess"] = guess
    if record is not None:
        found["record"] = _told(record)
    return found


def _problem(*sentences: str) -> dict[str, Any]:
    return {"head": None, "problems": list(sentences), "record": None}


def _told(record: Record) -> dict[str, Any]:
    """Return how long a record is, what it reaches, and its picture."""
    x = record.displacement
    reached = [] if x is None else [float(np.nanmin(x)), float(np.nanmax(x))]
    others = ("load_force", "current", "temperature", "monitor_voltage", "charge",
              "displacement_2", "strain")  # fmt: skip
    return {
        "n": record.n,
        "seconds": float(record.time[-1] - record.time[0]),
        "unit": record.displacement_unit,
        "reached": reached,
        "others": [name for name in others if getattr(record, name) is not None],
        "picture": _picture(record),
    }


def _picture(record: Record) -> str:
    """Return a small PNG: the voltage over time, and where there is one the loop."""
    figure = Figure(figsize=(8.4, 2.5), dpi=100, layout="constrained")
    over_time, loop = figure.subplots(1, 2)
    over_time.plot(record.time, record.voltage, color="#0072b2", linewidth=0.9)
    over_time.set(xlabel="time [s]", ylabel="voltage [V]")
    if record.displacement is None:
        loop.set_axis_off()
    else:
        scale, unit = (1e6, "µm") if record.displacement_unit == "m" else (1.0, "counts")
        x = scale * record.displacement
        loop.plot(record.voltage, x, color="#3a3a3a", linewidth=0.7)
        loop.set(xlabel="voltage [V]", ylabel=f"displacement [{unit}]")
    for axes in (over_time, loop):
        axes.grid(color="#e4e7ea")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return base64.b64encode(buffer.getvalue()).decode("ascii")


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
