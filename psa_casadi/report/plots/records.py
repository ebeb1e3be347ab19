"""Plots of one record: over time, loop, window, and the residual in several views."""

import numpy as np

from psa_casadi.common.units import FloatArray, IndexArray
from psa_casadi.report.plots.panel import Panel, logarithmic, stacked
from psa_casadi.report.words import colours, series
from psa_casadi.report.words.phrases import in_brackets

Samples = slice | IndexArray

#: Points of a part of a record, and of a spectrum.
_ZOOM_POINTS, _SPECTRUM_POINTS = 1500, 800
_FULL = 500
#: Ratio of widths from which on a residual is too wide for the axis of the last one.
_FAR = 6.0


def samples(s: series.Series, limit: int) -> IndexArray:
    """Return the samples of a record that plots over all of it show.

    They are the same in all of them: so the page holds each curve once.
    """
    return series.kept([s.voltage, s.measured, *(s.residual(c) for c in s.curves)], limit)


def time_plot(s: series.Series, origin: str, limit: int) -> Panel:
    """What was measured over time above the residual over the same time, held-out part shaded."""
    indices = samples(s, limit)
    return stacked(measured_plot(s, origin, indices), residual_plot(s, indices), _FULL)


def measured_plot(s: series.Series, origin: str, indices: Samples) -> Panel:
    """What was measured over time, and the models."""
    clock = s.time_scale
    plot = Panel(f"time [{clock.unit}]", s.label)
    return _with_held_out(
        _measured(plot, clock.factor * s.time[indices], s, origin, indices, 1.4), s
    )


def residual_plot(s: series.Series, indices: Samples) -> Panel:
    """What the models leave over time, with the noise."""
    clock = s.time_scale
    plot = Panel(f"time [{clock.unit}]", in_brackets("residual", s.residual_scale.unit))
    return _with_held_out(_residuals(plot, clock.factor * s.time[indices], s, indices, 1.0), s)


