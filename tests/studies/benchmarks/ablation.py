"""The benchmark `ablation`: the method without each of its steps, with each constant moved."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial

import numpy as np

from psa_casadi.diagnosis.task import STEPS, Method, Thresholds
from tests.studies.benchmarks.hidden_cases import Case, CaseResult, diagnosed, study
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, share
from tests.studies.plants.table import FOREIGN, KNOWN

#: The first of the seeds, which no other benchmark uses; of those of two and three causes.
FIRST, SEVERAL = 770901, 205511
#: Seeds for each effect of the study that these are a part of.
_SEEDS, _QUICK_SEEDS = 5, 1
#: Number of cases that show what a constant does, where that is to be quick.
_FASTEST = 15
#: Step between the cases of a kind that are repeated, of a study with one seed for each effect.
_EVERY = {"known": 2, "weak": 4, "clean": 2, "ringing": 1, "foreign": 2, "left out": 3, "two": 1}
#: Diagnoses cases by a method.
Diagnosed = Callable[[Sequence[Case], Method], Sequence[CaseResult]]


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose the same cases without each step, then with each constant halved and doubled.

    `quick` takes half of the cases for the steps, and of these the fastest for the constants.
    """

    def ask(cases: Sequence[Case], method: Method) -> Sequence[CaseResult]:
        return diagnosed(cases, progress, method)

    whole, steps = ask(chosen_cases(2 if quick else 1), Method()), without_steps()
    moved = sorted((f for f in whole if f.reached), key=lambda f: f.seconds)[:_FASTEST]
    every = study(KNOWN, FOREIGN, _QUICK_SEEDS if quick else _SEEDS, SEVERAL)
    several = [c for c in every if c.kind in ("two", "three")]
    methods = {"the method": Method(), **{n: m for n, m in steps.items() if "several" in n}}
    constants = partial(ablation_table, "With a constant moved", moved_constants())
    return Outcome([
        ablation_table("Without a step", steps, whole, ask),
        constants(moved if quick else whole, ask),
        several_table({n: ask(several, m) for n, m in methods.items()}),
    ])  # fmt: skip


def chosen_cases(step: int) -> list[Case]:
    """Return the cases that are repeated, every so manyth of those of the whole benchmark."""
    counter: Counter[str] = Counter()
    kept = []
    for case in study(KNOWN, FOREIGN, 1, FIRST):
        every = _EVERY.get(case.kind)
        if every is not None and counter[case.kind] % (every * step) == 0:
            kept.append(case)
        counter[case.kind] += 1
    return kept


def without_steps() -> dict[str, Method]:
    """Return the method without each of its steps."""
    return {f"without {step}": Method(frozenset({step})) for step in STEPS}


def moved_constants() -> dict[str, Method]:
    """Return the method with each constant halved and doubled."""
    moved = {}
    for f in fields(Thresholds):
        value = getattr(Thresholds(), f.name)
        for factor in (0.5, 2.0):
            other = max(1, round(factor * value)) if isinstance(value, int) else factor * value
            if other == value or (f.name == "credible" and factor > 1.0):
                continue
            constants = replace(Thresholds(), **{f.name: other})
            moved[f"{f.name} = {other:g}"] = Method(thresholds=constants)
    return moved


def several_table(results: Mapping[str, Sequence[CaseResult]]) -> TitledTable:
    """Return how often each method names several causes."""
    rows = []
    for name, of in results.items():
        reached = [f for f in of if f.reached]
        rows.append({
            "method": name,
            "all in the sets": share(f.in_set for f in reached),
            "all named, no other": share(set(f.named) == set(f.case.hidden) for f in reached),
            "s each": f"{np.mean([f.seconds for f in reached]):.0f}",
        })  # fmt: skip
    return TitledTable("Two and three causes", rows)


def ablation_table(
    title: str, methods: Mapping[str, Method], whole: Sequence[CaseResult], ask: Diagnosed
) -> TitledTable:
    """Return the answers of each method to the cases, and how many differ from the whole method."""
    rows = [_row("the method", whole, whole)]
    for name, method in methods.items():
        rows.append(_row(name, ask([f.case for f in whole], method), whole))
    return TitledTable(
        title,
        rows,
        f"{len(whole)} cases. Right: hidden effects of the table, weak ones and pairs too. Wrong"
        " alone: `cause_named` without the cause, foreign and left out ones too. The patch's share"
        " is the median over foreign and left out causes that are unexplained.",
    )


def _row(name: str, results: Sequence[CaseResult], whole: Sequence[CaseResult]) -> dict[str, str]:
    def of(*kinds: str) -> list[CaseResult]:
        return [f for f in results if f.case.kind in kinds]

    def count(holds: Callable[[CaseResult], bool], cases: Sequence[CaseResult]) -> str:
        return f"{sum(map(holds, cases))} of {len(cases)}"

    known = [f for f in of("known", "weak", "two") if f.reached]
    absent = [f.patched for f in of("foreign", "left out") if f.verdict == "unexplained"]
    changed = sum(
        a.verdict != b.verdict or set(a.within) != set(b.within)
        for a, b in zip(whole, results, strict=True)
    )
    return {
        "method": name,
        "right in the set": count(lambda f: f.in_set, known),
        "right alone": count(lambda f: f.right_alone, known),
        "wrong alone": count(lambda f: f.wrong_alone, results),
        "clean named": count(lambda f: bool(f.named), of("clean", "ringing")),
        "port of the patch removes": f"{100.0 * np.median(absent or [0.0]):.0f} % of {len(absent)}",
        "s each": f"{np.mean([f.seconds for f in results]):.1f}",
        "verdicts changed": "" if name == "the method" else f"{changed} of {len(whole)}",
    }
