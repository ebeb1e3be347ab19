"""The benchmark `exam_constants`: records of the exam with each constant halved and doubled.

Their plants are another author's, and few of them are plain: what a constant decides shows where a
case lies at an edge.
"""

from collections.abc import Sequence

from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.ablation import moved_constants
from tests.studies.benchmarks.exam import Marked, sat
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable
from tests.studies.exam.marks import ADEQUATE, ALONE, HYSTERESIS_FOUND, NEAREST, RIGHTLY_UNEXPLAINED
from tests.studies.exam.records import RECORDS

#: Of the records with a full mark and of the others so many, those that take the least time.
FULL, OTHERS = 8, 12
_FULL = frozenset({ADEQUATE, ALONE, HYSTERESIS_FOUND, NEAREST, RIGHTLY_UNEXPLAINED})
#: A quick run moves one of so many constants; one move takes 34 times as long as the method.
_QUICK, _TOO_LONG = 8, "most_causes = 6"


def run(progress: Progress, quick: bool) -> Outcome:
    """Sit the exam; then again with each constant moved, on the records that take least time."""
    whole = chosen(sat(RECORDS, progress))
    moved = moved_constants()
    rows = []
    for name in [n for n in moved if n != _TOO_LONG][:: _QUICK if quick else 1]:
        progress(name)
        found = sat([one.record for one in whole], progress, moved[name])
        rows.append((name, *changes(whole, found)))
    head = (
        "moved",
        "answers changed",
        "marks changed",
        "names in a clean record",
        "processor time",
    )
    note = (
        f"{len(whole)} records, of which {sum(map(full, whole))} have a full mark:"
        f" {', '.join(one.record.name for one in whole)}. An answer is the verdict with its names"
        " and their rivals. Processor time is over that of the method as it is."
    )
    return Outcome((TitledTable("Constants halved and doubled", Table(head, tuple(rows)), note),))


def full(one: Marked) -> bool:
    """Whether no better mark can be had."""
    return one.mark in _FULL


def chosen(found: Sequence[Marked]) -> list[Marked]:
    """Return the records that are repeated."""
    ranked = sorted(found, key=lambda one: one.seconds)
    return [one for one in ranked if full(one)][:FULL] + [one for one in ranked if not full(one)][
        :OTHERS
    ]


def changes(whole: Sequence[Marked], found: Sequence[Marked]) -> tuple[str, ...]:
    """Return what is another answer than before: how many, which marks, false alarms, and time."""
    pairs = list(zip(whole, found, strict=True))
    other = [old.record.name for old, new in pairs if _said(old) != _said(new)]
    marks = [
        f"{old.record.name}: {old.mark} > {new.mark}" for old, new in pairs if old.mark != new.mark
    ]
    named = [
        new.record.name
        for old, new in pairs
        if new.record.group == "clean" and new.answer.causes and not old.answer.causes
    ]
    spent = sum(new.seconds for new in found) / max(sum(old.seconds for old in whole), 1e-9)
    return (
        f"{len(other)} of {len(pairs)}" + (f" ({', '.join(other)})" if other else ""),
        "; ".join(marks) or "-",
        ", ".join(named) or "-",
        f"{spent:.2f}",
    )


def _said(one: Marked) -> object:
    causes = {(c.effect, frozenset(c.rivals)) for c in one.answer.causes}
    return one.answer.verdict, frozenset(causes)
