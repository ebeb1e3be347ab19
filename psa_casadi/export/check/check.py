"""The check of an FMU: is it valid, does it behave, does it agree with its model."""

import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.files import requests_to_end_answered, why_not_read
from psa_casadi.common.strict_json import read_json
from psa_casadi.export.check import binaries, description
from psa_casadi.export.check.agreement import fixed_truth, stated_step, truth_of
from psa_casadi.export.check.apart import OVERTIME, Task, rows_apart
from psa_casadi.export.check.evidence import repeated, wrong_evidence
from psa_casadi.export.check.foreign import described
from psa_casadi.export.check.rows import (
    LEFT_OUT,
    LEFT_OUT3,
    OF_BINARIES,
    Check,
    CheckRow,
    plain,
    stopped,
)
from psa_casadi.export.fmu.archive import MODEL_ENTRY
from psa_casadi.export.fmu.evidence import with_validity
from psa_casadi.export.fmu.sources import fixed_step_of
from psa_casadi.export.importer.archive import Archive, archive_problems
from psa_casadi.model.component import Component
from psa_casadi.model.components.outputs import OUTPUT as VALIDITY
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import model_of
from psa_casadi.records.record import Record

__all__ = ["CheckReport", "CheckRow", "check_fmu"]

#: Default limits of a whole check [s], and of the foreign code in it [bytes].
TIMEOUT, MEMORY = 600.0, 4 << 30


@dataclass(frozen=True)
class CheckReport:
    """All checks of one FMU; `compared` is true if there was a model to compare with.

    `left_out` names the checks that this kind of FMU has nothing for, or that need lief where that
    is not installed. A `foreign` FMU was checked by the standard alone.
    """

    path: Path
    rows: tuple[CheckRow, ...]
    compared: bool
    left_out: tuple[str, ...] = ()
    foreign: bool = False

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(row.passed for row in self.rows)

    @property
    def failures(self) -> tuple[CheckRow, ...]:
        """The checks that did not pass."""
        return tuple(row for row in self.rows if not row.passed)


def check_fmu(
    path: str | os.PathLike[str],
    model: Model | None = None,
    effects: Iterable[Component] = (),
    *,
    timeout: float = TIMEOUT,
    memory: int = MEMORY,
    evidence: bool = False,
    records: Sequence[Record] = (),
    portable: bool = False,
    foreign: bool | None = None,
) -> CheckReport:
    """Check an FMU of FMI 2.0 or 3.0: description, binaries, calls, derivatives, trajectories.

    It is compared with `model`, else with the model it carries (resources/model.json), else with
    none. `effects` are the user's effects that the model inside may have. Sensor and environment of
    the model are left out if the FMU leaves them out. A check that breaks down is a row that did
    not pass; the others still run, except those that need an instance if there is none.

    With `evidence` the run of the model's evidence is played again, and so are those of `records`
    that stand behind it: is the error what the model states?

    This runs the code of the FMU, in a separate process: `timeout` [s] is what all checks
    together may take, `memory` [bytes] what the code may take in addition to Python, on Linux.
    However it ends, its rows are kept, and the check that ran did not pass. It is no sandbox: files
    and network are open to the code. An archive that would leave its folder, has links, is damaged
    or a bomb is not unpacked, and nothing of it runs.

    Its binary for this machine must load on systems like this one, with `portable` on old ones.
    Without lief (`pip install lief`) the binaries are not inspected.

    A `foreign` one, by default every one of another tool without a `model`, or around one, is
    checked by the standard alone: a row fails where a clause is violated, and notes what else a
    buyer should know. See docs/howto/fmu_export.md.

    Of an FMU with a fixed step the errors that it states are measured again; `left_out` names the
    checks that mean nothing there.

    Raises InputError if the file is no FMU, for `evidence` of one with a fixed step, and for
    `portable` without lief.
    """
    path = Path(path)
    if portable and not binaries.has_lief():
        raise InputError(
            "What a binary needs of its system is unknown without lief; run `pip install lief`,"
            " or leave --portable out."
        )
    _demand_zip(path)
    rows = [
        CheckRow(name, float(len(problems)), 0.0, not problems, plain("; ".join(problems)))
        for name, problems in archive_problems(path).items()
    ]
    if not all(row.passed for row in rows):
        return CheckReport(path, tuple(rows), compared=False)
    chosen: list[Model] = [model] if model else []
    end = time.monotonic() + timeout
    with requests_to_end_answered(), Archive(path) as archive:
        if foreign is None:
            ours = str(archive.description.generationTool).startswith("psa_casadi")
            holds_others = any(archive.directory.glob("resources/*/modelDescription.xml"))
            foreign = holds_others or (model is None and not ours)
        _refuse_other(archive, model)
        if foreign:
            rows += [c.row() for c in described(archive)]
            task = Task(path, archive.directory, None, timeout, memory, foreign=True)
            rows += rows_apart(task, end)
            return CheckReport(path, tuple(rows), compared=False, foreign=True)
        stated = stated_step(archive.directory)
        if stated is not None and (evidence or records):
            raise InputError(
                f"{path}: this FMU takes fixed steps of {stated.step:g} s and carries no evidence;"
                " leave --evidence and --record out, or check an FMU with the adaptive solver."
            )
        for check in _described(archive, chosen, tuple(effects)):
            rows.append(check.row())
            if time.monotonic() > end:
                rows.append(stopped("time", OVERTIME.format(timeout)))
                return CheckReport(path, tuple(rows), compared=False)
        model, version, truth = chosen[0] if chosen else None, archive.version, None
        if model:
            truth = fixed_truth(model, version, stated) if stated else truth_of(model, version)
        again = repeated(archive, model, records) if evidence or records else ()
        rows += [row for row in again if isinstance(row, CheckRow)]
        runs = tuple(run for run in again if not isinstance(run, CheckRow))
        rows += rows_apart(
            Task(path, archive.directory, truth, timeout, memory, portable, runs), end
        )
        left_out = LEFT_OUT + (LEFT_OUT3 if archive.version == 3 else ()) if stated else ()
    if not binaries.has_lief():
        left_out = (*left_out, *OF_BINARIES)
    last = "start of a run" if stated else "equations"
    done = any(row.name == last for row in rows)
    return CheckReport(path, tuple(rows), done, left_out)


