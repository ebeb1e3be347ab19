"""The confusion matrix of `psa bench diagnose`."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from psa_casadi.bench.hidden_cases import Found

_NONE = ("unexplained", "adequate")


def picture(found: Sequence[Found], known: Sequence[str], foreign: Sequence[str]) -> Figure:
    """Return hidden against named: shares of each row, the first cause counting."""
    rows, columns = (*known, *foreign, "nothing"), (*known, *_NONE)
    shares = np.zeros((len(rows), len(columns)))
    for f in found:
        if f.case.kind in ("known", "weak", "clean", "foreign"):
            said = f.named[0] if f.named else str(f.verdict)
            if said in columns:
                shares[rows.index(f.case.effect or "nothing"), columns.index(said)] += 1.0
    total = shares.sum(axis=1, keepdims=True)
    shares = 100.0 * shares / np.where(total > 0, total, 1.0)
    figure = Figure(figsize=(11.0, 11.0), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=100.0)
    for i, j in zip(*np.nonzero(shares), strict=True):
        axes.text(
            j, i, f"{shares[i, j]:.0f}", ha="center", va="center", fontsize=8,
            color="white" if shares[i, j] > 55.0 else "black",
        )  # fmt: skip
    axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=90)
    axes.set_yticks(range(len(rows)), [r.replace("_", " ") for r in rows])
    axes.tick_params(labelsize=8)
    axes.axhline(len(known) - 0.5, color="0.5", linewidth=0.8)
    axes.axvline(len(known) - 0.5, color="0.5", linewidth=0.8)
    axes.set_xlabel("named first")
    axes.set_ylabel("hidden in the record")
    axes.set_title("What was hidden and what was named, percent of each row's cases")
    return figure
