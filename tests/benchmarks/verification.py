"""The paper's three verifications, with our stacks: loops, steps, a non-periodic voltage.

The paper (section 4.3, figures 6 to 10) identifies three stacks and compares loops, normalised
steps and one non-periodic response. Here the model is identified from a step and two loops, and
judged only on records that the fit has not seen.
"""

from collections.abc import Sequence
from functools import partial

from psa_casadi.model.stacks import STACKS
from psa_casadi.report.words.tables import Table
from tests.benchmarks.outcome import Outcome, Progress, TitledTable
from tests.benchmarks.three_mechanics import NAMES, matches, tables
from tests.benchmarks.verification_cases import (
    INSTRUMENT,
    LOOPS,
    NOISE,
    OTHER,
    STEPS,
    Comparison,
    instrument,
    synthetic,
)
from tests.benchmarks.verification_figure import picture

STACK_NAMES = ("PTBS200", "WYDS0808020", "P-885.51")
#: Whose mechanics the three models are compared on: the stack that rings.
RINGING = "PTBS200"
_QUICK_STACKS, _QUICK_PLANTS, _QUICK_STARTS = ("P-885.51",), ("reciprocal",), 2

_SYNTHETIC = (
    f"The stacks are synthetic: the independent reference, from rest, with white noise of"
    f" {100 * NOISE:g} % of each record's range, which is in the errors. Identified from a step to"
    " 100 % and loops of 100 % at 1 Hz and 30 % at 10 Hz; none of the records listed was fitted."
)
_MEASURED = (
    " The micromanipulator is measured (Y. N. Aye): identified from three quarters of the 1 Hz sine"
    " in blocks, judged on the rest and on the minor loops, whose first tenth gives offset and"
    " memory."
)
_ABSENT = (
    f" The measured {INSTRUMENT} is left out: set PSA_CASADI_DATA to the directory of its records."
)


def run(progress: Progress, quick: bool) -> Outcome:
    """Identify, predict what was kept, and compare three mechanics; `quick` takes one stack."""
    shown = [
        c for name in (_QUICK_STACKS if quick else STACK_NAMES) for c in synthetic(name, progress)
    ]
    if not quick:
        shown += instrument(progress)
    values = {name: figure.value for name, figure in STACKS[RINGING].values.items()}
    found = (
        matches(values, progress, _QUICK_PLANTS, _QUICK_STARTS)
        if quick
        else matches(values, progress, tuple(NAMES))
    )
    return Outcome((*verification_tables(shown), *tables(found, RINGING)), partial(picture, shown))


def verification_tables(shown: Sequence[Comparison]) -> tuple[TitledTable, ...]:
    """Return one table each for the paper's loops, steps and non-periodic voltage."""
    names = [c.stack for c in shown]
    note = _SYNTHETIC
    if any(n not in STACKS or n == INSTRUMENT for n in names):
        note += _MEASURED
    elif set(names) == set(STACK_NAMES):
        note += _ABSENT
    head = ("stack", "record, not fitted", "largest error", "of range [%]", "rms [%]")
    paper = "paper, its measured stacks"
    ends = {
        LOOPS: (
            "Hysteresis loops (paper, figures 6 and 8)",
            (paper, "loops", "0.41 um", "2.65", ""),
        ),
        STEPS: (
            "Normalised steps (paper, figures 7 and 9)",
            (paper, "steps", "0.0142", "1.42", ""),
        ),
        OTHER: ("Non-periodic voltage (paper, figure 10)", (paper, "no figure given", "", "", "")),
    }
    return tuple(
        TitledTable(
            title,
            Table(head, (*(_row(c) for c in shown if c.kind == kind), last)),
            note if kind == LOOPS else "",
        )
        for kind, (title, last) in ends.items()
    )


def _row(c: Comparison) -> tuple[str, ...]:
    share = c.largest / c.range_m
    largest = f"{share:.4f}" if c.kind == STEPS else f"{1e6 * c.largest:.3f} um"
    return (c.stack, c.record, largest, f"{100 * share:.2f}", f"{100 * c.rms / c.range_m:.3f}")
