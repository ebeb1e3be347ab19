"""The benchmark `stability`: the same verdict and names where data change far below their noise.

Cases of the study, the records of the exam, and the measured micromanipulator.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi import datasets
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.records.record import Record
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.exam import read_back
from tests.studies.benchmarks.hidden_cases import Case, names_of, records_of, study
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores, share
from tests.studies.exam.record import Record as ExamRecord
from tests.studies.exam.records import RECORDS
from tests.studies.plants.table import FOREIGN, KNOWN

#: The first of the seeds, which no other benchmark uses.
FIRST = 480201
#: Cases of the study and draws of each; the change, over the rms of the noise.
CASES, DRAWS, QUICK_CASES, QUICK_DRAWS, CHANGE = 40, 20, 6, 3, 0.01
#: Draws of records of the exam, of which a quick run takes one of so many, and of measured rows.
EXAM_DRAWS, QUICK_EXAM, MEASURED_DRAWS, QUICK_MEASURED_DRAWS = 3, 12, 9, 1
_KINDS = ("known", "weak", "clean", "foreign", "left out", "two", "poor", "design", "ringing")
#: Rows of `docs/measured.md`, and the noise that a diagnosis tells of these records [m].
MEASURED, _MEASURED_NOISE = ("sine_1hz", "minor_loops", "both files"), 67e-9

#: A case of the study, a record of the exam, or a row of the measured ones.
Source = Case | ExamRecord | str
Said = tuple[str, frozenset[str], frozenset[str]]


@dataclass(frozen=True)
class Repeated:
    """What was said of records of a kind, and of them with their data changed."""

    kind: str
    first: Said
    changed: tuple[Said, ...]

    @property
    def same_verdict(self) -> int:
        """Draws with the same verdict and the same names."""
        return sum(said[:2] == self.first[:2] for said in self.changed)

    @property
    def same_set(self) -> int:
        """Draws with the same verdict, whose set of names still holds the first's names."""
        return sum(s[0] == self.first[0] and self.first[1] <= s[2] for s in self.changed)


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose everything as it is, then with white noise of 1 % of its own added."""
    jobs: list[tuple[str, Source, int]] = [
        (c.kind, c, QUICK_DRAWS if quick else DRAWS)
        for c in chosen_cases(QUICK_CASES if quick else CASES)
    ]
    exam = RECORDS[::QUICK_EXAM] if quick else RECORDS
    jobs += [("exam", record, 1 if quick else EXAM_DRAWS) for record in exam]
    draws = QUICK_MEASURED_DRAWS if quick else MEASURED_DRAWS
    jobs += [("measured", row, draws) for row in MEASURED]
    return Outcome([table(repeated(jobs, progress))])


def repeated(jobs: Sequence[tuple[str, Source, int]], progress: Progress) -> list[Repeated]:
    """Return what is said of records, and with their data changed so many times."""
    draws = [(source, k) for _, source, n in jobs for k in range(n + 1)]
    said = iter(on_all_cores(said_of, draws, lambda one: f"{one[0]} {', '.join(one[1])}", progress))
    return [Repeated(kind, next(said), tuple(itertools.islice(said, n))) for kind, _, n in jobs]


def chosen_cases(count: int) -> list[Case]:
    """Return cases of every kind in turn, evenly from a study."""
    every = study(KNOWN, FOREIGN, 2, FIRST)
    rows = [[c for c in every if c.kind == kind] for kind in _KINDS]
    each = -(-count // len(rows))
    spread = [[own[len(own) * k // each] for k in range(each)] for own in rows]
    return [own[k] for k in range(each) for own in spread][:count]


def said_of(source: Source, draw: int) -> Said:
    """Return verdict, names, and the whole set, of records with their data changed; draw 0 is not.

    Readings are changed by white noise of `CHANGE` times the rms of their own.
    """
    noise, records = _records(source)
    seed = MEASURED.index(source) if isinstance(source, str) else source.seed
    rng = np.random.default_rng([seed, draw])
    size = CHANGE * noise if draw else 0.0
    changed = [
        replace(r, displacement=r.displacement + size * rng.standard_normal(r.n))
        for r in records
        if r.displacement is not None
    ]
    d = diagnose(changed)
    named, within = names_of(d)
    return d.verdict, frozenset(named), frozenset(within)


def _records(source: Source) -> tuple[float, Sequence[Record]]:
    """Return the rms of the noise of the readings [m], and the records."""
    if isinstance(source, Case):
        truth, records = records_of(source)
        return truth.sigma, records
    if isinstance(source, ExamRecord):
        record = read_back(source)
        return 1e-2 * source.test.noise * record.range_m, [record]
    sine, loops = datasets.micromanipulator()
    rows = dict(zip(MEASURED, ([sine], [loops], [sine, loops]), strict=True))
    return _MEASURED_NOISE, rows[source]


_SAME = ("same_verdict", "same_set")


def table(found: Sequence[Repeated]) -> TitledTable:
    """Return how often verdict and names stayed, by kind of case."""
    rows = []
    for kind in (*dict.fromkeys(r.kind for r in found), "all"):
        own = [r for r in found if kind in (r.kind, "all")]
        draws = sum(len(r.changed) for r in own)
        same = (
            share(sum(counts), draws)
            for counts in zip(*((r.same_verdict, r.same_set) for r in own), strict=True)
        )
        unchanged = sum(r.same_verdict == len(r.changed) for r in own)
        rows.append((kind, f"{len(own)}", *same, f"{unchanged}"))
    head = ("cases", "number", "same verdict and names", "same verdict, names in the set",
            "cases without a change")  # fmt: skip
    return TitledTable(
        "Data changed by 1 % of their noise",
        Table(head, tuple(rows)),
        "Everything is diagnosed as it is, and with white noise of 1 % of its own added.",
    )
