"""The check of an FMU: is it valid, does it behave, does it agree with its model."""

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ParamSpec

from fmpy.validation import validate_fmu

from psa_casadi.errors import PsaError
from psa_casadi.export.check_agreement import agreements
from psa_casadi.export.check_calls import CALLS
from psa_casadi.export.check_structure import (
    directional_error,
    equation_error,
    incomplete_dependencies,
    missing_functions,
    undefined_units,
    wrong_start_values,
)
from psa_casadi.export.fmu import MODEL_ENTRY
from psa_casadi.export.fmu_instance import CO_SIMULATION, MODEL_EXCHANGE, Fmu
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import loads

_DIRECTIONAL_LIMIT = 1e-5
_EQUATION_LIMIT = 1e-9
#: What a check may raise on an FMU that is not as expected; the row then did not pass.
_BREAKDOWNS = (PsaError, ArithmeticError, AttributeError, LookupError, RuntimeError, ValueError)

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


def check_fmu(path: str | os.PathLike[str], model: Model | None = None) -> CheckReport:
    """Check an FMU: description, calling sequences, dependencies, derivatives, trajectories.

    It is compared with `model`, else with the model it carries (resources/model.json), else with
    none. Sensor and environment of the model are left out if the FMU leaves them out. A check that
    breaks down is a row that did not pass; the others still run.

    Raises InputError if the file is no FMU or has no binary for this machine.
    """
    path = Path(path)
    with Fmu(path) as fmu:
        rows = [_count("description valid", validate_fmu, str(path))]
        rows.append(_count("functions present", missing_functions, fmu))
        rows.append(_count("units defined", undefined_units, fmu))
        rows.append(_count("co-simulation instantiates", _instantiates, fmu, CO_SIMULATION))
        rows.append(_count("model exchange instantiates", _instantiates, fmu, MODEL_EXCHANGE))
        if any(not row.passed for row in rows[-2:]):
            return CheckReport(path, tuple(rows), compared=False)
        rows += [_count(name, call, fmu) for name, call in CALLS.items()]
        rows.append(_count("dependencies complete", incomplete_dependencies, fmu))
        rows.append(_figure("directional derivatives", _DIRECTIONAL_LIMIT, directional_error, fmu))
        chosen = model or _own_model(fmu)
        if chosen is not None:
            rows += _comparison(fmu, _as_exported(fmu, chosen))
    return CheckReport(path, tuple(rows), compared=chosen is not None)


def _comparison(fmu: Fmu, model: Model) -> Iterator[CheckRow]:
    yield _count("start values", wrong_start_values, fmu, model)
    yield _figure("equations", _EQUATION_LIMIT, equation_error, fmu, model)
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


def _instantiates(fmu: Fmu, interface: int) -> Iterator[str]:
    instance = fmu.instantiate(interface)
    if instance is None:
        yield "fmi2Instantiate returns NULL: description and binary are not of the same export"
    else:
        instance.free()


def _own_model(fmu: Fmu) -> Model | None:
    path = fmu.directory / MODEL_ENTRY
    return loads(path.read_text(encoding="utf-8"), MODEL_ENTRY) if path.is_file() else None


def _as_exported(fmu: Fmu, model: Model) -> Model:
    """Return the model as the exporter took it: whole, or without sensor and environment."""
    return model if set(model.output_names) <= set(fmu.names("output")) else model.plant()
