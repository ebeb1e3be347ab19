"""Negative controls of the benchmark `diagnose`: without a part of the method figures get worse."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from psa_casadi.diagnosis.task import Method
from psa_casadi.report.words.tables import Table
from tests.benchmarks.hidden_cases import Case, Found
from tests.benchmarks.outcome import TitledTable

#: Methods that lack a part each.
CONTROLS: Mapping[str, Method] = {
    "noise's colour from the residual alone": Method(whiten_from="residual"),
    "no fits of imitators": Method(imitators=False),
    "derivatives at the null only": Method(finite_steps=False),
    "BIC weights": Method(weights="bic"),
}
#: Kinds of cases that the controls repeat.
_KINDS = ("known", "foreign")


def control_table(
    found: Sequence[Found],
    diagnose_all: Callable[[Sequence[Case], Method], Sequence[Found]],
) -> TitledTable:
    """Repeat a case of every effect, without one part of the method after another.

    `found` are the study's results that count; `diagnose_all` runs cases with a method.
    """
    kept = list({(f.case.kind, f.case.effect): f for f in found if f.case.kind in _KINDS}.values())
    rows = [("the method", *_figures(kept)), ("shuffled labels", *_figures(_shuffled(kept)))]
    for name, method in CONTROLS.items():
        rows.append((name, *_figures(diagnose_all([f.case for f in kept], method))))
    head = ("method", "right alone", "right in the set", "wrong, as if settled", "stated, right")
    return TitledTable(
        "Negative controls",
        Table(head, tuple(rows)),
        f"{len(kept)} cases, one of every effect of the study. Wrong, as if settled: `cause_named`"
        " without the cause, foreign ones too. Stated, right: the mean confidence of the named"
        " cases with a known cause, and how often the name is right.",
    )


def _figures(found: Sequence[Found]) -> tuple[str, ...]:
    known = [f for f in found if f.case.kind == "known"]
    stated = [f for f in known if f.named]
    mean = np.mean([f.confidence for f in stated] or [np.nan])
    right = np.mean([float(f.named[0] == f.case.effect) for f in stated] or [np.nan])
    return (
        _of(sum(f.right_alone for f in known), known),
        _of(sum(f.case.effect in f.within for f in known), known),
        _of(sum(f.verdict == "cause_named" and f.case.effect not in f.named for f in found), found),
        f"{100 * mean:.0f} %, {100 * right:.0f} %",
    )


def _of(count: int, cases: Sequence[Found]) -> str:
    return f"{count} of {len(cases)}"


def _shuffled(found: Sequence[Found]) -> list[Found]:
    """Give every known case the label of the next one, in an order drawn once."""
    known = [f for f in found if f.case.kind == "known"]
    order = np.random.default_rng(len(known)).permutation(len(known))
    return [
        replace(known[k], case=replace(known[k].case, effect=known[j].case.effect))
        for k, j in zip(order, np.roll(order, 1), strict=True)
    ]
