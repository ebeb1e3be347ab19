"""The benchmark `names`: can the names and families of a diagnosis be believed?

Sources: the study of the golden answers, the exam and both halves of the second exam.
"""

import itertools
import re
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

import psa_casadi as psa
from tests.studies.benchmarks.table import Outcome, Progress, Row, TitledTable, on_all_cores
from tests.studies.exam.marks import SURE, Answer, Question, Score, mark, score
from tests.studies.golden.cases import ASKS, answered
from tests.studies.second_exam import cases as second

#: Classes of stated probability: above the one, up to the next. Nothing is said above 99 %.
BINS = (0.0, 0.5, 0.8, 0.9, 0.98, 1.0)
#: The log score takes no probability nearer to 0 or 1, which would count without end.
NEAREST = 1e-3
#: A quick run takes so many records, evenly from all.
QUICK = 12
GROUPS = {
    "one": "one cause", "two": "two causes", "three": "three causes", "foreign": "foreign cause",
    "clean": "clean, white", "odd": "clean, odd noise",
}  # fmt: skip
#: A probability that is stated, and whether what it is stated of is right.
Stated = tuple[float, bool]


@dataclass(frozen=True)
class Sat:
    """What was asked and answered: source/name, draw, and processor time [s]."""

    case: str
    draw: int
    asked: Question
    answer: Answer
    seconds: float

    def __str__(self) -> str:
        """Return case and answer in a line."""
        return (
            f"{self.case}: {self.mark}; {self.answer.verdict}, {self.names} [{self.seconds:.0f} s]"
        )

    @property
    def source(self) -> str:
        """Where its record comes from."""
        return self.case.split("/", maxsplit=1)[0]

    @property
    def group(self) -> str:
        """Its row of the table."""
        return "odd" if self.asked.group == "clean" and self.asked.noise else self.asked.group

    @property
    def mark(self) -> str:
        """The mark of its names."""
        return mark(self.asked, self.answer)

    @property
    def score(self) -> Score:
        """What it adds to the figures."""
        return score(self.asked, self.answer, FAMILIES)

    @property
    def names(self) -> str:
        """Its names with their probabilities and families."""
        each = (
            f"{c.effect} {c.probability:.2f}" + f" ({c.family} {c.of_family:.2f})" * bool(c.family)
            for c in self.answer.causes
        )
        a = self.answer
        left = [f"left: {a.left} {a.of_left:.2f}"] if a.left else []
        return ", ".join([*each, *left]) or "-"


#: The family of each effect: its place and its kind.
FAMILIES = {name: f"{e.belongs_to} {e.kind}" for name, e in psa.EFFECTS.items()}


def _second(name: str, folder: Path, draw: int) -> tuple[Question, Path]:
    path = folder / f"{name}.csv"
    second.write(name, 1 + draw, path)
    return second.question(name), path


#: What writes the record of a case, by source/name.
CASES = ASKS | {
    f"{half}/{name}": partial(_second, name)
    for half, letter in second.HALVES.items()
    for name in second.TABLE
    if name[0] == letter
}


