"""The picture of the benchmark `fits`: error of one simulation against its time per sample."""

from collections.abc import Sequence
from typing import Protocol

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

_FONT = 10.5
_STYLES = (("#0072b2", "o"), ("#d55e00", "s"))


class Measured(Protocol):
    """What a run must tell to be drawn."""

    @property
    def way(self) -> str: ...
    @property
    def largest(self) -> float: ...
    @property
    def differentiated(self) -> float: ...
    @property
    def plain(self) -> float: ...


def picture(points: Sequence[Measured]) -> Figure:
    """Return time per sample over largest error, with sensitivities (solid) and without."""
    figure = Figure(figsize=(8.4, 5.2), layout="constrained")
    axes = figure.subplots()
    ways = list(dict.fromkeys(p.way for p in points))
    for way, (colour, marker) in zip(ways, _STYLES, strict=False):
        mine = [p for p in points if p.way == way]
        errors = [p.largest for p in mine]
        for times, style, face, what in (
            ([p.differentiated for p in mine], "-", colour, "12 sensitivities"),
            ([p.plain for p in mine], "--", "white", "no sensitivities"),
        ):
            axes.loglog(
                errors, times, style, color=colour, marker=marker, markersize=5.5,
                markerfacecolor=face, linewidth=1.5, label=f"{way}, {what}",
            )  # fmt: skip
    axes.set_xlabel("largest error of the displacement / its range", fontsize=_FONT)
    axes.set_ylabel("processor time per sample [µs]", fontsize=_FONT)
    axes.set_title(
        "One simulation of the demonstration's record, as in a fit", loc="left", fontsize=_FONT
    )
    low, high = axes.get_ylim()
    ticks = [m * 10.0**k for k in range(-3, 5) for m in (1, 2, 5)]
    axes.yaxis.set_major_locator(FixedLocator([y for y in ticks if low <= y <= high]))
    axes.yaxis.set_major_formatter(_plain())
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_minor_formatter(NullFormatter())
    axes.grid(visible=True, which="major", color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=_FONT - 1.5)
    figure.legend(fontsize=_FONT - 1, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _plain() -> ScalarFormatter:
    formatter = ScalarFormatter()
    formatter.set_scientific(False)
    return formatter