def zoom_plot(s: series.Series, origin: str, limit: int) -> Panel:
    """What was measured over time in the window where the curves differ most."""
    window = series.telling_window(s)
    indices = np.arange(len(s.time))[window]
    indices = indices[series.kept([s.measured[window]], min(limit // 2, _ZOOM_POINTS))]
    time, y = s.time_scale.factor * s.time[indices], s.scale.factor * s.measured[indices]
    plot = Panel(f"time [{s.time_scale.unit}]", s.label)
    thin = {"color": colours.NOISE, "width": 0.7}
    plot.marks(time, y, origin, colours.MEASURED, 4, line=thin)
    return _models(plot, time, s, indices, 2.2)


def loop_plot(s: series.Series, origin: str, indices: Samples) -> Panel:
    """What was measured over what drives it, such as displacement over voltage."""
    return _measured(Panel(s.against, s.label), s.voltage[indices], s, origin, indices, 1.2)


def error_loop_plot(s: series.Series, limit: int) -> Panel:
    """Residual over what drives the model: where in the loop the model goes wrong."""
    indices, label = samples(s, limit), in_brackets("residual", s.residual_scale.unit)
    plot = Panel(s.against, label, showlegend=len(s.curves) > 1)
    return _residuals(plot, s.voltage[indices], s, indices, 0.9)


def spectrum_plot(s: series.Series, limit: int) -> Panel:
    """Amplitude density of every curve's residual, and of white noise of the record's level."""
    small = s.residual_scale
    plot = Panel("frequency [Hz]", f"residual [{small.unit or 1}/√Hz]")
    floor = small.factor * series.noise_density(s)
    reached, ends = [floor], (0.0, 0.0)
    for curve in s.curves:
        frequency, density = series.spectrum(s.time, s.residual(curve))
        ends = (float(frequency[0]), float(frequency[-1]))
        indices = series.shown_lines(frequency, density, min(limit // 2, _SPECTRUM_POINTS))
        values = small.factor * density[indices]
        reached += [float(np.min(values)), float(np.max(values))]
        plot.line(frequency[indices], values, curve.label, curve.colour)
    plot.line(list(ends), [floor, floor], "noise floor", colours.INK, dash="dash")
    return plot.axes(logarithmic(ends), logarithmic((min(reached), max(reached))))


def autocorrelation_plot(s: series.Series) -> Panel:
    """Autocorrelation of every curve's residual over the lag, and the band of white noise."""
    clock, steps = s.time_scale, np.diff(s.time)
    step = float(np.median(steps))
    even = float(np.max(np.abs(steps - step))) < 0.02 * step
    unit, size = (clock.unit, clock.factor * step) if even else ("samples", 1.0)
    plot = Panel(f"lag [{unit}]", "autocorrelation", showlegend=len(s.curves) > 1)
    band = ends = 0.0
    for curve in s.curves:
        lags, values = series.autocorrelation(s.residual(curve))
        band, ends = series.white_band(s.residual(curve)), float(lags[-1])
        plot.line(size * lags.astype(np.float64), values, curve.label, curve.colour, 1.6)
    zero = {"range": [-1.05, 1.05], "zeroline": True, "zerolinecolor": colours.NOISE}
    return plot.across(-band, band).axes(logarithmic((size, size * ends)), zero)


def distribution_plot(s: series.Series) -> Panel:
    """Share of samples over the size of every curve's residual, with a normal distribution.

    Where the others are far off, the axis is that of the last one; their names say how much of
    them lies outside.
    """
    small = s.residual_scale
    plot = Panel(in_brackets("residual", small.unit), "samples in a bin [%]")
    residuals = [s.residual(c) for c in s.curves]
    low, high = (np.array([f(r) for r in residuals]) for f in (np.nanmin, np.nanmax))
    span = float(high[-1] - low[-1])
    if 0.0 < span * _FAR < float(high.max() - low.min()):
        low, high = low[-1] - 0.5 * span, high[-1] + 0.5 * span
    else:
        low, high = low.min(), high.max()
    for curve, residual in zip(s.curves, residuals, strict=True):
        centres, shares, width = series.distribution(residual, low, high)
        beyond = 100.0 - float(np.sum(shares))
        text = f" ({beyond:.0f} % outside)" if beyond >= 0.5 else ""
        fill = "tozeroy" if curve is s.curves[-1] else "none"
        plot.line(small.factor * centres, shares, f"{curve.label}{text}", curve.colour, fill=fill)
        plot.data[-1]["line"]["shape"] = "hvh"
    mean, spread = float(np.nanmean(residuals[-1])), float(np.nanstd(residuals[-1]))
    if spread > 0:
        x = np.linspace(low, high, 161)
        normal = np.exp(-0.5 * ((x - mean) / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
        plot.line(small.factor * x, 100.0 * width * normal, "normal", colours.INK, dash="dash")
    return plot


def _measured(
    plot: Panel, x: FloatArray, s: series.Series, origin: str, indices: Samples, width: float
) -> Panel:
    plot.line(x, s.scale.factor * s.measured[indices], origin, colours.MEASURED, 3.0)
    return _models(plot, x, s, indices, width)


def _models(plot: Panel, x: FloatArray, s: series.Series, indices: Samples, width: float) -> Panel:
    for curve in s.curves:
        plot.line(x, s.scale.factor * curve.values[indices], curve.label, curve.colour, width)
    return plot


def _residuals(
    plot: Panel, x: FloatArray, s: series.Series, indices: Samples, width: float
) -> Panel:
    """Add what the models leave, with the noise."""
    for curve in s.curves:
        residual = s.residual_scale.factor * s.residual(curve)[indices]
        plot.line(x, residual, curve.label, curve.colour, width)
    edge = 2.0 * s.residual_scale.factor * s.noise
    return plot.across(-edge, edge, name="noise (2 sigma)") if edge > 0.0 else plot


def _with_held_out(plot: Panel, s: series.Series) -> Panel:
    time = s.time_scale.factor * s.time
    return plot.bands(
        [(time[first], time[last]) for first, last in series.spans(s.held_out)], "held out"
    )
