"""The picture of the benchmark `fmu`: reached error against CPU time, work, and the tolerance."""

from collections.abc import Sequence
from typing import Protocol

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

_FONT = 10.5
_STYLES = (("#0072b2", "o"), ("#d55e00", "s"), ("#009e73", "^"), ("#9a6fb0", "v"))


class Measured(Protocol):
    """What a run must tell to be drawn."""

    @property
    def case(self) -> str: ...
    @property
    def method(self) -> str: ...
    @property
    def tolerance(self) -> float: ...
    @property
    def error(self) -> float: ...
    @property
    def seconds(self) -> float: ...
    @property
    def evaluations(self) -> float: ...


def picture(runs: Sequence[Measured]) -> Figure:
    """Return a row for every case: error over CPU time, over right-hand sides, over tolerance."""
    cases = list(dict.fromkeys(r.case for r in runs))
    figure = Figure(figsize=(14.0, 4.6 * len(cases)), layout="constrained")
    grid = figure.subplots(len(cases), 3, squeeze=False)
    for row, case in zip(grid, cases, strict=True):
        of_case = [r for r in runs if r.case == case]
        _curves(row[0], of_case, "seconds", "CPU time [s]")
        _curves(row[1], of_case, "evaluations", "evaluations of the right-hand side")
        _curves(row[2], of_case, "tolerance", "tolerance asked for")
        ends = [min(r.tolerance for r in of_case), max(r.tolerance for r in of_case)]
        row[2].plot(ends, ends, color="0.6", linewidth=1.0, zorder=0, label="error = tolerance")
        row[0].set_title(case, loc="left", fontsize=_FONT)
        row[2].legend(fontsize=_FONT - 2)
    return figure


def _curves(axes: Axes, runs: Sequence[Measured], across: str, label: str) -> None:
    methods = list(dict.fromkeys(r.method for r in runs))
    for method, (colour, marker) in zip(methods, _STYLES, strict=False):
        mine = [r for r in runs if r.method == method]
        axes.loglog(
            [getattr(r, across) for r in mine], [r.error for r in mine], color=colour,
            marker=marker, markersize=5, linewidth=1.4, label=method,
        )  # fmt: skip
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(label, fontsize=_FONT)
    axes.set_ylabel("largest error / range", fontsize=_FONT)
    axes.grid(visible=True, which="major", color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=_FONT - 2)
