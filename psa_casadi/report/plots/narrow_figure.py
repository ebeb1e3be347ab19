"""A picture of a diagnosis that a phone can show: what the models miss, over the noise."""

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.report.words.phrases import added, in_brackets, listing, plain, scale_of
from psa_casadi.report.words.series import (
    BASE_COLOUR,
    EXTENDED_COLOUR,
    HELD_OUT_COLOUR,
    NOISE_COLOUR,
    Series,
    most_telling,
    series_of,
    telling_window,
)
from psa_casadi.report.words.verdict_words import VERDICTS

#: 720 x 880 points: at half of that, the width of a phone, letters are still large enough.
_SIZE_INCHES, _DPI, _FONT = (3.6, 4.4), 200, 9.0
#: Beside the window where the error falls most, so much of its length is shown on both sides.
_AROUND = 3.0


def narrow_figure(diagnosis: Diagnosis, *, origin: str = "measured") -> Figure:
    """Return two panels: the residual over a stretch of time, and the held-out errors as bars."""
    figure = Figure(figsize=_SIZE_INCHES, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    above, below = figure.subplots(2, 1, height_ratios=(2.2, 1.0))
    shown = most_telling(series_of(diagnosis))
    _residual(above, shown, origin)
    _bars(below, diagnosis)
    causes = listing([plain(c.effect) for c in diagnosis.causes])
    verdict = VERDICTS[diagnosis.verdict].capitalize()
    figure.suptitle(f"{verdict}: {causes}" if causes else verdict, fontsize=_FONT + 2, wrap=True)
    return figure


def _residual(axes: Axes, s: Series, origin: str) -> None:
    """Draw what each model misses where the error falls most, over a band of the noise."""
    window, n = telling_window(s), len(s.time)
    more = int(_AROUND * (window.stop - window.start))
    part = slice(max(0, window.start - more), min(n, window.stop + more))
    scale, clock = s.residual_scale, s.time_scale
    time, noise = clock.factor * s.time[part], 2.0 * scale.factor * s.noise
    axes.axhspan(-noise, noise, color=HELD_OUT_COLOUR, label="noise, 2 sigma")
    for curve in s.curves:
        values = scale.factor * s.residual(curve)[part]
        axes.plot(time, values, color=curve.colour, linewidth=1.0, label=curve.label)
    axes.set_title(f"{origin.capitalize()} minus simulated", fontsize=_FONT + 1, loc="left")
    axes.set_xlabel(f"time [{clock.unit}]", fontsize=_FONT)
    axes.set_ylabel(in_brackets("error", scale.unit), fontsize=_FONT)
    axes.locator_params(axis="x", nbins=5)
    axes.margins(x=0.0)
    axes.tick_params(labelsize=_FONT)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.32 * (high - low))  # for the legend
    axes.legend(fontsize=_FONT - 0.5, loc="upper left", ncols=2, columnspacing=0.9,
                handlelength=1.2, framealpha=0.0)  # fmt: skip


def _bars(axes: Axes, d: Diagnosis) -> None:
    """Draw the held-out errors, with the noise as their floor."""
    rows = [("base model", BASE_COLOUR, d.base_errors.holdout_rms_m)]
    if added(d):
        rows.append(("extended", EXTENDED_COLOUR, d.extended_errors.holdout_rms_m))
    rows.append(("noise", NOISE_COLOUR, d.noise_floor_rms_m))
    largest = max(rms for *_, rms in rows)
    scale = scale_of(d.experiments, largest)
    for k, (_, colour, rms) in enumerate(rows):
        axes.barh(k, rms, color=colour, height=0.7)
        axes.annotate(f" {scale.text(rms)}", (rms, k), va="center", fontsize=_FONT)
    axes.axvline(d.noise_floor_rms_m, color="black", linestyle="--", linewidth=1.0)
    axes.set_yticks(range(len(rows)), [name for name, *_ in rows], fontsize=_FONT)
    axes.set_xlim(0.0, 1.3 * largest)
    axes.invert_yaxis()
    axes.set_xticks([])
    axes.set_title("Error on held-out samples, rms", fontsize=_FONT + 1, loc="left")
    axes.spines[["top", "right", "bottom"]].set_visible(False)
