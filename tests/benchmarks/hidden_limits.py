"""What records hold whose cause was missed: the same diagnosis with the right effect alone."""

from collections.abc import Sequence

from psa_casadi.report.words.tables import Table
from tests.benchmarks.hidden_cases import Found
from tests.benchmarks.outcome import TitledTable


def limits_table(missed: Sequence[Found], known: Sequence[Found]) -> TitledTable:
    """Return each case that was missed beside what is said where its effect is known."""
    told = {f.case: f for f in known}
    rows = tuple(limits_row(f, told[f.case]) for f in missed)
    return TitledTable(
        "What the missed records hold",
        Table(("hidden", "seed", "rho", "said", "known beforehand", "rival"), rows),
        "Known beforehand: what is said where the right effect is the only one in the table, and"
        " its evidence [nats]; a cause has a price of 8. Rival: evidence of the strongest other"
        " effect less that of the right one, in the first step with the whole table.",
    )


def limits_row(f: Found, told: Found) -> tuple[str, ...]:
    """Return the row of a case that was `f`, and `told` with the right effect alone."""
    right = str(f.case.right)
    others = [e for name, e in f.evidence.items() if name != right]
    known = f"{told.verdict}, {told.evidence.get(right, float('nan')):.1f}"
    ahead = f"{max(others) - f.evidence[right]:+.1f}" if others and right in f.evidence else "-"
    return (right, str(f.case.seed), f"{f.rho:.2f}", _said(f), known, ahead)


def _said(f: Found) -> str:
    return f"{f.verdict}: {', '.join(f.within)}" if f.within else f.verdict
