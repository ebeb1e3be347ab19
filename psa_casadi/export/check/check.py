"""The check of an FMU: is it valid, does it behave, does it agree with its model."""

import os
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from psa_casadi.component import Component
from psa_casadi.components.outputs import OUTPUT as VALIDITY
from psa_casadi.errors import InputError, PsaError
from psa_casadi.export.check.agreement import truth_of
from psa_casadi.export.check.description import (
    inconsistent_units,
    invalid,
    misplaced_binaries,
    missing_functions,
    missing_notices,
    needless_symbols,
    new_libraries,
    oldest_systems,
    published_as,
    undefined_units,
)
from psa_casadi.export.check.evidence import Repeated, repeated, wrong_evidence
from psa_casadi.export.check.fixed_step import StatedStep, fixed_truth, stated_step
from psa_casadi.export.check.origin import (
    not_compared,
    unreproducible_parts,
    wrong_dependencies,
    wrong_start_values,
)
from psa_casadi.export.check.process import OVERTIME, started
from psa_casadi.export.check.rows import LEFT_OUT, LEFT_OUT3, CheckRow, count, stopped
from psa_casadi.export.check.task import MEMORY, TIMEOUT, Limits, Task
from psa_casadi.export.check.truth import Truth
from psa_casadi.export.fmu.archive import MODEL_ENTRY
from psa_casadi.export.fmu.evidence import with_validity
from psa_casadi.export.fmu.sources import fixed_step_of
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.unpack import archive_problems
from psa_casadi.files import why_not_read
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import loads
from psa_casadi.records.record import Record
from psa_casadi.scratch import requests_to_end_answered
from psa_casadi.strict_json import read_json_text

__all__ = ["CheckReport", "CheckRow", "check_fmu"]


@dataclass(frozen=True)
class CheckReport:
    """All checks of one FMU; `compared` says whether there was a model to compare with.

    `left_out` names the checks that this kind of FMU has nothing for.
    """

    path: Path
    rows: tuple[CheckRow, ...]
    compared: bool
    left_out: tuple[str, ...] = ()

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
) -> CheckReport:
    """Check an FMU of FMI 2.0 or 3.0: description, binaries, calls, derivatives, trajectories.

    It is compared with `model`, else with the model it carries (resources/model.json), else with
    none. `effects` are own ones that the model inside may have. Sensor and environment of the model
    are left out if the FMU leaves them out. A check that breaks down is a row that did not pass;
    the others still run, except those that need an instance if there is none.

    With `evidence` the run of the model's evidence is played again, and so are those of `records`
    that stand behind it: is the error what the model states?

    This runs the code of the FMU, in a process of its own: `timeout` [s] is what all checks
    together may take, `memory` [bytes] what the code may take beside Python's own, on Linux.
    However it ends, its rows are kept, and the check that ran did not pass. It is no sandbox: files
    and network are open to the code. An archive that would leave its folder, has links, is damaged
    or a bomb is not unpacked, and nothing of it runs.

    Its binary for this machine must load on systems like this one, with `portable` on old ones.

    Of an FMU with a fixed step the errors that it states are measured again; `left_out` names the
    checks that mean nothing there.

    Raises InputError if the file is no FMU, or if evidence is asked of one with a fixed step.
    """
    path = Path(path)
    rows = _archive_rows(path)
    if not all(row.passed for row in rows):
        return CheckReport(path, tuple(rows), compared=False)
    chosen: list[Model] = [model] if model else []
    end = time.monotonic() + timeout
    with requests_to_end_answered(), Archive(path) as archive:
        stated = stated_step(archive.directory)
        if stated is not None and (evidence or records):
            raise InputError(
                f"{path}: this FMU takes fixed steps of {stated.step:g} s and carries no evidence;"
                " leave --evidence and --record out, or check an FMU with the adaptive solver."
            )
        carried = (archive.directory / MODEL_ENTRY).is_file()
        with started(_INTEGRATOR if model or carried else ()) as process:
            for row in _described(archive, chosen, tuple(effects), portable=portable):
                rows.append(row)
                if time.monotonic() > end:
                    rows.append(stopped("time", OVERTIME.format(timeout)))
                    return CheckReport(path, tuple(rows), compared=False)
            truth = _truth(chosen[0], archive.version, stated) if chosen else None
            again = Repeated((), ())
            if evidence or records:
                again = repeated(archive, chosen[0] if chosen else None, records)
            rows += again.rows
            key, limits = secrets.token_bytes(32), Limits(timeout, memory)
            task = Task(path, archive.directory, truth, key, limits, again.playbacks)
            rows += process.rows(task, end)
    last = "start of a run" if stated else "equations"
    compared = any(row.name == last for row in rows)
    left_out = LEFT_OUT + (LEFT_OUT3 if archive.version == 3 else ())
    return CheckReport(path, tuple(rows), compared, left_out if stated else ())


