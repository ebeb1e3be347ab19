"""The paper's three verifications, with our stacks: loops, steps, a non-periodic voltage.

The paper (section 4.3, figures 6 to 10) identifies three stacks and compares loops, normalised
steps and one non-periodic response. Here the model is identified from a step and two loops, and
judged only on records that the fit has not seen.
"""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from psa_casadi.model.stacks import STACKS
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable
from tests.studies.benchmarks.verification_cases import (
    INSTRUMENT,
    LOOPS,
    NAMES,
    NOISE,
    OTHER,
    STEPS,
    Comparison,
    instrument,
    matches,
    synthetic,
    tables,
)

FloatArray = npt.NDArray[np.float64]

_MEASURED_verification_figure, _PREDICTED, _ERRORS = "#9a9a9a", "#0072b2", ("#d55e00", "#009e73")
_FONT = 11.0
_TITLES = {
    LOOPS: "loops (paper, figures 6 and 8)",
    STEPS: "normalised step (figures 7 and 9)",
    OTHER: "non-periodic voltage (figure 10)",
}


def picture(shown: Sequence[Comparison]) -> Figure:
    """Return a column for every stack; in each, three pairs of curves above their error."""
    stacks = list(dict.fromkeys(c.stack for c in shown))
    figure = Figure(figsize=(4.6 * len(stacks) + 0.6, 15.0), layout="constrained")
    parts = figure.add_gridspec(6, len(stacks), height_ratios=(2.1, 1.0) * 3)
    panels: dict[str, Callable[[Axes, Axes, list[Comparison]], None]] = {
        LOOPS: _loops,
        STEPS: _steps,
        OTHER: _other,
    }
    for column, stack in enumerate(stacks):
        for row, (kind, draw) in enumerate(panels.items()):
            of_kind = [c for c in shown if (c.stack, c.kind) == (stack, kind)]
            if not of_kind:
                continue
            upper = figure.add_subplot(parts[2 * row, column])
            lower = figure.add_subplot(parts[2 * row + 1, column])
            draw(upper, lower, of_kind)
            _style(upper, lower, f"{stack}: {_TITLES[kind]}")
    return figure


def _loops(upper: Axes, lower: Axes, of_kind: list[Comparison]) -> None:
    for k, c in enumerate(of_kind):
        origin = _origin(c) if k == 0 else None
        _pair(upper, c.voltage, 1e6 * c.measured, 1e6 * c.predicted, origin)
        lower.plot(c.voltage, 1e6 * c.error, color=_ERRORS[k % 2], linewidth=0.7, label=c.record)
    upper.set_ylabel("displacement [um]", fontsize=_FONT)
    lower.set_ylabel("error [um]", fontsize=_FONT)
    lower.set_xlabel("voltage [V]", fontsize=_FONT)
    if len(of_kind) > 1:
        _legend(lower, of_kind)


def _steps(upper: Axes, lower: Axes, of_kind: list[Comparison]) -> None:
    for c in of_kind:
        time = 1e3 * c.time
        _pair(upper, time, c.measured / c.range_m, c.predicted / c.range_m, _origin(c))
        lower.plot(time, c.error / c.range_m, color=_ERRORS[0], linewidth=0.7)
    upper.set_ylabel("displacement over its final value", fontsize=_FONT)
    lower.set_ylabel("error", fontsize=_FONT)
    lower.set_xlabel("time [ms]", fontsize=_FONT)


def _other(upper: Axes, lower: Axes, of_kind: list[Comparison]) -> None:
    for c in of_kind:
        _pair(upper, c.time, 1e6 * c.measured, 1e6 * c.predicted, _origin(c))
        lower.plot(c.time, 1e6 * c.error, color=_ERRORS[0], linewidth=0.7)
    upper.set_ylabel("displacement [um]", fontsize=_FONT)
    lower.set_ylabel("error [um]", fontsize=_FONT)
    lower.set_xlabel("time [s]", fontsize=_FONT)


def _origin(c: Comparison) -> str:
    """Say where the displacement is from."""
    return "measured" if c.stack == INSTRUMENT else "synthetic, with noise"


def _pair(
    axes: Axes, x: FloatArray, measured: FloatArray, predicted: FloatArray, origin: str | None
) -> None:
    """Draw both where something was measured, the prediction thin on top; named by `origin`."""
    there = np.where(np.isfinite(measured), predicted, np.nan)
    axes.plot(x, measured, color=_MEASURED_verification_figure, linewidth=3.2, label=origin)
    axes.plot(x, there, color=_PREDICTED, linewidth=1.0, label="model" if origin else None)


def _style(upper: Axes, lower: Axes, title: str) -> None:
    upper.set_title(title, fontsize=_FONT, loc="left")
    upper.legend(fontsize=_FONT - 2, loc="lower right", framealpha=0.85)
    upper.tick_params(labelbottom=False)
    for axes in (upper, lower):
        axes.grid(visible=True, color="#dddddd", linewidth=0.7)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=_FONT - 2)
    lower.axhline(0.0, color="black", linewidth=0.7)
    upper.sharex(lower)


def _legend(lower: Axes, of_kind: list[Comparison]) -> None:
    largest = 1e6 * max(c.largest for c in of_kind)
    lower.set_ylim(-1.15 * largest, 1.9 * largest)
    lower.legend(fontsize=_FONT - 3, loc="upper center", ncols=2, framealpha=0.85)


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
