"""The benchmark `stability`: the same verdict and names where data change far below their noise."""

import os
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.report.words.tables import Table
from tests.benchmarks.hidden_cases import Case, names_of, records_of, study
from tests.benchmarks.outcome import Outcome, Progress, TitledTable, share
from tests.plants.table import FOREIGN, KNOWN

#: The first of the seeds, which no other benchmark uses.
FIRST = 480201
#: Cases and draws of each; the change, over the rms of the noise.
CASES, DRAWS, QUICK_CASES, QUICK_DRAWS, CHANGE = 40, 20, 6, 3, 0.01
_KINDS = ("known", "weak", "clean", "foreign", "left out", "two", "poor", "design", "ringing")

Said = tuple[str, frozenset[str], frozenset[str]]


@dataclass(frozen=True)
class Repeated:
    """What was said of a case, and of it with the data changed."""

    case: Case
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
    """Diagnose cases of every kind as they are, then with white noise of 1 % of theirs added."""
    cases = chosen_cases(QUICK_CASES if quick else CASES)
    draws = QUICK_DRAWS if quick else DRAWS
    found = []
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        jobs = [(c, [pool.submit(said_of, c, k) for k in range(draws + 1)]) for c in cases]
        for case, own in jobs:
            first, *changed = (job.result() for job in own)
            found.append(Repeated(case, first, tuple(changed)))
            progress(f"{case.kind}, {case.effect}: {found[-1].same_verdict} of {draws} alike")
    return Outcome((table(found),))


def chosen_cases(count: int) -> list[Case]:
    """Return cases of every kind in turn, evenly from a study."""
    every = study(KNOWN, FOREIGN, 2, FIRST)
    rows = [[c for c in every if c.kind == kind] for kind in _KINDS]
    each = -(-count // len(rows))
    spread = [[own[len(own) * k // each] for k in range(each)] for own in rows]
    return [own[k] for k in range(each) for own in spread][:count]


def said_of(case: Case, draw: int) -> Said:
    """Return verdict, names, and the whole set, of the case with its data changed; draw 0 is not.

    Readings are changed by white noise of `CHANGE` times the rms of their own.
    """
    with tempfile.TemporaryDirectory() as folder:
        truth, records = records_of(case, Path(folder))
    rng = np.random.default_rng([case.seed, draw])
    size = CHANGE * truth.sigma if draw else 0.0
    changed = [
        replace(r, displacement=r.displacement + size * rng.standard_normal(r.n))
        for r in records
        if r.displacement is not None
    ]
    return _said(diagnose(changed))


def _said(d: Diagnosis) -> Said:
    named, within = names_of(d)
    return d.verdict, frozenset(named), frozenset(within)


def table(found: Sequence[Repeated]) -> TitledTable:
    """Return how often verdict and names stayed, by kind of case."""
    rows = []
    for kind in (*dict.fromkeys(r.case.kind for r in found), "all"):
        own = [r for r in found if kind in (r.case.kind, "all")]
        draws = sum(len(r.changed) for r in own)
        rows.append(
            (
                kind,
                f"{len(own)}",
                share(sum(r.same_verdict for r in own), draws),
                share(sum(r.same_set for r in own), draws),
                f"{sum(r.same_verdict == len(r.changed) for r in own)}",
            )
        )
    head = ("cases", "number", "same verdict and names", "same verdict, names in the set",
            "cases without a change")  # fmt: skip
    return TitledTable(
        "Data changed by 1 % of their noise",
        Table(head, tuple(rows)),
        "Each case is diagnosed as it is, and with white noise of 1 % of its own added.",
    )
