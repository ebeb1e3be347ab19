"""One row of the check of an FMU, and how it comes of a check that lists or measures."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import ParamSpec

from psa_casadi.errors import PsaError

#: What a check may raise on an FMU that is not as expected; the row then did not pass.
BREAKDOWNS = (
    PsaError, ArithmeticError, AttributeError, LookupError, OSError, RuntimeError, TypeError,
    ValueError,
)  # fmt: skip
#: The checks that an FMU with a fixed step has nothing for: no model exchange, whose equations,
#: indicators and derivatives they need; no parameter to change; no update within a step, no
#: tolerance; no evidence. Those of FMI 3.0 only come second.
LEFT_OUT = (
    "model exchange instantiates", "parameter changes", "nominal values", "event indicators",
    "dependencies complete", "directional derivatives", "event indicators of the model",
    "equations", "model exchange", "co-simulation, default tolerance", "evidence inside",
)  # fmt: skip
LEFT_OUT3 = ("intermediate update", "adjoint derivatives")
_LONGEST = 4000

P = ParamSpec("P")


@dataclass(frozen=True)
class CheckRow:
    """One check: what was found, how much is allowed, and what is wrong or was compared."""

    name: str
    figure: float
    limit: float
    passed: bool
    remark: str


def count(
    name: str, check: Callable[P, Iterable[str]], *args: P.args, **options: P.kwargs
) -> CheckRow:
    """Return the row of a check that lists problems; none may be found."""
    problems: list[str] = []
    try:
        problems.extend(check(*args, **options))
    except BREAKDOWNS as error:
        problems.append(f"the check stopped: {error}")
    return CheckRow(name, float(len(problems)), 0.0, not problems, plain("; ".join(problems)))


def figure(
    name: str, limit: float, check: Callable[P, float], *args: P.args, **options: P.kwargs
) -> CheckRow:
    """Return the row of a check that measures a figure; NaN does not pass."""
    try:
        found, remark = check(*args, **options), ""
    except BREAKDOWNS as error:
        found, remark = float("nan"), f"the check stopped: {error}"
    return CheckRow(name, found, limit, found <= limit, plain(remark))


def stopped(name: str, remark: str) -> CheckRow:
    """Return the row of a check that did not come to a result."""
    return CheckRow(name, float("nan"), 0.0, False, plain(remark))


def plain(remark: str) -> str:
    """Return a text on one line that cannot steer a terminal; it may repeat what an FMU says."""
    line = "".join(c if c.isprintable() else "?" for c in " ".join(remark.split()))
    return line if len(line) <= _LONGEST else f"{line[:_LONGEST]} ..."
