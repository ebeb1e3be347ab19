"""What `psa check --json` writes: every check with what was found and what is allowed."""

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

from psa_casadi.export.check.check import CheckReport
from psa_casadi.version import __version__

FORMAT: Literal["psa_casadi.check/1"] = "psa_casadi.check/1"


@dataclass(frozen=True)
class CheckedRow:
    """One check: the figure found (null: the check broke down), the largest allowed, a remark."""

    name: str
    found: float | None
    allowed: float
    passed: bool
    remark: str


@dataclass(frozen=True)
class CheckFile:
    """The checks of an FMU; `compared` says whether there was a model to compare with.

    `left_out` names the checks that this kind of FMU has nothing for.
    """

    format: Literal["psa_casadi.check/1"]
    package_version: str
    fmu: str
    passed: bool
    compared: bool
    rows: tuple[CheckedRow, ...]
    left_out: tuple[str, ...] = ()


def check_file(report: CheckReport) -> dict[str, Any]:
    """Return what `--json` writes of the checks of an FMU."""
    rows = (
        CheckedRow(
            r.name, r.figure if math.isfinite(r.figure) else None, r.limit, r.passed, r.remark
        )
        for r in report.rows
    )
    passed, compared = report.passed, report.compared
    path, left_out = str(report.path), report.left_out
    return asdict(CheckFile(FORMAT, __version__, path, passed, compared, tuple(rows), left_out))
