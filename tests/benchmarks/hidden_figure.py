"""The confusion matrix and the reliability diagram of `python -m tests.benchmarks diagnose`."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

from tests.benchmarks.hidden_cases import Found
from tests.plants.table import called

_NONE = ("unexplained", "adequate")
#: Classes of stated probability: above the one, up to the next.
BINS: tuple[float, ...] = (0.02, 0.2, 0.5, 0.8, 0.95, 1.0)
#: Kinds of cases of the reliability: the cause is in the table; also where its entry was left out.
RELIABILITY = (("known", "weak"), ("known", "weak", "left out"))
_DRAWN = (
    ("o", "C0", "the cause is in the table"),
    ("s", "C1", "with the cases whose own entry was left out"),
)


def picture(found: Sequence[Found], known: Sequence[str], foreign: Sequence[str]) -> Figure:
    """Return hidden against named, and how often a stated probability is right.

    Cases whose plant could not make the effect as visible as was asked for do not count.
    """
    figure = Figure(figsize=(11.0, 15.0), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(3.2, 1.0))
    _confusion(above, [f for f in found if f.reached], known, foreign)
    _reliability(below, found)
    return figure


def in_class(
    found: Sequence[Found], kinds: Sequence[str], low: float, high: float
) -> list[tuple[float, bool]]:
    """Return the probabilities in (low, high] that an effect is the cause, and whether it is.

    Every effect of every case of these kinds in which a cause is named counts, where what is hidden
    is as visible as was asked for.
    """
    return [
        (p, effect == f.case.right)
        for f in found
        if f.named and f.reached and f.case.kind in kinds
        for effect, p in f.probability.items()
        if low < p <= high
    ]


def _confusion(
    axes: Axes, found: Sequence[Found], known: Sequence[str], foreign: Sequence[str]
) -> None:
    """Draw the shares of each row; the first cause counts."""
    rows = (*known, *foreign, "nothing")
    columns = (*dict.fromkeys(called(name) for name in known), *_NONE)
    shares = np.zeros((len(rows), len(columns)))
    for f in found:
        if f.case.kind in ("known", "weak", "clean", "foreign"):
            said = f.named[0] if f.named else str(f.verdict)
            if said in columns:
                shares[rows.index(f.case.effect or "nothing"), columns.index(said)] += 1.0
    count = shares.sum(axis=1, keepdims=True)
    shares = 100.0 * shares / np.where(count > 0, count, 1.0)
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=100.0)
    for i, j in zip(*np.nonzero(shares), strict=True):
        axes.text(
            j, i, f"{shares[i, j]:.0f}", ha="center", va="center", fontsize=8,
            color="white" if shares[i, j] > 55.0 else "black",
        )  # fmt: skip
    names = [f"{r.replace('_', ' ')} ({int(n)})" for r, n in zip(rows, count[:, 0], strict=True)]
    axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=90)
    axes.set_yticks(range(len(rows)), names)
    axes.tick_params(labelsize=8)
    axes.axhline(len(known) - 0.5, color="0.5", linewidth=0.8)
    axes.axvline(len(columns) - len(_NONE) - 0.5, color="0.5", linewidth=0.8)
    axes.set_xlabel("named first")
    axes.set_ylabel("hidden in the record (cases)")
    axes.set_title("What was hidden and what was named, percent of each row's cases")


def _reliability(axes: Axes, found: Sequence[Found]) -> None:
    """Draw how often effects are the cause against their probability.

    The 95 % intervals take them for independent, which those of one case are not.
    """
    axes.plot([0.0, 100.0], [0.0, 100.0], color="0.7", linewidth=0.8, label="right as stated")
    for side, kinds, (marker, colour, label) in zip((-1, 1), RELIABILITY, _DRAWN, strict=True):
        for low, high in itertools.pairwise(BINS):
            own = in_class(found, kinds, low, high)
            if not own:
                continue
            right = sum(true for _, true in own)
            stated = 100.0 * float(np.mean([p for p, _ in own])) + 0.4 * side
            share = 100.0 * right / len(own)
            ends = binomtest(right, len(own)).proportion_ci(method="wilson")
            reach = [[share - 100.0 * ends.low], [100.0 * ends.high - share]]
            axes.errorbar(stated, share, reach, fmt=marker, color=colour, capsize=3.0)
            axes.annotate(
                f"{right} of {len(own)}", (stated, share), fontsize=8, color=colour,
                xytext=(8.0 * side, -4.0), textcoords="offset points",
                ha="left" if side > 0 else "right",
            )  # fmt: skip
        axes.plot([], [], marker=marker, color=colour, linestyle="", label=label)
    axes.set_xlim(-6.0, 112.0)
    axes.set_ylim(-8.0, 108.0)
    axes.set_xlabel("stated probability of an effect, mean of its class, %")
    axes.set_ylabel("it is the cause, % (95 % interval)")
    axes.set_title("How often a stated probability is right")
    axes.legend(loc="upper left", fontsize=8)
