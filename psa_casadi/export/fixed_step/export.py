"""A model as two files of C99 for a controller: a step of fixed length and constant cost."""

import math
import os
from dataclasses import dataclass
from pathlib import Path

from psa_casadi.export.common.foreign import refuse_foreign
from psa_casadi.export.fixed_step.planning import fixed_step
from psa_casadi.export.fixed_step.probe import VoltageError
from psa_casadi.files import atomic_write, make_folder
from psa_casadi.model.compose import Model


@dataclass(frozen=True)
class CodeExport:
    """The files that were written, the substeps of a step, and the errors that were measured.

    An error is the largest one of the displacement over its range, on one reference voltage. A
    voltage beyond `limit` [V] is limited to it; it is infinite where there is no voltage.
    """

    header: Path
    source: Path
    substeps: int
    errors: tuple[VoltageError, ...]
    limit: float = math.inf


def export_c(
    model: Model,
    directory: str | os.PathLike[str],
    *,
    step: float,
    precision: str = "double",
    name: str | None = None,
    include_sensor: bool = False,
    hold: str = "linear",
    substeps: int | None = None,
) -> CodeExport:
    """Write a model as `name.c` and `name.h`: `name_init` and `name_step`, C99, no allocation.

    `step` is the time [s] between two calls of `name_step`. `precision` is "double" or "single".
    Inputs are reached at the end of a step along a line (`hold` "linear") or hold over it ("zero").
    A step is `substeps` equal ones; by default the fewest of 1, 2, 4 and 8 that err by less than
    0.1 % of the range. Parameters are fixed; `settled_at` gives a model another start. Sensor and
    environment stay out unless `include_sensor`. `name` is a C identifier, by default the model's
    name. The code is compiled here and compared with the stepper on reference voltages.

    Raises InputError for bad arguments, a model that does not fit (with the effect and the reason)
    or a step that is too long, and MachineError if the compiler fails.
    """
    refuse_foreign(model.structure, "C")
    exported = model if include_sensor else model.plant()
    identifier = name or model.name
    found = fixed_step(
        exported, name=identifier, step=step, precision=precision, hold=hold, substeps=substeps
    )
    folder = Path(directory)
    make_folder(folder)
    for file_name, text in found.texts.items():
        atomic_write(folder / file_name, text)
    return CodeExport(
        folder / f"{identifier}.h",
        folder / f"{identifier}.c",
        found.plan.substeps,
        found.errors,
        found.plan.limit,
    )
