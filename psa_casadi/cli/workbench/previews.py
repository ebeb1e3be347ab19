"""A preview of a file: first rows, columns, a small picture; read in a separate process.

A damaged file may end the process that reads it, and a large one fills its memory; neither is to
end the page.
"""

import base64
import contextlib
import io
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from psa_casadi.common.children import end_with_parent, heard, started_python
from psa_casadi.common.errors import InputError, MachineError
from psa_casadi.common.units import parse_unit, units_of
from psa_casadi.records.read.apart import head_of
from psa_casadi.records.read.columns import TABLE, columns_of, parse_columns
from psa_casadi.records.read.reading import read_records, read_signals
from psa_casadi.records.record import COLUMNS, Record
from psa_casadi.records.signals import Signals

#: Time [s] that a file may take.
_LIMIT_S = 120.0
_MODULE = "psa_casadi.cli.workbench.previews"


@dataclass(frozen=True)
class Subject:
    """The model whose records are diagnosed; without inputs and outputs it is a stack's.

    `units` are those of its inputs and outputs. `arguments` name it to the command `psa diagnose`,
    `files` are those next to which the command runs.
    """

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()

    @property
    def columns(self) -> dict[str, list[str]]:
        """The columns of its records, each with the units that it may have, the model's first."""
        if not self.units:
            return {n: [u for q in c.quantities for u in units_of(q)] for n, c in COLUMNS.items()}
        units = {n: units_of(parse_unit(u).quantity) for n, u in self.units.items()}
        columns = {n: list(dict.fromkeys([u, *units[n]])) for n, u in self.units.items()}
        return {"time": list(units_of("time")), **columns}


def preview(
    folder: Path,
    path: Path,
    columns: str | None,
    sample_time: float | None,
    subject: Subject,
    *,
    held: bool,
) -> dict[str, Any]:
    """Return the head of a file, the problems that it is read with, and the record in a picture.

    `folder` is where the process runs that reads it: none that holds files of others. `columns` is
    the text of --columns, `sample_time` [s] that of --sample-time; a stack's file that is `held`
    out needs no voltage that changes. `subject` is the model whose record it is.
    """
    file = path.relative_to(folder).as_posix()
    requested = {
        "file": file, "columns": columns, "sample_time": sample_time, "held": held,
        "inputs": subject.inputs, "outputs": subject.outputs,
    }  # fmt: skip
    try:
        with started_python(_MODULE, json.dumps(requested), directory=folder) as child:
            done = heard(child, limit=_LIMIT_S)
    except subprocess.TimeoutExpired:
        return _problem(f"{path.name}: reading it comes to no end; save it again.")
    except MachineError as error:
        return _problem(str(error))
    if done.returncode:
        return _problem(
            f"{path.name}: the process that read it has ended; the file is damaged or too large."
        )
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def looked_at(
    file: str,
    columns: str | None,
    sample_time: float | None,
    *,
    held: bool,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
) -> dict[str, Any]:
    """Return what `preview` returns of a file in this folder, read in this process."""
    head, problems, record_summary = None, [], None
    names = (*inputs, *outputs)
    try:
        wanted = parse_columns(columns, names) if columns else {}
        chosen = columns_of(wanted, Path(file).name).get(TABLE)
        head = head_of(file, table=chosen.array if chosen else "", names=names)
        if names:
            signals, *_ = read_signals(
                file, inputs=inputs, outputs=outputs, columns=wanted, sample_time=sample_time
            )
            record_summary = _signals_summary(signals, inputs)
        else:
            record, *_ = read_records(
                [file], columns=wanted, sample_time=sample_time, need_excitation=not held
            )
            record_summary = _record_summary(record)
    except InputError as error:
        problems = list(error.problems)
    answer = _problem(*problems)
    if head is not None:
        guess = {name: [f.index, f.unit] for name, f in head.guess.items()}
        answer["head"] = {n: getattr(head, n) for n in ("names", "units", "rows", "tables")}
        answer["head"]["guess"] = guess
    answer["record"] = record_summary
    return answer


def _problem(*sentences: str) -> dict[str, Any]:
    return {"head": None, "problems": list(sentences), "record": None}


def _record_summary(record: Record) -> dict[str, Any]:
    """Return how long a record is, what it reaches, and its picture."""
    others = ("load_force", "current", "temperature", "monitor_voltage", "charge",
              "displacement_2", "strain")  # fmt: skip
    return {
        **_extent(record, {"displacement": record.displacement_unit}),
        "others": [name for name in others if getattr(record, name) is not None],
        "picture": _loop(record),
        "alt": "voltage over time, displacement over voltage",
    }


def _signals_summary(signals: Signals, inputs: Sequence[str]) -> dict[str, Any]:
    """Return what `_record_summary` returns, of a record on any model."""
    measured = {n: signals.units.get(n, "") for n in signals.columns if n not in inputs}
    return {
        **_extent(signals, measured),
        "others": [],
        "picture": _over_time(signals, inputs),
        "alt": "inputs over time, outputs over time",
    }


def _extent(record: Signals, units: Mapping[str, str]) -> dict[str, Any]:
    """Return how long a record is, and the lowest and highest value of columns in these units."""
    columns = {n: x for n in units if (x := record.column(n)) is not None and np.isfinite(x).any()}
    reached = {n: [float(np.nanmin(x)), float(np.nanmax(x)), units[n]] for n, x in columns.items()}
    return {"n": record.n, "seconds": record.duration, "reached": reached}


def _axes() -> tuple[Figure, Axes, Axes]:
    """Return a small figure with two axes side by side."""
    figure = Figure(figsize=(8.4, 2.5), dpi=100, layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        axes.grid(color="#e4e7ea")
    return figure, left, right


def _over_time(signals: Signals, inputs: Sequence[str]) -> str:
    """Return a small PNG: the inputs over time, the outputs over time."""
    figure, left, right = _axes()
    for name, values in signals.columns.items():
        unit = signals.units.get(name, "")
        label = f"{name} [{unit}]" if unit else name
        axes = left if name in inputs else right
        axes.plot(signals.time, values, linewidth=0.9, label=label)
    for axes in (left, right):
        axes.set(xlabel="time [s]")
        if axes.lines:
            axes.legend(fontsize="small")
    return _png(figure)


def _loop(record: Record) -> str:
    """Return a small PNG: the voltage over time, and where there is one the loop."""
    figure, over_time, loop = _axes()
    over_time.plot(record.time, record.voltage, color="#0072b2", linewidth=0.9)
    over_time.set(xlabel="time [s]", ylabel="voltage [V]")
    if record.displacement is None:
        loop.set_axis_off()
    else:
        scale, unit = (1e6, "µm") if record.displacement_unit == "m" else (1.0, "counts")
        x = scale * record.displacement
        loop.plot(record.voltage, x, color="#3a3a3a", linewidth=0.7)
        loop.set(xlabel="voltage [V]", ylabel=f"displacement [{unit}]")
    return _png(figure)


def _png(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return base64.b64encode(buffer.getvalue()).decode("ascii")


def main() -> None:
    """Read the file that the command line names, and write its preview to standard output."""
    end_with_parent()
    content = json.loads(sys.argv[1])
    out = sys.stdout
    with contextlib.redirect_stdout(sys.stderr):  # libraries may print
        answer = looked_at(**content)
    json.dump(answer, out, allow_nan=False)


if __name__ == "__main__":
    main()
