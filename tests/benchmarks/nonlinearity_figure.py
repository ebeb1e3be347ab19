"""The picture of the nonlinearity: position against command, what is left of it, and its size."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from tests.benchmarks.nonlinearity_plant import Case

_FONT = 11.0
#: Colour and name of a case by (closed loop, compensated).
LOOKS = {
    (False, False): ("#9a9a9a", "open loop"),
    (False, True): ("#0072b2", "open loop, compensated"),
    (True, False): ("#e69f00", "closed loop"),
    (True, True): ("#d55e00", "closed loop, compensated"),
}


def picture(cases: Sequence[Case]) -> Figure:
    """Return three panels: loops in open loop, deviation from the line, largest deviation."""
    figure = Figure(figsize=(14.0, 6.2), layout="constrained")
    loops, deviations, sizes = figure.subplots(1, 3, width_ratios=(1.0, 1.15, 1.25))
    raster = [c for c in cases if c.wave == "triangle" and c.error == "exact"]
    _loops(loops, [c for c in raster if not c.closed])
    _deviations(deviations, raster)
    _sizes(sizes, cases)
    for axes in (loops, deviations, sizes):
        axes.grid(visible=True, color="#dddddd", linewidth=0.7)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=_FONT - 2)
    handles = [Patch(color=colour, label=name) for colour, name in LOOKS.values()]
    figure.legend(handles=handles, fontsize=_FONT, loc="outside lower center", ncols=len(handles))
    return figure


def _loops(axes: Axes, cases: Sequence[Case]) -> None:
    for c in cases:
        colour, _ = LOOKS[c.closed, c.compensated]
        axes.plot(1e6 * c.reference, 1e6 * c.position, color=colour, linewidth=1.6)
    axes.set_title("triangle at 10 Hz, open loop", fontsize=_FONT, loc="left")
    axes.set_xlabel("reference [um]", fontsize=_FONT)
    axes.set_ylabel("position of the stage [um]", fontsize=_FONT)


def _deviations(axes: Axes, cases: Sequence[Case]) -> None:
    for c in cases:
        colour, _ = LOOKS[c.closed, c.compensated]
        time = 1e3 * (c.time - c.time[0])
        share = 100.0 * c.deviation / (c.position.max() - c.position.min())
        axes.plot(time, share, color=colour, linewidth=1.2)
    axes.set_yscale("symlog", linthresh=1e-2)
    axes.set_title("distance from the linear loop", fontsize=_FONT, loc="left")
    axes.set_xlabel("time in the period [ms]", fontsize=_FONT)
    axes.set_ylabel("% of range (linear within 0.01 %)", fontsize=_FONT)


def _sizes(axes: Axes, cases: Sequence[Case]) -> None:
    groups = list(dict.fromkeys((c.wave, c.error) for c in cases))
    for k, (wave, error) in enumerate(groups):
        there = [c for c in cases if (c.wave, c.error) == (wave, error)]
        for c in there:
            colour, _ = LOOKS[c.closed, c.compensated]
            place = k + 0.19 * (list(LOOKS).index((c.closed, c.compensated)) - 1.5)
            height = 100.0 * c.nonlinearity
            axes.barh(place, height, 0.18, color=colour)
            axes.text(1.12 * height, place, f"{height:.2g}", va="center", fontsize=_FONT - 3)
    names = [f"{wave},\n{error}" for wave, error in groups]
    axes.set_yticks(range(len(groups)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    found = [100.0 * c.nonlinearity for c in cases]
    axes.set_xlim(0.5 * min(found), 4.0 * max(found))
    axes.set_title("nonlinearity [% of range]", fontsize=_FONT, loc="left")
