"""The benchmark `ablation`: the method without each of its steps, with each constant moved."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace

import numpy as np

from psa_casadi.diagnosis.task import STEPS, Method, Thresholds
from tests.studies.benchmarks.diagnose import diagnose_all
from tests.studies.benchmarks.hidden_cases import Case, Found, study
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, share, table_of
from tests.studies.plants.table import FOREIGN, KNOWN

#: The first of the seeds, which no other benchmark uses; of those of two and three causes.
FIRST, SEVERAL = 770901, 205511
#: Seeds for each effect of the study that these are a part of.
_SEEDS, _QUICK_SEEDS = 5, 1
#: So many cases show what a constant does, where that is to be quick.
_FASTEST = 15
#: Of a study with one seed for each effect every so manyth case of a kind is repeated.
_EVERY = {"known": 2, "weak": 4, "clean": 2, "ringing": 1, "foreign": 2, "left out": 3, "two": 1}


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose the same cases without each step, then with each constant halved and doubled.

    `quick` takes half of the cases for the steps, and of these the fastest for the constants.
    """

    def diagnosed(cases: Sequence[Case], method: Method) -> Sequence[Found]:
        return diagnose_all(cases, progress, method)

    whole = diagnosed(chosen_cases(2 if quick else 1), Method())
    moved = sorted((f for f in whole if f.reached), key=lambda f: f.seconds)[:_FASTEST]
    several = [
        c
        for c in study(KNOWN, FOREIGN, _QUICK_SEEDS if quick else _SEEDS, SEVERAL)
        if c.kind in ("two", "three")
    ]
    steps = without_steps()
    of_several = {"the method": Method(), **{n: m for n, m in steps.items() if "several" in n}}
    found = {n: diagnosed(several, m) for n, m in of_several.items()}
    return Outcome([
        ablation_table("Without a step", steps, whole, diagnosed),
        ablation_table(
            "With a constant moved", moved_constants(), moved if quick else whole, diagnosed
        ),
        several_table(found),
    ])  # fmt: skip


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


def without_steps() -> dict[str, Method]:
    """Return the method without each of its steps."""
    return {f"without {step}": Method(frozenset({step})) for step in STEPS}


def several_table(found: Mapping[str, Sequence[Found]]) -> TitledTable:
    """Return what the method and the search one by one say of several causes at once."""
    reached = {name: [f for f in own if f.reached] for name, own in found.items()}

    def counted(holds: Callable[[Found], bool]) -> Callable[[str], str]:
        return lambda n: share(sum(map(holds, reached[n])), len(reached[n]))

    def ratios(name: str) -> str:
        every = [f.ratio for f in reached[name]]
        return f"{np.mean(every):.3f}, {max(every):.2f}"

    return table_of(
        "Two and three causes",
        reached,
        {
            "method": str,
            "all in the sets": counted(lambda f: set(f.case.hidden) <= set(f.within)),
            "all named, no other": counted(lambda f: set(f.named) == set(f.case.hidden)),
            "held-out rms over the noise's: mean, largest": ratios,
            "s each": lambda n: f"{np.mean([f.seconds for f in reached[n]]):.0f}",
        },
    )


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
    title: str,
    methods: dict[str, Method],
    whole: Sequence[Found],
    diagnosed: Callable[[Sequence[Case], Method], Sequence[Found]],
) -> TitledTable:
    """Return what each method says of the cases beside the whole method."""
    found: dict[str, Sequence[Found]] = {"the method": whole}
    found |= {n: diagnosed([f.case for f in whole], m) for n, m in methods.items()}

    def of_kinds(name: str, *kinds: str) -> list[Found]:
        return [f for f in found[name] if f.case.kind in kinds]

    def hidden(holds: Callable[[Found], bool]) -> Callable[[str], str]:
        def count(name: str) -> str:
            own = [f for f in of_kinds(name, "known", "weak", "two") if f.reached]
            return f"{sum(map(holds, own))} of {len(own)}"

        return count

    def wrong(name: str) -> str:
        alone = [f for f in found[name] if f.alone and f.alone not in f.case.hidden]
        return f"{len(alone)} of {len(whole)}"

    def clean(name: str) -> str:
        own = of_kinds(name, "clean", "ringing")
        return f"{sum(bool(f.named) for f in own)} of {len(own)}"

    def patched(name: str) -> str:
        own = [f for f in of_kinds(name, "foreign", "left out") if f.verdict == "unexplained"]
        return f"{100.0 * np.median([f.patched for f in own] or [0.0]):.0f} % of {len(own)}"

    def changed(name: str) -> str:
        pairs = zip(whole, found[name], strict=True)
        other = [a.verdict != b.verdict or set(a.within) != set(b.within) for a, b in pairs]
        return "" if name == "the method" else f"{sum(other)} of {len(whole)}"

    columns: dict[str, Callable[[str], str]] = {
        "method": str,
        "right in the set": hidden(lambda f: set(f.case.hidden) <= set(f.within)),
        "right alone": hidden(lambda f: f.right_alone),
        "wrong alone": wrong,
        "clean named": clean,
        "port of the patch removes": patched,
        "s each": lambda n: f"{np.mean([f.seconds for f in found[n]]):.1f}",
        "verdicts changed": changed,
    }
    return table_of(
        title,
        found,
        columns,
        f"{len(whole)} cases. Right: hidden effects of the table, weak ones and pairs too. Wrong"
        " alone: `cause_named` without the cause, foreign and left out ones too. The patch's share"
        " is the median over foreign and left out causes that are unexplained.",
    )