def _demand_zip(path: Path) -> None:
    try:
        with path.open("rb") as file:
            head = file.read(2)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({why_not_read(error)}); name an FMU.") from error
    if head != b"PK":
        raise InputError(f"{path}: cannot be read as an FMU, as it is no zip; export it again.")


def _refuse_other(archive: Archive, model: Model | None) -> None:
    """Refuse a model of which the FMU has no input."""
    if model and model.input_names and archive.elements.keys().isdisjoint(model.input_names):
        raise InputError(
            f"{archive.path}: has no input of the model ({', '.join(model.input_names)}); give the"
            " model that it was exported from, or none: an FMU of psa_casadi holds its model."
        )


def _described(
    archive: Archive, chosen: list[Model], effects: tuple[Component, ...]
) -> Iterator[Check]:
    """Yield what the files say; `chosen` has the model, or gets the one inside, as exported.

    Each check is to be made before the next one is taken.
    """

    def read_model() -> Iterator[str]:
        """Append the model that the FMU carries; what prevents that is the problem."""
        try:
            content = read_json(archive.directory / MODEL_ENTRY, "export it again.", MODEL_ENTRY)
            chosen.append(model_of(content, MODEL_ENTRY, effects))
        except PsaError as error:
            yield str(error)

    for name, check in description.DESCRIBED.items():
        yield Check(name, partial(check, archive))
    if not chosen and (archive.directory / MODEL_ENTRY).is_file():
        yield Check("model inside", read_model)
    if chosen:
        chosen[:] = [as_exported(archive, chosen[0])]
        model = chosen[0]
        yield Check("start values", partial(description.wrong_start_values, archive, model))
        yield Check(
            "dependencies of the model", partial(description.wrong_dependencies, archive, model)
        )
        if model.evidence is not None and fixed_step_of(archive.directory) is None:
            yield Check("evidence inside", partial(wrong_evidence, archive, model))
        yield Check("reproducible", partial(description.reproducible, archive, model))


def as_exported(archive: Archive, model: Model) -> Model:
    """Return the model as the exporter took it: whole, or without sensor and environment.

    With the output for how far a run is outside of the records' range, where the FMU has it. Sensor
    and environment are left out where all their variables are missing: a sensor's effect need not
    have an output.
    """
    inside, apart = (
        {v.name for c in model.components if c.in_plant is plant for v in _variables(c)}
        for plant in (True, False)
    )
    outside = apart - inside  # variables of sensor and environment alone
    without = outside and outside.isdisjoint(archive.references)
    exported = model.plant() if without else model
    if VALIDITY in archive.names("output") and exported.evidence is not None:
        exported = with_validity(exported)
    return description.published_as(archive, exported)


def _variables(c: Component) -> Iterable[Any]:
    return (*c.parameters, *c.states, *c.sampled, *c.inputs, *c.outputs)
