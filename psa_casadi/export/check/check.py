"""The check of an FMU: is it valid, does it behave, does it agree with its model."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ParamSpec

from fmpy.validation import validate_fmu

from psa_casadi.component import Component
from psa_casadi.errors import InputError, PsaError
from psa_casadi.export.check.agreement import agreements
from psa_casadi.export.check.calls import CALLS
from psa_casadi.export.check.description import (
    inconsistent_units,
    missing_functions,
    missing_notices,
    needless_symbols,
    new_libraries,
    published_as,
    undefined_units,
    wrong_nominals,
)
from psa_casadi.export.check.events import (
    event_indicators,
    event_mode,
    intermediate_update,
    wrong_indicators,
)
from psa_casadi.export.check.origin import (
    unreproducible_parts,
    wrong_dependencies,
    wrong_start_values,
)
from psa_casadi.export.check.structure import (
    adjoint_error,
    directional_error,
    equation_error,
    incomplete_dependencies,
    wrong_start,
)
from psa_casadi.export.fmu.archive import MODEL_ENTRY
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import loads

_DIRECTIONAL_LIMIT = 1e-5
_ADJOINT_LIMIT = 1e-10
_EQUATION_LIMIT = 1e-9
#: What a check may raise on an FMU that is not as expected; the row then did not pass.
_BREAKDOWNS = (
    PsaError, ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError,
)  # fmt: skip

P = ParamSpec("P")


@dataclass(frozen=True)
class CheckRow:
    """One check: what was found, how much is allowed, and what is wrong or was compared."""

    name: str
    figure: float
    limit: float
    passed: bool
    remark: str


@dataclass(frozen=True)
class CheckReport:
    """All checks of one FMU; `compared` says whether there was a model to compare with."""

    path: Path
    rows: tuple[CheckRow, ...]
    compared: bool

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
) -> CheckReport:
    """Check an FMU of FMI 2.0 or 3.0: description, binaries, calls, derivatives, trajectories.

    It is compared with `model`, else with the model it carries (resources/model.json), else with
    none. `effects` are own ones that the model inside may have. Sensor and environment of the model
    are left out if the FMU leaves them out. A check that breaks down is a row that did not pass;
    the others still run, except those that need an instance if there is none.

    Raises InputError if the file is no FMU.
    """
    path = Path(path)
    with Archive(path) as archive:
        rows = [_count("description valid", _invalid, path)]
        rows += [_count(name, check, archive) for name, check in _DESCRIBED.items()]
        chosen: list[Model] = [model] if model else []
        if model is None and (archive.directory / MODEL_ENTRY).is_file():
            rows.append(_count("model inside", _read_model, archive, chosen, effects))
        if chosen:
            chosen = [_as_exported(archive, chosen[0])]
            rows += [_count(name, check, archive, chosen[0]) for name, check in _ORIGIN.items()]
    loaded: list[Fmu] = []
    compared = False
    rows.append(_count("binary loads", _load, path, loaded))
    for fmu in loaded:
        with fmu:
            rows += _measured(fmu, chosen)
            compared = any(row.name == "equations" for row in rows)
    return CheckReport(path, tuple(rows), compared=compared)


def _measured(fmu: Fmu, model: Sequence[Model]) -> Iterator[CheckRow]:
    """Yield the checks that need instances; `model` has one or none."""
    made = [_count(name, _instantiates, fmu, kind) for name, kind in _INTERFACES.items()]
    yield from made
    if not all(row.passed for row in made):
        return
    for name, call in (_CALLS | (_CALLS3 if fmu.version == 3 else {})).items():
        yield _count(name, call, fmu)
    yield _figure("directional derivatives", _DIRECTIONAL_LIMIT, directional_error, fmu)
    if fmu.version == 3:
        yield _figure("adjoint derivatives", _ADJOINT_LIMIT, adjoint_error, fmu)
    for chosen in model:
        yield _count("start of a run", wrong_start, fmu, chosen)
        yield _count("event indicators of the model", wrong_indicators, fmu, chosen)
        yield _figure("equations", _EQUATION_LIMIT, equation_error, fmu, chosen)
        yield from _trajectories(fmu, chosen)


def _trajectories(fmu: Fmu, model: Model) -> Iterator[CheckRow]:
    try:
        for a in agreements(fmu, model):
            yield CheckRow(a.name, a.figure, a.limit, a.figure <= a.limit, a.remark)
    except _BREAKDOWNS as error:
        yield CheckRow("trajectories", float("nan"), 0.0, False, f"the comparison stopped: {error}")


def _count(
    name: str, check: Callable[P, Iterable[str]], *args: P.args, **options: P.kwargs
) -> CheckRow:
    """Return the row of a check that lists problems; none may be found."""
    problems: list[str] = []
    try:
        problems.extend(check(*args, **options))
    except _BREAKDOWNS as error:
        problems.append(f"the check stopped: {error}")
    return CheckRow(name, float(len(problems)), 0.0, not problems, "; ".join(problems))


def _figure(
    name: str, limit: float, check: Callable[P, float], *args: P.args, **options: P.kwargs
) -> CheckRow:
    """Return the row of a check that measures a figure; NaN does not pass."""
    try:
        figure, remark = check(*args, **options), ""
    except _BREAKDOWNS as error:
        figure, remark = float("nan"), f"the check stopped: {error}"
    return CheckRow(name, figure, limit, figure <= limit, remark)


def _invalid(path: Path) -> list[str]:
    """Return what fmpy finds wrong with the archive and its description."""
    return [" ".join(str(problem).split()) for problem in validate_fmu(str(path))]


def _load(path: Path, loaded: list[Fmu]) -> Iterator[str]:
    """Append the FMU with its binary; what prevents that is the problem."""
    try:
        loaded.append(Fmu(path))
    except InputError as error:
        yield str(error)


def _read_model(
    archive: Archive, found: list[Model], effects: Iterable[Component]
) -> Iterator[str]:
    """Append the model that the FMU carries; what prevents that is the problem."""
    try:
        text = (archive.directory / MODEL_ENTRY).read_text(encoding="utf-8")
        found.append(loads(text, MODEL_ENTRY, effects))
    except PsaError as error:
        yield str(error)


def _instantiates(fmu: Fmu, interface: int) -> Iterator[str]:
    instance = fmu.instantiate(interface)
    if instance is None:
        yield "there is no instance: description and binary are not of the same export"
    else:
        instance.free()


def _as_exported(archive: Archive, model: Model) -> Model:
    """Return the model as the exporter took it: whole, or without sensor and environment."""
    whole = set(model.output_names) <= set(archive.names("output"))
    return published_as(archive, model if whole else model.plant())


_DESCRIBED: dict[str, Callable[[Archive], Iterable[str]]] = {
    "units defined": undefined_units,
    "units consistent": inconsistent_units,
    "functions present": missing_functions,
    "no other symbols": needless_symbols,
    "GNU libc 2.17": new_libraries,
    "licence inside": missing_notices,
}
_ORIGIN: dict[str, Callable[[Archive, Model], Iterable[str]]] = {
    "start values": wrong_start_values,
    "dependencies of the model": wrong_dependencies,
    "reproducible": unreproducible_parts,
}
_INTERFACES = {
    "co-simulation instantiates": CO_SIMULATION,
    "model exchange instantiates": MODEL_EXCHANGE,
}
_CALLS: dict[str, Callable[[Fmu], Iterable[str]]] = {
    **CALLS,
    "nominal values": wrong_nominals,
    "event indicators": event_indicators,
    "dependencies complete": incomplete_dependencies,
}
_CALLS3: dict[str, Callable[[Fmu], Iterable[str]]] = {
    "intermediate update": intermediate_update,
    "event mode": event_mode,
}