def _truth(model: Model, version: int, stated: StatedStep | None) -> Truth:
    return fixed_truth(model, version, stated) if stated else truth_of(model, version)


def _archive_rows(path: Path) -> list[CheckRow]:
    """Return the checks of the archive itself; raises InputError if the file is none."""
    try:
        with path.open("rb") as file:
            head = file.read(2)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({why_not_read(error)}); name an FMU.") from error
    if head != b"PK":
        raise InputError(f"{path}: cannot be read as an FMU, as it is no zip; export it again.")
    found = archive_problems(path)
    listed = {
        "archive names": found.names, "archive size": found.size, "archive intact": found.damage,
    }  # fmt: skip
    return [count(name, _same, problems) for name, problems in listed.items()]


def _same(problems: tuple[str, ...]) -> tuple[str, ...]:
    return problems


def _described(
    archive: Archive, chosen: list[Model], effects: tuple[Component, ...], *, portable: bool
) -> Iterator[CheckRow]:
    """Yield what the files say; `chosen` has the model, or gets the one inside, as exported."""
    yield count("description valid", invalid, archive)
    for name, check in _DESCRIBED.items():
        yield count(name, check, archive)
    libc = count("GNU libc", new_libraries, archive, portable=portable)
    yield replace(libc, remark=oldest_systems(archive)) if libc.passed else libc
    if not chosen and (archive.directory / MODEL_ENTRY).is_file():
        yield count("model inside", _read_model, archive, chosen, effects)
    if chosen:
        chosen[:] = [as_exported(archive, chosen[0])]
        for name, compared in _ORIGIN.items():
            yield count(name, compared, archive, chosen[0])
        if chosen[0].evidence is not None and fixed_step_of(archive.directory) is None:
            yield count("evidence inside", wrong_evidence, archive, chosen[0])
        yield _reproducible(archive, chosen[0])


def _reproducible(archive: Archive, model: Model) -> CheckRow:
    """Return the row of the export made again; one that passes says what it did not compare."""
    row = count("reproducible", unreproducible_parts, archive, model)
    return replace(row, remark=not_compared(archive)) if row.passed else row


def _read_model(
    archive: Archive, found: list[Model], effects: Iterable[Component]
) -> Iterator[str]:
    """Append the model that the FMU carries; what prevents that is the problem."""
    try:
        text = read_json_text(archive.directory / MODEL_ENTRY)
        found.append(loads(text, MODEL_ENTRY, effects))
    except (PsaError, OSError, ValueError) as error:
        yield str(error)


def as_exported(archive: Archive, model: Model) -> Model:
    """Return the model as the exporter took it: whole, or without sensor and environment.

    And with the output that tells how far a run is outside of what the records have shown.
    """
    exported = model.plant() if _left_out(archive, model) else model
    if VALIDITY in archive.names("output") and exported.evidence is not None:
        exported = with_validity(exported)
    return published_as(archive, exported)


def _left_out(archive: Archive, model: Model) -> bool:
    """Whether an FMU has nothing of what only sensor and environment have.

    Told by all their variables: a sensor's effect need not have an output of its own.
    """
    inside, apart = (
        {n for c in model.components if c.in_plant is plant for n in _names(c)}
        for plant in (True, False)
    )
    own = apart - inside
    return bool(own) and own.isdisjoint(v.name for v in archive.description.modelVariables)


def _names(component: Component) -> Iterator[str]:
    """Yield the names of a component's variables."""
    yield from (p.name for p in component.parameters)
    yield from (s.name for s in (*component.states, *component.sampled))
    yield from (q.name for q in component.inputs)
    yield from (y.name for y in component.outputs)


#: What the runs of a model need, imported ahead.
_INTEGRATOR = ("scipy.integrate",)
_DESCRIBED: dict[str, Callable[[Archive], Iterable[str]]] = {
    "units defined": undefined_units,
    "units consistent": inconsistent_units,
    "functions present": missing_functions,
    "no other symbols": needless_symbols,
    "binaries in their folders": misplaced_binaries,
    "licence inside": missing_notices,
}
_ORIGIN: dict[str, Callable[[Archive, Model], Iterable[str]]] = {
    "start values": wrong_start_values,
    "dependencies of the model": wrong_dependencies,
}
