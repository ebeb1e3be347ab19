"""The benchmark `exam`: plants of another author (`studies/exam`), their diagnoses and marks."""

import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.task import Method
from psa_casadi.records.read.reading import read_record
from psa_casadi.records.record import Record as Measured
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores, table_of
from tests.studies.exam.marks import Answer, Named, mark
from tests.studies.exam.play import write
from tests.studies.exam.record import Record
from tests.studies.exam.records import RECORDS

#: A quick run takes one of so many records.
QUICK = 4
#: The groups of the records by title, in the order of the counts.
GROUPS = {
    "clean": "clean, Bouc-Wen", "other": "clean, other hysteresis", "one": "one cause",
    "two": "two causes", "foreign": "foreign cause",
}  # fmt: skip


@dataclass(frozen=True)
class Marked:
    """A record of the exam, what was said of it, its mark, and the processor time [s]."""

    record: Record
    answer: Answer
    mark: str
    seconds: float

    def __str__(self) -> str:
        """Return record, answer and mark in a line."""
        said = f"{self.answer.verdict} {_names(self.answer)}: {self.mark}"
        return f"{self.record.name}, {self.record.says}: {said} [{self.seconds:.0f} s]"

    @property
    def group(self) -> str:
        """The group that it counts in."""
        clean = self.record.group == "clean"
        other = clean and self.record.stack.hysteresis != "Bouc-Wen"
        return GROUPS["other" if other else self.record.group]


def run(progress: Progress, quick: bool) -> Outcome:
    """Make, diagnose and mark the records."""
    found = sat(RECORDS[::QUICK] if quick else RECORDS, progress)
    return Outcome((answers(found), counts(found)))


def sat(
    records: Sequence[Record], progress: Progress, method: Method | None = None
) -> list[Marked]:
    """Return the marks of records in their order, worked on side by side on all cores."""
    return on_all_cores(marked, [(record, method) for record in records], str, progress)


def marked(record: Record, method: Method | None = None) -> Marked:
    """Make a record as a file, diagnose the file, and mark what is said."""
    read, begin = read_back(record), time.process_time()
    found = diagnose([read], method=method)
    causes = (Named(c.effect, c.confidence, tuple(c.cannot_be_told_from)) for c in found.causes)
    answer = Answer(found.verdict, tuple(causes))
    return Marked(record, answer, mark(record, answer), time.process_time() - begin)


def read_back(record: Record) -> Measured:
    """Make a record as a file, and read that."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{record.name}.csv"
        write(record, path)
        return read_record(path)


def answers(found: Sequence[Marked]) -> TitledTable:
    """Return what was said of each record."""
    return table_of(
        "Plants of another author",
        found,
        {
            "record": lambda m: m.record.name,
            "stack": lambda m: m.record.stack.hysteresis,
            "voltage": lambda m: f"{m.record.test.voltage}, {m.record.test.frequency:g} Hz",
            "hidden": lambda m: m.record.says,
            "verdict": lambda m: m.answer.verdict,
            "names": lambda m: _names(m.answer) or "-",
            "mark": lambda m: m.mark,
        },
    )


def counts(found: Sequence[Marked]) -> TitledTable:
    """Return how often each mark was given, by group."""
    given = {g: Counter(m.mark for m in found if m.group == g) for g in GROUPS.values()}

    def told(group: str) -> str:
        return "; ".join(f"{n} {name}" for name, n in given[group].most_common()) or "-"

    columns: dict[str, Callable[[str], str]] = {
        "hidden": str, "records": lambda g: str(given[g].total()), "marks": told
    }  # fmt: skip
    note = "The marks are explained in tests/studies/exam/marks.py."
    return table_of("Marks by group", given, columns, note)


def _names(answer: Answer) -> str:
    """Return the names with their probabilities and their rivals."""
    told = []
    for cause in answer.causes:
        rivals = f" (or {', '.join(cause.rivals)})" if cause.rivals else ""
        told.append(f"{cause.effect} {100 * cause.probability:.0f} %{rivals}")
    return " + ".join(told)
