"""The benchmark `ablation`: the method without each of its steps, with each constant moved."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial

import numpy as np

from psa_casadi.diagnosis.task import STEPS, Method, Thresholds
from tests.studies.benchmarks.hidden_cases import Case, Found, diagnosed, study
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, share
from tests.studies.plants.table import FOREIGN, KNOWN

#: The first of the seeds, which no other benchmark uses; of those of two and three causes.
FIRST, SEVERAL = 770901, 205511
#: Seeds for each effect of the study that these are a part of.
_SEEDS, _QUICK_SEEDS = 5, 1
#: So many cases show what a constant does, where that is to be quick.
_FASTEST = 15
#: Of a study with one seed for each effect every so manyth case of a kind is repeated.
_EVERY = {"known": 2, "weak": 4, "clean": 2, "ringing": 1, "foreign": 2, "left out": 3, "two": 1}
#: Diagnoses cases by a method.
Diagnosed = Callable[[Sequence[Case], Method], Sequence[Found]]


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose the same cases without each step, then with each constant halved and doubled.

    `quick` takes half of the cases for the steps, and of these the fastest for the constants.
    """

    def ask(cases: Sequence[Case], method: Method) -> Sequence[Found]:
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


def several_table(found: Mapping[str, Sequence[Found]]) -> TitledTable:
    """Return what the method and the search one by one say of several causes at once."""
    rows = []
    for name, of in found.items():
        items = [f for f in of if f.reached]
        ratios = [f.ratio for f in items]
        rows.append({
            "method": name,
            "all in the sets": share(set(f.case.hidden) <= set(f.within) for f in items),
            "all named, no other": share(set(f.named) == set(f.case.hidden) for f in items),
            "held-out rms over the noise's: mean, largest": f"{np.mean(ratios):.3f},"
            f" {max(ratios):.2f}",
            "s each": f"{np.mean([f.seconds for f in items]):.0f}",
        })  # fmt: skip
    return TitledTable("Two and three causes", rows)


def ablation_table(
    title: str, methods: Mapping[str, Method], whole: Sequence[Found], ask: Diagnosed
) -> TitledTable:
    """Return what each method says of the cases beside the whole method."""
    rows = [_said("the method", whole, whole)]
    for name, method in methods.items():
        rows.append(_said(name, ask([f.case for f in whole], method), whole))
    return TitledTable(
        title,
        rows,
        f"{len(whole)} cases. Right: hidden effects of the table, weak ones and pairs too. Wrong"
        " alone: `cause_named` without the cause, foreign and left out ones too. The patch's share"
        " is the median over foreign and left out causes that are unexplained.",
    )


def _said(name: str, found: Sequence[Found], whole: Sequence[Found]) -> dict[str, str]:
    def of(*kinds: str) -> list[Found]:
        return [f for f in found if f.case.kind in kinds]

    def count(holds: Callable[[Found], bool], founds: Sequence[Found]) -> str:
        return f"{sum(map(holds, founds))} of {len(founds)}"

    items = [f for f in of("known", "weak", "two") if f.reached]
    absent = [f.patched for f in of("foreign", "left out") if f.verdict == "unexplained"]
    other = [
        a.verdict != b.verdict or set(a.within) != set(b.within)
        for a, b in zip(whole, found, strict=True)
    ]
    return {
        "method": name,
        "right in the set": count(lambda f: set(f.case.hidden) <= set(f.within), items),
        "right alone": count(lambda f: f.right_alone, items),
        "wrong alone": count(lambda f: f.alone not in (None, *f.case.hidden), found),
        "clean named": count(lambda f: bool(f.named), of("clean", "ringing")),
        "port of the patch removes": f"{100.0 * np.median(absent or [0.0]):.0f} % of {len(absent)}",
        "s each": f"{np.mean([f.seconds for f in found]):.1f}",
        "verdicts changed": "" if name == "the method" else f"{sum(other)} of {len(whole)}",
    }
