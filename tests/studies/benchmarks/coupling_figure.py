"""Picture of the benchmark `coupling`: error over step for every master, and the stable steps."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from tests.studies.benchmarks.coupling_stability import Limit

_FONT = 10.5
_STYLES = (("#9a6fb0", "v", 9), ("#009e73", "^", 6), ("#d55e00", "s", 5), ("#0072b2", "o", 5))


class Measured(Protocol):
    """What a run must tell to be drawn."""

    @property
    def case(self) -> str: ...
    @property
    def master(self) -> str: ...
    @property
    def step(self) -> float: ...
    @property
    def error(self) -> float: ...


def picture(runs: Sequence[Measured], limits: Sequence[Limit]) -> Figure:
    """Return a panel for every system, and one for the stable steps."""
    cases = list(dict.fromkeys(r.case for r in runs))
    figure = Figure(figsize=(5.6 * (len(cases) + 1), 4.8), layout="constrained")
    panels = figure.subplots(1, len(cases) + 1, squeeze=False)[0]
    for axes, case in zip(panels, cases, strict=False):
        _errors(axes, [r for r in runs if r.case == case])
        axes.set_title(case, loc="left", fontsize=_FONT)
    _limits(panels[-1], limits)
    return figure


def _errors(axes: Axes, runs: Sequence[Measured]) -> None:
    for name, (colour, marker, size) in zip(
        dict.fromkeys(r.master for r in runs), _STYLES, strict=False
    ):
        mine = [r for r in runs if r.master == name]
        x, y = [1e6 * r.step for r in mine], [100.0 * r.error for r in mine]
        usable = [(a, b) for a, b in sorted(zip(x, y, strict=True)) if np.isfinite(b)]
        slope = ""
        if len(usable) > 1:
            (a, b), (c, d) = usable[:2]
            slope = f" (slope {np.log(d / b) / np.log(c / a):.2f})"
        axes.loglog(
            x, y, color=colour, marker=marker, markersize=size, linewidth=1.4,
            markerfacecolor="none" if size > 5 else colour, label=name + slope,
        )  # fmt: skip
    axes.set_xlabel("communication step [us]", fontsize=_FONT)
    axes.set_ylabel("largest error of the position [% of range]", fontsize=_FONT)
    _style(axes, sorted({1e6 * r.step for r in runs}))


def _limits(axes: Axes, limits: Sequence[Limit]) -> None:
    for slopes, colour, name in (
        (False, "#d55e00", "inputs held"),
        (True, "#0072b2", "input derivatives"),
    ):
        mine = [f for f in limits if f.slopes == slopes]
        x = [1e-6 * f.stiffness for f in mine]
        predicted = [1e6 * f.predicted for f in mine]
        axes.loglog(x, predicted, color=colour, linewidth=1.4, label=f"{name}: predicted")
        found = [1e6 * f.measured for f in mine]
        axes.loglog(
            x, found, color=colour, marker="o", linestyle="none", markersize=6,
            label=f"{name}: found",
        )  # fmt: skip
    axes.set_xlabel("contact stiffness [N/um]", fontsize=_FONT)
    axes.set_ylabel("longest stable step [us]", fontsize=_FONT)
    axes.set_title("where the co-simulation turns unstable", loc="left", fontsize=_FONT)
    _style(axes, sorted({1e-6 * f.stiffness for f in limits}))


def _style(axes: Axes, ticks: Sequence[float]) -> None:
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="major", color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=_FONT - 2)
    axes.legend(fontsize=_FONT - 2)
