"""The benchmark `ablation`: the method without each of its steps, with each constant moved."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import fields, replace

import numpy as np

from psa_casadi.diagnosis.task import STEPS, Method, Thresholds
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.diagnose import diagnose_all
from tests.studies.benchmarks.hidden_cases import Case, Found, study
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

Diagnosed = Callable[[Sequence[Case], Method], Sequence[Found]]


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose the same cases without each step, then with each constant halved and doubled.

    `quick` takes half of the cases for the steps, and of these the fastest for the constants.
    """

    def diagnosed(cases: Sequence[Case], method: Method) -> Sequence[Found]:
        return diagnose_all(cases, progress, method)

    cases = chosen_cases(2 if quick else 1)
    whole = diagnosed(cases, Method())
    tables = [ablation_table("Without a step", without_steps(), whole, diagnosed)]
    moved = fastest(whole) if quick else whole
    tables.append(ablation_table("With a constant moved", moved_constants(), moved, diagnosed))
    tables.append(several_table(cases_of_several(_QUICK_SEEDS if quick else _SEEDS), diagnosed))
    return Outcome(tuple(tables))


def chosen_cases(step: int) -> list[Case]:
    """Return the cases that are repeated, every so manyth of those of the whole benchmark."""
    seen: Counter[str] = Counter()
    kept = []
    for case in study(KNOWN, FOREIGN, 1, FIRST):
        every = _EVERY.get(case.kind)
        if every is not None and seen[case.kind] % (every * step) == 0:
            kept.append(case)
        seen[case.kind] += 1
    return kept


def fastest(found: Sequence[Found]) -> list[Found]:
    """Return the cases whose diagnosis takes the least time, of those that are visible."""
    return sorted((f for f in found if f.reached), key=lambda f: f.seconds)[:_FASTEST]


def cases_of_several(seeds: int) -> list[Case]:
    """Return the cases with two and three causes of a study."""
    return [c for c in study(KNOWN, FOREIGN, seeds, SEVERAL) if c.kind in ("two", "three")]


def several_table(cases: Sequence[Case], diagnosed: Diagnosed) -> TitledTable:
    """Return what the method and the search one by one say of several causes at once."""
    step = "several at once"
    rows = []
    methods = {"the method": Method(), f"without {step}": Method(frozenset({step}))}
    for name, method in methods.items():
        found = [f for f in diagnosed(cases, method) if f.reached]
        ratios = [f.ratio for f in found]
        rows.append((
            name,
            share(sum(_within(f) for f in found), len(found)),
            share(sum(set(f.named) == set(f.case.hidden) for f in found), len(found)),
            f"{np.mean(ratios):.3f}, {max(ratios):.2f}",
            f"{np.mean([f.seconds for f in found]):.0f}",
        ))  # fmt: skip
    head = ("method", "all in the sets", "all named, no other",
            "held-out rms over the noise's: mean, largest", "s each")  # fmt: skip
    return TitledTable("Two and three causes", Table(head, tuple(rows)))


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


def ablation_table(
    title: str, methods: dict[str, Method], whole: Sequence[Found], diagnosed: Diagnosed
) -> TitledTable:
    """Return what each method says of the cases beside the whole method."""
    rows = [("the method", *figures(whole), "")]
    for name, method in methods.items():
        found = diagnosed([f.case for f in whole], method)
        rows.append((name, *figures(found), changed(whole, found)))
    head = ("method", "right in the set", "right alone", "wrong alone", "clean named",
            "port of the patch removes", "s each", "verdicts changed")  # fmt: skip
    note = (
        f"{len(whole)} cases. Right: hidden effects of the table, weak ones and pairs too. Wrong"
        " alone: `cause_named` without the cause, foreign and left out ones too. The patch's share"
        " is the median over foreign and left out causes that are unexplained."
    )
    return TitledTable(title, Table(head, tuple(rows)), note)


def figures(found: Sequence[Found]) -> tuple[str, ...]:
    """Return the figures of one method."""
    hidden = [f for f in found if f.case.kind in ("known", "weak", "two") and f.reached]
    clean = [f for f in found if f.case.kind in ("clean", "ringing")]
    open_ones = [f for f in found if f.case.kind in ("foreign", "left out")]
    open_ones = [f for f in open_ones if f.verdict == "unexplained"]
    wrong = [f for f in found if f.alone and f.alone not in f.case.hidden]
    patched = float(np.median([f.patched for f in open_ones])) if open_ones else 0.0
    return (
        f"{sum(_within(f) for f in hidden)} of {len(hidden)}",
        f"{sum(f.right_alone for f in hidden)} of {len(hidden)}",
        f"{len(wrong)} of {len(found)}",
        f"{sum(bool(f.named) for f in clean)} of {len(clean)}",
        f"{100.0 * patched:.0f} % of {len(open_ones)}",
        f"{np.mean([f.seconds for f in found]):.1f}",
    )


def changed(whole: Sequence[Found], found: Sequence[Found]) -> str:
    """Return how many verdicts or sets of names differ from the whole method's."""
    by_case = {f.case: f for f in found}
    pairs = [(f, by_case[f.case]) for f in whole]
    count = sum(a.verdict != b.verdict or set(a.within) != set(b.within) for a, b in pairs)
    return f"{count} of {len(pairs)}"


def _within(f: Found) -> bool:
    return set(f.case.hidden) <= set(f.within)
