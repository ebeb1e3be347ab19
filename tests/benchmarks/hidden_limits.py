"""What records hold whose cause was missed: the same diagnosis with the right effect alone."""

from collections.abc import Sequence

from psa_casadi.report.words.tables import Table
from tests.benchmarks.hidden_cases import Found, run_case
from tests.benchmarks.outcome import Progress, TitledTable


def limits_table(missed: Sequence[Found], progress: Progress) -> TitledTable:
    """Diagnose each case again, knowing which effect is hidden but not how large it is."""
    rows = []
    for f in missed:
        progress(f"{f.case.effect} ({f.case.seed}), the right effect alone in the table")
        told = run_case(f.case, only=True)
        rows.append(limits_row(f, told))
    return TitledTable(
        "What the missed records hold",
        Table(("hidden", "seed", "rho", "said", "known beforehand", "rival"), tuple(rows)),
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