def run(progress: Progress, quick: bool, only: str = "", seed: Sequence[int] = (0,)) -> Outcome:
    """Diagnose the cases whose source/name has a pattern, of each draw, on all cores."""
    jobs = [(case, draw) for draw in seed for case in CASES if re.search(only, case)]
    if not jobs:
        raise psa.InputError(f"--only: no case has '{only}'; a case is one like {min(CASES)}.")
    result = on_all_cores(sat, jobs[:: -(-len(jobs) // QUICK)] if quick else jobs, progress)
    return Outcome(tables(result))


def sat(case: str, draw: int) -> Sat:
    """Write the record of a case and diagnose it; draw 0 has the seeds of the golden answers."""
    with tempfile.TemporaryDirectory() as folder:
        requested, path = CASES[case](Path(folder), draw)
        _, answer, seconds = answered(path)
    return Sat(case, draw, requested, answer, seconds)


def tables(found: Sequence[Sat]) -> list[TitledTable]:
    """Return the figures of each group and source, the reliability, and every answer."""
    groups = [(g, [f for f in found if f.group == g]) for g in GROUPS]
    rows = []
    for group, item in groups:
        sources = dict.fromkeys(f.source for f in item)
        parts = [(s, [f for f in item if f.source == s]) for s in sources]
        rows += [_row(GROUPS[group], s, part) for s, part in parts]
        rows += [_row(GROUPS[group], "all", item)] if len(parts) > 1 else []
    rows.append(_row("all", "all", found))
    each = [
        {"case": f.case, "draw": f.draw, "mark": f.mark, "verdict": f.answer.verdict,
         "names": f.names, "s": f"{f.seconds:.1f}"}
        for f in found
    ]  # fmt: skip
    return [
        TitledTable(
            "Names that can be believed", rows,
            "In set, alone, family: all that is hidden is named in sets, alone, or by the right"
            " family, which may be that of what is left without a name, and no name is wrong."
            " Found: hidden causes that are named. Wrong: of names, of families with 90 % or more."
            " Honest: not `adequate`, and no name or the right family. s: processor time, median,"
            " 95th percentile, largest.",
        ),
        _reliability(found),
        TitledTable("What was said of each", each),
    ]  # fmt: skip


def _row(group: str, source: str, sats: Sequence[Sat]) -> Row:
    scores = [f.score for f in sats]
    kinds = {f.asked.group for f in sats}
    hidden, all_hidden = kinds <= {"one", "two", "three"}, [len(f.asked.accepted) for f in sats]
    sure = [[right for p, right in every if p >= SURE] for every in stated(sats).values()]
    times = np.quantile([f.seconds for f in sats], (0.5, 0.95, 1.0))

    def count(holds: Callable[[Score], bool], requested: bool) -> str:
        return f"{sum(map(holds, scores))}/{len(sats)}" if requested else "-"

    return {
        "hidden": group,
        "records": source,
        "in set": count(lambda s: s.in_set, hidden),
        "alone": count(lambda s: s.alone, hidden),
        "family": count(lambda s: s.family, kinds <= {"one", "two", "three", "foreign"}),
        "found": f"{sum(s.found for s in scores)}/{sum(all_hidden)}" if hidden else "-",
        "wrong": ", ".join(f"{len(every) - sum(every)}/{len(every)}" for every in sure),
        "honest": count(lambda s: s.honest, kinds == {"foreign"}),
        "alarms": count(lambda s: s.alarm, kinds == {"clean"}),
        "s": " ".join(f"{t:.2g}" for t in times),
    }


def stated(found: Iterable[Sat]) -> dict[str, list[Stated]]:
    """Return what is stated of names and of families."""
    scores = [f.score for f in found]
    return {
        "names": [one for s in scores for one in s.names],
        "families": [one for s in scores for one in s.families],
    }


def in_class(item: Iterable[Stated], low: float, high: float) -> list[Stated]:
    """Return what is stated with a probability in (low, high]."""
    return [(p, right) for p, right in item if low < p <= high]


def log_score(item: Sequence[Stated]) -> float:
    """Return the mean of -ln of the probability of what holds; 0 is best, ln 2 knows nothing.

    Source: I. J. Good, J. R. Stat. Soc. B 14 (1952) 107.
    """
    p = np.clip([p if right else 1 - p for p, right in item], NEAREST, 1 - NEAREST)
    return float(-np.mean(np.log(p))) if item else np.nan


def brier_score(item: Sequence[Stated]) -> float:
    """Return the mean square of probability less outcome; 0 is best, 1/4 knows nothing.

    Source: G. W. Brier, Mon. Weather Rev. 78 (1950) 1.
    """
    return float(np.mean([(p - right) ** 2 for p, right in item])) if item else np.nan


def _reliability(found: Sequence[Sat]) -> TitledTable:
    levels, rows = stated(found), []
    for low, high in itertools.pairwise(BINS):
        row = {"stated": f"{100 * low:.0f} to {100 * high:.0f} %"}
        for level, every in levels.items():
            row |= {f"{level}: {k}": v for k, v in _class(in_class(every, low, high)).items()}
        rows.append(row)
    scores = "; ".join(
        f"{level} log score {log_score(item):.3f}, Brier score {brier_score(item):.3f}"
        for level, item in levels.items()
    )
    note = (
        "Every named cause that counts, by its name and its likeliest family, and the likeliest"
        f" family of what has no name where there is none: {scores}. Bands are"
        " Wilson's. Where several names are accepted, each is right."
    )
    return TitledTable("Probability against frequency", rows, note)


def _class(item: Sequence[Stated]) -> dict[str, str]:
    """Return the mean probability, how many are right, and the band of that share."""
    if not item:
        return dict.fromkeys(("mean", "right", "95 % band"), "-")
    right = sum(right for _, right in item)
    band = binomtest(right, len(item)).proportion_ci(method="wilson")
    return {
        "mean": f"{100 * np.mean([p for p, _ in item]):.0f} %",
        "right": f"{right}/{len(item)}",
        "95 % band": f"{100 * band.low:.0f} to {100 * band.high:.0f} %",
    }
