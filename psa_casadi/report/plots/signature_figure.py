"""The picture of one effect's signature: what it adds over time, and along what it is told."""

import os
import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from psa_casadi.component import Component
from psa_casadi.diagnosis.signature import Signature
from psa_casadi.files import atomic_path
from psa_casadi.report.words.misfit_words import AXES
from psa_casadi.report.words.phrases import Scale, length_scale, number, percent, plain, with_unit
from psa_casadi.report.words.series import EXTENDED_COLOUR, MEASURED_COLOUR, NOISE_COLOUR

_SIZE_INCHES, _DPI, _FONT = (13.0, 6.2), 100, 13.0


def save_signature(effect: Component, seen: Signature, path: str | os.PathLike[str]) -> None:
    """Write the picture of an effect's signature as a PNG of 1300 x 620, whole or not at all.

    Left the difference over time above the voltage's ghost, right against the coordinate that
    tells it best. Raises InputError when `path` cannot be written to.
    """
    figure = Figure(figsize=_SIZE_INCHES, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    scale = length_scale(float(np.max(np.abs(seen.difference))))
    _over_time(left, seen, scale)
    (_spectrum if seen.telling.name == "spectrum" else _told)(right, seen, scale)
    look = textwrap.fill(f"{plain(effect.name)}: {effect.looks_like}", 120)
    figure.suptitle(f"{look}\n{size_sentence(seen)}", fontsize=_FONT + 1)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=_DPI)


def size_sentence(seen: Signature) -> str:
    """Say on what stack the signature is simulated, and how large the effect is."""
    size = with_unit(number(seen.size), seen.unit)
    largest = float(np.max(np.abs(seen.difference))) / seen.stroke
    return (
        f"Simulated on the stack {seen.stack} with {seen.gain} = {size}: at most"
        f" {number(100.0 * largest, 2)} % of the stroke, offset and slope re-fitted."
    )


def clock(duration: float) -> Scale:
    """Return the unit to show times of a play in."""
    return Scale("s", 1.0) if duration >= 1.0 else Scale("ms", 1e3)


def telling_label(seen: Signature) -> str:
    """Return the label of the telling coordinate with its unit."""
    unit = "µm" if seen.telling.x_unit == "m" else seen.telling.x_unit
    return f"{AXES[seen.telling.name].label} [{unit}]"


def along(seen: Signature) -> float:
    """Return what the telling coordinate is multiplied by to be shown in its label's unit."""
    return 1e6 if seen.telling.x_unit == "m" else 1.0


def logarithmic_axis(seen: Signature) -> bool:
    """Say whether the telling coordinate is shown on a logarithmic axis."""
    return seen.telling.name.startswith(("since_reversal", "holds", "spectrum"))


def _style(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(textwrap.fill(title, 48), fontsize=_FONT, loc="left")
    axes.set_xlabel(x, fontsize=_FONT)
    axes.set_ylabel(y, fontsize=_FONT)
    axes.tick_params(labelsize=_FONT - 1)
    axes.grid(visible=True, color="#dddddd", linewidth=0.8)
    axes.set_axisbelow(True)


def _over_time(axes: Axes, seen: Signature, scale: Scale) -> None:
    unit = clock(float(seen.time[-1]))
    time = unit.factor * seen.time
    behind = axes.twinx()
    behind.fill_between(time, seen.voltage, color=NOISE_COLOUR, alpha=0.18, linewidth=0)
    behind.set_ylabel("voltage [V] (grey)", fontsize=_FONT, color=NOISE_COLOUR)
    behind.tick_params(labelsize=_FONT - 1, colors=NOISE_COLOUR)
    axes.set_zorder(behind.get_zorder() + 1)
    axes.patch.set_visible(False)
    axes.plot(time, scale.factor * seen.difference, color=EXTENDED_COLOUR, linewidth=1.3)
    axes.margins(x=0.01)
    title = "What the effect adds, over time"
    _style(axes, title, f"time [{unit.unit}]", f"difference [{scale.unit}]")


def _told(axes: Axes, seen: Signature, scale: Scale) -> None:
    x = along(seen) * seen.coordinate
    axes.plot(
        x, scale.factor * seen.counted, ".", color=NOISE_COLOUR, markersize=2.0, label="samples"
    )
    view = seen.telling
    axes.plot(
        along(seen) * view.x, scale.factor * view.mean, "o-", color=EXTENDED_COLOUR, linewidth=2.0,
        markersize=5.0, label="binned means",
    )  # fmt: skip
    axes.axhline(0.0, color=MEASURED_COLOUR, linewidth=0.8)
    if logarithmic_axis(seen):
        axes.set_xscale("log")
    else:
        axes.xaxis.set_major_locator(MaxNLocator(6))
    axes.legend(fontsize=_FONT - 1, framealpha=0.85)
    title = f"{AXES[view.name].title}: explains {percent(view.share)} of it"
    _style(axes, title, telling_label(seen), f"difference [{scale.unit}]")


def _spectrum(axes: Axes, seen: Signature, scale: Scale) -> None:
    view = seen.telling
    axes.loglog(view.x, scale.factor * view.mean, color=EXTENDED_COLOUR, linewidth=1.3)
    top = scale.factor * float(np.max(view.mean))
    axes.set_ylim(1e-5 * top, 3.0 * top)
    title = f"Spectrum: {percent(view.share)} of it in one peak"
    _style(axes, title, telling_label(seen), f"difference [{scale.unit}/√Hz]")
