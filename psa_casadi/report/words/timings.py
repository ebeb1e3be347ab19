"""What the stages of long work took, as a table."""

from collections.abc import Sequence

from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.timings import Stage


def timings_table(stages: Sequence[Stage]) -> Table:
    """Return time, processor time of all threads with its share, and simulations of every stage.

    Behind the simulations stands how many of them were with sensitivities.
    """
    total = Stage(
        "total",
        sum(s.wall for s in stages),
        sum(s.processor for s in stages),
        sum(s.runs for s in stages),
        sum(s.differentiated for s in stages),
    )
    rows = [_row(s, total.processor) for s in (*stages, total)]
    head = ("stage", "time", "processor", "share", "simulations", "with sensitivities")
    return Table(head, tuple(rows))


def _row(s: Stage, total: float) -> tuple[str, ...]:
    share = f"{100.0 * s.processor / total:.0f} %" if total > 0 else ""
    runs = (str(s.runs), str(s.differentiated)) if s.runs else ("", "")
    return (s.name, f"{s.wall:.2f} s", f"{s.processor:.2f} s", share, *runs)
