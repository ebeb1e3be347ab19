"""The benchmarks `exam` and `exam_constants`: plants of another author, diagnoses and marks.

Few of the plants (`studies/exam`) are plain: what a constant decides shows where a case lies at an
edge.
"""

import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import psa_casadi as psa
from psa_casadi.diagnosis.task import Method
from tests.studies.benchmarks.ablation import moved_constants
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores
from tests.studies.exam import marks
from tests.studies.exam.play import write
from tests.studies.exam.record import Record
from tests.studies.exam.records import RECORDS

#: A quick run takes one of so many records, and moves one of so many constants.
QUICK, QUICK_CONSTANTS = 4, 8
#: The groups of the records by title, in the order of the counts.
GROUPS = {
    "clean": "clean, Bouc-Wen", "other": "clean, other hysteresis", "one": "one cause",
    "two": "two causes", "foreign": "foreign cause",
}  # fmt: skip
#: Of the records with a full mark and of the others so many, those that take the least time.
FULL, OTHERS = 8, 12
_FULL = frozenset({
    marks.ADEQUATE, marks.ALONE, marks.HYSTERESIS_FOUND, marks.NEAREST, marks.RIGHTLY_UNEXPLAINED,
})  # fmt: skip
#: This move takes 34 times as long as the method.
_TOO_LONG = "most_causes = 6"


class Marked(NamedTuple):
    """A record of the exam, what was said of it, its mark, and the processor time [s]."""

    record: Record
    answer: marks.Answer
    mark: str
    seconds: float

    def __str__(self) -> str:
        """Return record, answer and mark in a line."""
        said = f"{self.answer.verdict} {_names(self.answer)}: {self.mark}"
        return f"{self.record.name}, {self.record.says}: {said} [{self.seconds:.0f} s]"

    @property
    def group(self) -> str:
        """The group that it counts in."""
        other = self.record.group == "clean" and self.record.stack.hysteresis != "Bouc-Wen"
        return GROUPS["other" if other else self.record.group]


def run(progress: Progress, quick: bool) -> Outcome:
    """Make, diagnose and mark the records."""
    found = sat(RECORDS[::QUICK] if quick else RECORDS, progress)
    answers = [
        {"record": m.record.name, "stack": m.record.stack.hysteresis,
         "voltage": f"{m.record.test.voltage}, {m.record.test.frequency:g} Hz",
         "hidden": m.record.says, "verdict": m.answer.verdict, "names": _names(m.answer) or "-",
         "mark": m.mark}
        for m in found
    ]  # fmt: skip
    counts = []
    for group in GROUPS.values():
        given = Counter(m.mark for m in found if m.group == group)
        told = "; ".join(f"{n} {name}" for name, n in given.most_common()) or "-"
        counts.append({"hidden": group, "records": given.total(), "marks": told})
    note = "The marks are explained in tests/studies/exam/marks.py."
    return Outcome((
        TitledTable("Plants of another author", answers),
        TitledTable("Marks by group", counts, note),
    ))  # fmt: skip


def sat(
    records: Sequence[Record], progress: Progress, method: Method | None = None
) -> list[Marked]:
    """Return the marks of records in their order, worked on side by side on all cores."""
    return on_all_cores(marked, [(record, method) for record in records], progress)


def marked(record: Record, method: Method | None = None) -> Marked:
    """Make a record as a file, diagnose the file, and mark what is said."""
    read, begin = read_back(record), time.process_time()
    d = psa.diagnose([read], method=method)
    named = (marks.Named(c.effect, c.confidence, tuple(c.cannot_be_told_from)) for c in d.causes)
    answer = marks.Answer(d.verdict, tuple(named))
    return Marked(record, answer, marks.mark(record, answer), time.process_time() - begin)


def read_back(record: Record) -> psa.Record:
    """Make a record as a file, and read that."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{record.name}.csv"
        write(record, path)
        return psa.read_record(path)


def _names(answer: marks.Answer) -> str:
    """Return the names with their probabilities and their rivals."""
    told = []
    for cause in answer.causes:
        rivals = f" (or {', '.join(cause.rivals)})" if cause.rivals else ""
        told.append(f"{cause.effect} {100 * cause.probability:.0f} %{rivals}")
    return " + ".join(told)


def constants(progress: Progress, quick: bool) -> Outcome:
    """Sit the exam; then again with each constant moved, on the records that take least time."""
    ranked = sorted(sat(RECORDS, progress), key=lambda one: one.seconds)
    full = [one for one in ranked if one.mark in _FULL][:FULL]
    whole = [*full, *[one for one in ranked if one.mark not in _FULL][:OTHERS]]
    rows = []
    moved = {n: m for n, m in moved_constants().items() if n != _TOO_LONG}
    for name in list(moved)[:: QUICK_CONSTANTS if quick else 1]:
        progress(name)
        found = sat([one.record for one in whole], progress, moved[name])
        rows.append({"moved": name, **changes(whole, found)})
    note = (
        f"{len(whole)} records, of which {len(full)} have a full mark:"
        f" {', '.join(one.record.name for one in whole)}. An answer is the verdict with its names"
        " and their rivals. Processor time is over that of the method as it is."
    )
    return Outcome([TitledTable("Constants halved and doubled", rows, note)])


def changes(whole: Sequence[Marked], found: Sequence[Marked]) -> dict[str, str]:
    """Return what is another answer than before: how many, which marks, false alarms, and time."""
    pairs = list(zip(whole, found, strict=True))
    other = [old.record.name for old, new in pairs if _said(old) != _said(new)]
    marked_so = [f"{o.record.name}: {o.mark} > {n.mark}" for o, n in pairs if o.mark != n.mark]
    named = [o.record.name for o, n in pairs if n.answer.causes and not o.answer.causes
             and o.record.group == "clean"]  # fmt: skip
    spent = sum(new.seconds for new in found) / max(sum(old.seconds for old in whole), 1e-9)
    return {
        "answers changed": f"{len(other)} of {len(pairs)} {', '.join(other)}",
        "marks changed": "; ".join(marked_so) or "-",
        "names in a clean record": ", ".join(named) or "-",
        "processor time": f"{spent:.2f}",
    }


def _said(one: Marked) -> object:
    causes = {(c.effect, frozenset(c.rivals)) for c in one.answer.causes}
    return one.answer.verdict, frozenset(causes)
