"""The benchmark `names`: can the names and families of a diagnosis be believed?

Sources: the study of the golden answers, the exam and both halves of the second exam.
"""

import itertools
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

import psa_casadi as psa
from tests.studies.benchmarks.table import Outcome, Progress, Row, TitledTable, on_all_cores
from tests.studies.exam.marks import SURE, Answer, Question, Score, mark, score
from tests.studies.golden.cases import ASKS, answered
from tests.studies.second_exam import cases as second

#: Classes of stated probability: above the one, up to the next. No probability exceeds 99 %.
BINS = (0.0, 0.5, 0.8, 0.9, 0.98, 1.0)
#: Number of records that a quick run takes, evenly from all.
QUICK = 12
GROUPS = {
    "one": "one cause", "two": "two causes", "three": "three causes", "foreign": "foreign cause",
    "clean": "clean, white", "odd": "clean, odd noise",
}  # fmt: skip
#: A stated probability, and whether its statement is true.
Stated = tuple[float, bool]


@dataclass(frozen=True)
class AnsweredCase:
    """A case with its answer: source/name, draw, and processor time [s]."""

    case: str
    draw: int
    question: Question
    answer: Answer
    seconds: float

    def __str__(self) -> str:
        """Return case and answer in a line."""
        grade = mark(self.question, self.answer)
        return f"{self.case}: {grade}; {self.answer.verdict}, {self.names} [{self.seconds:.0f} s]"

    @property
    def source(self) -> str:
        """Where its record comes from."""
        return self.case.split("/", maxsplit=1)[0]

    @property
    def group(self) -> str:
        """Its row of the table."""
        group = self.question.group
        return "odd" if group == "clean" and self.question.noise else group

    @property
    def score(self) -> Score:
        """Its contribution to the figures."""
        return score(self.question, self.answer, FAMILIES)

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
    result = on_all_cores(answer_case, jobs[:: -(-len(jobs) // QUICK)] if quick else jobs, progress)
    return Outcome(tables(result))


def answer_case(case: str, draw: int) -> AnsweredCase:
    """Write the record of a case and diagnose it; draw 0 has the seeds of the golden answers."""
    with tempfile.TemporaryDirectory() as folder:
        question, path = CASES[case](Path(folder), draw)
        _, answer, seconds = answered(path)
    return AnsweredCase(case, draw, question, answer, seconds)


def tables(cases: Sequence[AnsweredCase]) -> list[TitledTable]:
    """Return the figures of each group and source, the reliability, and every answer."""
    rows = []
    for group, title in GROUPS.items():
        of = [f for f in cases if f.group == group]
        sources = list(dict.fromkeys(f.source for f in of))
        rows += [_row(title, s, [f for f in of if f.source == s]) for s in sources]
        rows += [_row(title, "all", of)] if len(sources) > 1 else []
    rows.append(_row("all", "all", cases))
    each = [
        {"case": f.case, "draw": f.draw, "mark": mark(f.question, f.answer),
         "verdict": f.answer.verdict, "names": f.names}
        for f in cases
    ]  # fmt: skip
    return [
        TitledTable(
            "Names that can be believed", rows,
            "In set, alone, family: all that is hidden is named in sets, alone, or by the right"
            " family, which may be that of what is left without a name, and no name is wrong."
            " Wrong: of names, of families with 90 % or more. Honest: not `adequate`, and no name"
            " or the right family.",
        ),
        _reliability(cases),
        TitledTable("Each answer", each),
    ]  # fmt: skip


def _row(group: str, source: str, cases: Sequence[AnsweredCase]) -> Row:
    scores = [f.score for f in cases]
    kinds = {f.question.group for f in cases}
    hidden = kinds <= {"one", "two", "three"}
    sure = [[right for p, right in every if p >= SURE] for every in stated(cases).values()]

    def count(holds: Callable[[Score], bool], counts: bool) -> str:
        return f"{sum(map(holds, scores))}/{len(cases)}" if counts else "-"

    return {
        "hidden": group,
        "records": source,
        "in set": count(lambda s: s.in_set, hidden),
        "alone": count(lambda s: s.alone, hidden),
        "family": count(lambda s: s.family, kinds <= {"one", "two", "three", "foreign"}),
        "wrong": ", ".join(f"{len(every) - sum(every)}/{len(every)}" for every in sure),
        "honest": count(lambda s: s.honest, kinds == {"foreign"}),
        "alarms": count(lambda s: s.alarm, kinds == {"clean"}),
    }


def stated(cases: Sequence[AnsweredCase]) -> dict[str, list[Stated]]:
    """Return what is stated of names and of families."""
    return {
        "names": [one for f in cases for one in f.score.names],
        "families": [one for f in cases for one in f.score.families],
    }


def _reliability(cases: Sequence[AnsweredCase]) -> TitledTable:
    rows = []
    for low, high in itertools.pairwise(BINS):
        row = {"stated": f"{100 * low:.0f} to {100 * high:.0f} %"}
        for level, every in stated(cases).items():
            pairs = [(p, right) for p, right in every if low < p <= high]
            mean = f"{100 * np.mean([p for p, _ in pairs]):.0f} %" if pairs else "-"
            right = f"{sum(right for _, right in pairs)}/{len(pairs)}" if pairs else "-"
            row |= {f"{level}: mean": mean, f"{level}: right": right}
        rows.append(row)
    note = (
        "Every named cause that counts, by its name and its likeliest family, and the likeliest"
        " family of what has no name where there is none. Where several names are accepted, each"
        " is right."
    )
    return TitledTable("Probability against frequency", rows, note)
