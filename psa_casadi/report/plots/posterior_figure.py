"""The picture of a posterior: what prior and posterior predict of a record, and the parameters."""

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.posterior.chains import columns_of_records
from psa_casadi.posterior.sample import HDI, Figures, Posterior
from psa_casadi.report.plots.figure import DPI, FONT, SIZE_INCHES, style
from psa_casadi.report.words.phrases import length_scale, number, shown_in
from psa_casadi.report.words.series import (
    BASE_COLOUR,
    EXTENDED_COLOUR,
    MEASURED_COLOUR,
    NOISE_COLOUR,
)
from psa_casadi.units import convert

FloatArray = npt.NDArray[np.float64]

#: Parameters that are drawn, and in how many columns.
_MOST, _COLUMNS = 12, 4
_BINS = 40


def posterior_figure(found: Posterior) -> Figure:
    """Return the picture of a posterior, of the record that the model misses most."""
    shown = int(np.argmax(found.task.levels))
    figures = found.figures[:_MOST]
    rows = -(-len(figures) // _COLUMNS)
    figure = Figure(figsize=(SIZE_INCHES[0], 4.6 + 2.6 * rows), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    parts = figure.subfigures(2, 1, height_ratios=(4.6, 2.6 * rows), squeeze=False)
    above, below = parts[0, 0], parts[1, 0]
    before, after = above.subplots(1, 2)
    _prior(before, found, shown)
    _posterior(after, found, shown)
    axes = np.atleast_1d(below.subplots(rows, min(_COLUMNS, len(figures)))).ravel()
    for each, f in zip(axes, figures, strict=False):
        draw_parameter(each, found, f)
    for each in axes[len(figures) :]:
        each.set_axis_off()
    name = found.task.experiments[shown].record.name
    more = len(found.figures) - len(figures)
    rest = f"; {more} more parameters are in the table" if more else ""
    figure.suptitle(
        f"Prior and posterior of {found.model.name}, record {name}{rest}", fontsize=FONT
    )
    return figure


def _band(found: Posterior, group: str, record: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the ends of the band that holds 94 % of what is predicted, and the median [m]."""
    column = columns_of_records(found.task)[record]
    draws = (
        found.tree[group][column].to_numpy().reshape(-1, found.task.experiments[record].record.n)
    )
    low, high = 0.5 * (1.0 - HDI), 0.5 * (1.0 + HDI)
    ends: FloatArray = np.quantile(draws, [low, high, 0.5], axis=0)
    return ends[0], ends[1], ends[2]


def _prior(axes: Axes, found: Posterior, record: int) -> None:
    r = found.task.experiments[record].record
    y = measured(r)
    if not found.tree["prior_predictive"].sizes["draw"]:
        style(axes, "No draw of the prior can be simulated", "time [s]", "")
        return
    low, high, _ = _band(found, "prior_predictive", record)
    span = float(np.nanmax(y) - np.nanmin(y))
    scale = length_scale(3.0 * span)
    band = f"prior, {100.0 * HDI:.0f} %"
    axes.fill_between(
        r.time, scale.factor * low, scale.factor * high, color=BASE_COLOUR, alpha=0.3, label=band
    )
    axes.plot(r.time, scale.factor * y, color=MEASURED_COLOUR, linewidth=1.0, label="measured")
    middle = 0.5 * float(np.nanmax(y) + np.nanmin(y))
    axes.set_ylim(scale.factor * (middle - 1.5 * span), scale.factor * (middle + 1.5 * span))
    style(axes, "Prior predictive", "time [s]", f"displacement [{scale.unit}]")
    axes.legend(fontsize=FONT - 1, loc="upper right")


def _posterior(axes: Axes, found: Posterior, record: int) -> None:
    r = found.task.experiments[record].record
    low, high, middle = _band(found, "posterior_predictive", record)
    left = measured(r) - middle
    scale = length_scale(float(np.nanmax(np.abs(left))))
    band = f"posterior, {100.0 * HDI:.0f} %"
    axes.plot(r.time, scale.factor * left, color=MEASURED_COLOUR, linewidth=0.8, label="measured")
    axes.fill_between(
        r.time, scale.factor * (low - middle), scale.factor * (high - middle),
        color=EXTENDED_COLOUR, alpha=0.4, label=band, zorder=3,
    )  # fmt: skip
    title = "Posterior predictive, less its median"
    style(axes, title, "time [s]", f"difference [{scale.unit}]")
    axes.legend(fontsize=FONT - 1, loc="upper right")


def draw_parameter(axes: Axes, found: Posterior, f: Figures) -> None:
    """Draw the posterior of a parameter, and its prior."""
    unit, display = shown_in(found.model, f.name)
    values, before = (
        np.array([convert(v, unit, display) for v in found.tree[g][f.name].to_numpy().ravel()])
        for g in ("posterior", "prior")
    )
    axes.hist(values, bins=_BINS, density=True, color=EXTENDED_COLOUR, alpha=0.7)
    low, high = axes.get_xlim()
    inside = before[(before >= low) & (before <= high)]
    if len(inside) >= 0.2 * max(len(before), 1):
        weights = np.full(len(inside), _BINS / (2.0 * (high - low) * len(before)))
        axes.hist(inside, bins=_BINS // 2, weights=weights, histtype="step", color=BASE_COLOUR)
    for end in (f.low, f.high):
        axes.axvline(convert(end, unit, display), color=NOISE_COLOUR, linestyle="--", linewidth=1.0)
    named = f.name if display in ("", "1") else f"{f.name} [{display}]"
    style(axes, f"{f.name} = {number(convert(f.mean, unit, display), 4)}", named, "")
    axes.set_yticks([])
