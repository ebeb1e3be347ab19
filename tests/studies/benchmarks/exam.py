"""The benchmark `exam`: plants of another author (`studies/exam`), their diagnoses and marks."""

import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.diagnosis.task import Method
from psa_casadi.records.read.reading import read_record
from psa_casadi.records.record import Record as Measured
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores
from tests.studies.exam.marks import Answer, Named, mark
from tests.studies.exam.play import write
from tests.studies.exam.record import Record
from tests.studies.exam.records import RECORDS

#: A quick run takes one of so many records.
QUICK = 4
#: The groups of the records by title, in the order of the counts.
GROUPS = (
    "clean, Bouc-Wen",
    "clean, other hysteresis",
    "one cause",
    "two causes",
    "foreign cause",
)


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
        if self.record.group == "clean":
            return GROUPS[0 if self.record.stack.hysteresis == "Bouc-Wen" else 1]
        return {"one": GROUPS[2], "two": GROUPS[3], "foreign": GROUPS[4]}[self.record.group]


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
    with tempfile.TemporaryDirectory() as folder:
        read = read_back(record, Path(folder))
    begin = time.process_time()
    answer = _answer(diagnose([read], method=method))
    return Marked(record, answer, mark(record, answer), time.process_time() - begin)


def read_back(record: Record, folder: Path) -> Measured:
    """Make a record as a file in a folder, and read that."""
    path = folder / f"{record.name}.csv"
    write(record, path)
    return read_record(path)


def _answer(found: Diagnosis) -> Answer:
    causes = (Named(c.effect, c.confidence, tuple(c.cannot_be_told_from)) for c in found.causes)
    return Answer(found.verdict, tuple(causes))


def answers(found: Sequence[Marked]) -> TitledTable:
    """Return what was said of each record."""
    rows = tuple(
        (
            one.record.name,
            one.record.stack.hysteresis,
            f"{one.record.test.voltage}, {one.record.test.frequency:g} Hz",
            one.record.says,
            one.answer.verdict,
            _names(one.answer) or "-",
            one.mark,
        )
        for one in found
    )
    head = ("record", "stack", "voltage", "hidden", "verdict", "names", "mark")
    return TitledTable("Plants of another author", Table(head, rows))


def counts(found: Sequence[Marked]) -> TitledTable:
    """Return how often each mark was given, by group."""
    rows = []
    for group in GROUPS:
        given = Counter(one.mark for one in found if one.group == group)
        told = "; ".join(f"{count} {name}" for name, count in given.most_common())
        rows.append((group, str(given.total()), told or "-"))
    head = ("hidden", "records", "marks")
    return TitledTable(
        "Marks by group",
        Table(head, tuple(rows)),
        "The marks are explained in tests/studies/exam/marks.py.",
    )


def _names(answer: Answer) -> str:
    """Return the names with their probabilities and their rivals."""
    told = []
    for cause in answer.causes:
        rivals = f" (or {', '.join(cause.rivals)})" if cause.rivals else ""
        told.append(f"{cause.effect} {100 * cause.probability:.0f} %{rivals}")
    return " + ".join(told)
