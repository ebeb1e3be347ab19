"""One row of the check of an FMU, and how it comes of a check that lists or measures."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from psa_casadi.common.errors import PsaError

#: What a check may raise on an FMU that is not as expected; the row then did not pass.
BREAKDOWNS = (
    PsaError, ArithmeticError, AttributeError, LookupError, OSError, RuntimeError, TypeError,
    ValueError,
)  # fmt: skip
#: The checks that an FMU with a fixed step has nothing for: no model exchange, whose equations,
#: indicators and derivatives they need; no parameter to change; no tolerance; no evidence. Those of
#: FMI 3.0 only come second.
LEFT_OUT = (
    "model exchange instantiates", "parameter changes", "nominal values", "event indicators",
    "dependencies complete", "directional derivatives", "event indicators of the model",
    "equations", "model exchange", "co-simulation, default tolerance", "evidence inside",
)  # fmt: skip
LEFT_OUT3 = ("adjoint derivatives",)
#: The checks that need lief.
OF_BINARIES = ("functions present", "no other symbols", "binaries in their folders", "GNU libc")
_LONGEST = 4000


@dataclass(frozen=True)
class CheckRow:
    """One check: its figure, the limit, and a remark on what is wrong or was compared.

    `clause` is that of the standard, of a foreign FMU's; `noted` is true if it passed with a remark
    to know.
    """

    name: str
    figure: float
    limit: float
    passed: bool
    remark: str
    clause: str = ""
    noted: bool = False


class Remark(str):
    """A remark on what is no violation."""

    __slots__ = ()


#: What a check finds: violations, notes, and its figure.
Findings = Iterable[str | float]


@dataclass(frozen=True)
class Check:
    """A check that is still to be made: it lists what it finds, measures a figure, or gives a row.

    No violation may be listed; a figure is at most `limit`, of any size if that is 0, and NaN does
    not pass. A foreign FMU's check has the `clause` of the standard, which may be empty: what stops
    it violates that.
    """

    name: str
    run: Callable[[], Findings | float | CheckRow]
    limit: float = 0.0
    clause: str | None = None

    def row(self) -> CheckRow:
        """Make the check and return its row."""
        violations, notes = list[str](), list[str]()
        figure, limit, foreign = None, 0.0, self.clause is not None
        try:
            check_row = self.run()
            if isinstance(check_row, CheckRow):
                return check_row
            for item in (check_row,) if isinstance(check_row, float) else check_row:
                if isinstance(item, float):
                    figure, limit = item, self.limit
                else:
                    (notes if isinstance(item, Remark) else violations).append(str(item))
        except BREAKDOWNS as error:
            violations.append(str(error) if foreign else f"the check stopped: {error}")
            if not foreign:
                figure, limit = float("nan"), self.limit
        figure = float(len(violations)) if figure is None else figure
        passed = not violations and (limit <= 0.0 or figure <= limit)
        remark, noted = plain("; ".join([*violations, *notes])), foreign and passed and bool(notes)
        return CheckRow(self.name, figure, limit, passed, remark, self.clause or "", noted)


def stopped(name: str, remark: str) -> CheckRow:
    """Return the row of a check that did not come to a result."""
    return CheckRow(name, float("nan"), 0.0, False, plain(remark))


def plain(remark: str) -> str:
    """Return a text on one line that cannot steer a terminal; it may repeat texts of an FMU."""
    line = "".join(c if c.isprintable() else "?" for c in " ".join(remark.split()))
    return line if len(line) <= _LONGEST else f"{line[:_LONGEST]} ..."
