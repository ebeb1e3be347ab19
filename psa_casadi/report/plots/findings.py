"""Plots of findings: evidence of effects, views of a residual, signatures, determinacy."""

import math

import numpy as np

from psa_casadi.common.units import FloatArray, convert
from psa_casadi.diagnosis.corrections import Correction, FreeFunction, Patch
from psa_casadi.diagnosis.misfit import Misfit, Spectrum, View
from psa_casadi.diagnosis.remedy import Signature
from psa_casadi.diagnosis.result import Candidate, Diagnosis
from psa_casadi.identification.grades import DEGREES, WEAK_ERROR, Grade
from psa_casadi.identification.profile import PROFILE_LIMIT, Profile
from psa_casadi.identification.result import Identification
from psa_casadi.report.plots.panel import Panel, logarithmic
from psa_casadi.report.words import colours, phrases
from psa_casadi.report.words.catalogue import LABELS
from psa_casadi.report.words.series import bar_colour

#: The colours of the degrees of determinacy, in their order.
_DEGREE_COLOURS = (colours.EXTENDED, colours.WEAK, colours.BASE, colours.BOUND, colours.NOISE)
#: The range of the bars [%]; a figure beyond it has a mark.
_SHORTEST, _LONGEST = 0.01, 1000.0
#: Heights of a bar, and of a plot's margins with its axis and legend.
_BAR, _MARGINS = 22, 124
#: Correlations of more parameters than this leave no room for figures on a phone.
_MOST_FIGURES = 12
_LOW = 300
#: Samples of a signature that are drawn behind its means, and of a correction.
_BEHIND, _SAMPLES = 1000, 3000
#: Kinds of an unnamed correction that lie over another variable than the time.
_CURVED = ("curve", "direction", "memory")
#: The end of the cost axis over the limit, so that the minimum stays readable.
_TOP = 2.5
_PARABOLA_POINTS = 81


def evidence_plot(d: Diagnosis, most: int | None = None) -> Panel:
    """One bar for every effect that was tried, with the share of the excess that it explains.

    Named causes come first, with their confidence. Of many, the first and most telling ones where
    `most` limits them.
    """
    causes = {c.effect: c.confidence for c in d.causes}
    order = sorted(d.candidates, key=lambda c: c.effect not in causes)  # keeps the others' order
    rows = order[: None if most is None else max(most, len(causes))][::-1]
    # asinh shows small, large and negative evidence in one picture; the labels give the figures
    values = [float(np.arcsinh(c.evidence / 10.0)) for c in rows]
    names = [phrases.plain(c.effect).replace("independent ", "independent\n") for c in rows]
    fills = [bar_colour(c, set(causes)) for c in rows]
    plot = Panel("evidence [ln units], compressed", height=110 + 30 * len(rows), showlegend=False)
    plot.bars(values, names, "", fills, hoverinfo="skip")
    # the figures are right of bar and zero, clear of the names
    figures = [f" {round(c.evidence):,}; {_figure(c, d)}" for c in rows]
    ends = [max(v, 0.0) for v in values]
    plot.texts(ends, names, figures, "middle right", cliponaxis=False)
    largest = max([abs(v) for v in values], default=1.0) or 1.0
    reach = [min([0.0, *values]) * 1.1, (2.3 if causes else 1.75) * largest]
    return plot.axes(
        {"showticklabels": False, "ticks": "", "range": reach},
        {"showgrid": False, "ticks": "", "automargin": True},
        margin={"l": 10, "r": 8, "t": 16, "b": 44},
    )


def _figure(candidate: Candidate, d: Diagnosis) -> str:
    """Return how sure a named cause is, the probability of others; else the share it explains."""
    named = next((c for c in d.causes if c.effect == candidate.effect), None)
    if named is not None:
        return f"named, {phrases.probability_text(named.confidence)}"
    if d.causes:
        return phrases.probability_text(candidate.probability)
    share = candidate.explained_share
    if not candidate.fitted and share == 0:
        return "screened"
    return phrases.percent(share) if share >= 0 else "fits worse"


def view_named(m: Misfit, name: str) -> View | None:
    """Return the view of that name, None where the record has none or nothing to show in it."""
    rows = (*m.views, *((m.holds,) if m.holds else ()))
    return next((v for v in rows if v.name == name and v.x.size), None)


def view_plot(before: View, after: View | None, *, counts: bool) -> Panel:
    """Binned means of the residual with two standard errors, before and after the extension."""
    scale = phrases.length_scale(float(np.max(np.abs(before.mean))), counts=counts)
    rows = [(before, colours.BASE, "base model")]
    rows += [(after, colours.EXTENDED, "extended model")] if after is not None else []
    plot, factor = _view_panel(before, scale, "residual", [v.x for v, _, _ in rows])
    for view, colour, name in rows:
        errors = {"array": 2.0 * scale.factor * view.spread, "color": colour,
                  "thickness": 1.0, "width": 2}  # fmt: skip
        plot.marks(factor * view.x, scale.factor * view.mean, name, colour,
                   line={"color": colour, "width": 1.8}, error_y=errors)  # fmt: skip
    return plot


def spectrum_view_plot(before: Spectrum, after: Spectrum | None, *, counts: bool) -> Panel:
    """Amplitude density of the residual before and after the extension, above the noise's."""
    scale = phrases.length_scale(float(np.max(before.density)), counts=counts)
    rows = [(before.density, before.frequency, colours.BASE, "base model", "solid")]
    if after is not None:
        rows.append((after.density, after.frequency, colours.EXTENDED, "extended model", "solid"))
    rows.append((before.floor, before.frequency, colours.INK, "noise", "dash"))
    plot = Panel("frequency [Hz]", f"residual [{scale.unit}/√Hz]", _LOW, showlegend=True)
    for density, frequency, colour, name, dash in rows:
        plot.line(frequency, scale.factor * density, name, colour, 1.5, dash)
    values = scale.factor * np.concatenate([density for density, *_ in rows])
    ends = float(np.min(values[values > 0])), float(np.max(values))
    return plot.axes(logarithmic(_ends(before.frequency)), logarithmic(ends))


def signature_plot(signature: Signature) -> Panel:
    """What an effect adds along its telling coordinate: samples behind their binned means."""
    view, largest = signature.telling, float(np.max(np.abs(signature.difference)))
    scale = phrases.length_scale(largest)
    plot, factor = _view_panel(view, scale, "difference", [view.x])
    mean = scale.factor * view.mean
    if view.name == "spectrum":
        top = float(np.max(mean))
        plot.line(factor * view.x, mean, "difference")
        reach = [float(np.log10(top)) - 4.0, float(np.log10(top)) + 0.4]
        axis = {**logarithmic((1e-4 * top, top)), "range": reach}
        axis["title"] = {"text": f"difference [{scale.unit}/√Hz]", "standoff": 8}
        return plot.axes(y=axis, showlegend=False)
    low, high = _ends(view.x)
    on = np.flatnonzero((signature.coordinate >= low) & (signature.coordinate <= high))
    on = on[:: max(1, on.size // _BEHIND)]
    behind = factor * signature.coordinate[on], scale.factor * signature.counted[on]
    plot.marks(*behind, "samples", colours.NOISE, 3)
    line = {"color": colours.EXTENDED, "width": 1.8}
    return plot.marks(factor * view.x, mean, "binned means", line=line)


def _view_panel(
    view: View, scale: phrases.Scale, what: str, arrays: list[FloatArray]
) -> tuple[Panel, float]:
    """Return an empty plot of a view, and the factor from its coordinate to the axis."""
    unit, factor = ("µm", 1e6) if view.x_unit == "m" else (view.x_unit, 1.0)
    plot = Panel(f"{LABELS[view.name]} [{unit}]", f"{what} [{scale.unit}]", _LOW, showlegend=True)
    if view.name.startswith(("since_reversal", "holds", "spectrum")):
        plot.axes(logarithmic(_ends(factor * np.concatenate(arrays))))
    return plot.axes(y={"zeroline": True, "zerolinecolor": colours.NOISE}), factor


def _ends(values: FloatArray) -> tuple[float, float]:
    return float(values.min()), float(values.max())


def correction_plot(d: Diagnosis, c: Correction) -> tuple[str, Panel]:
    """Return over what, and what an unnamed correction adds.

    Of a stack it is that of the record to which most is added, of any other model that of all.
    """
    if isinstance(c, FreeFunction):
        largest = float(np.max(np.abs(c.along), initial=0.0))
        coordinate = phrases.prefixed_scale(largest, c.variable_unit or "1")
        at, added, name, unit = coordinate.factor * c.along, c.added, c.variable, coordinate.unit
        scale = phrases.prefixed_scale(float(np.max(np.abs(added), initial=0.0)), c.unit)
    elif isinstance(c, Patch):
        k = max(range(len(c.added)), key=lambda i: float(np.std(c.added[i])))
        e, added = d.experiments[k], c.added[k] - np.mean(c.added[k])
        counts = e.record.displacement_unit == "counts"
        scale = phrases.length_scale(float(np.max(np.abs(added), initial=1e-12)), counts=counts)
        if c.kind == "curve" and c.port != "drive voltage":
            unit, size = ("counts", 1.0) if counts else ("µm", 1e6)
            at, name = size * d.extended[k], "predicted displacement"
        elif c.kind in _CURVED:
            at, name, unit = e.record.voltage, "voltage", "V"
        else:
            at, name, unit = e.record.time - e.record.time[0], "time", "s"
    else:
        raise TypeError(type(c))
    part = slice(None, None, max(1, len(at) // _SAMPLES))
    along, label = (phrases.in_brackets(*row) for row in ((name, unit), ("added", scale.unit)))
    plot, x, y = Panel(along, label, 320), at[part], scale.factor * added[part]
    if isinstance(c, FreeFunction) or c.kind in _CURVED:
        plot.marks(x, y, size=3)
    else:
        plot.line(x, y, width=1.5)
    return (name if isinstance(c, FreeFunction) else f"the {name}"), plot


def determinacy_plot(graded: tuple[Grade, ...]) -> Panel:
    """One bar for every parameter: its standard error over its value, on a logarithmic axis."""
    fitted = sorted((g for g in graded if g.degree != "fixed"), key=lambda g: g.error)
    rows = [*fitted, *(g for g in graded if g.degree == "fixed")]
    percents = [min(max(100.0 * g.error, _SHORTEST), _LONGEST) for g in fitted]
    left = 10.0 ** math.floor(math.log10(min([1.0, *percents]) * 0.5))
    right = max([100.0, *percents]) * 15.0
    plot = Panel("relative standard error [%]", height=_MARGINS + _BAR * len(rows))
    for degree, colour in zip(DEGREES, _DEGREE_COLOURS, strict=True):
        group = [(g, x) for g, x in zip(fitted, percents, strict=True) if g.degree == degree]
        if group:
            names = [g.name for g, _ in group]
            plot.bars([x for _, x in group], names, degree, colour, width=0.66,
                      hovertemplate="%{y}: %{x:.3g} %<extra></extra>")  # fmt: skip
    inks = [colours.NOISE if g.degree == "fixed" else colours.INK for g in rows]
    figures = [
        "fixed" if g.degree == "fixed"
        else f"{phrases.number(100.0 * g.error, 2)} %" if g.error <= _LONGEST / 100.0
        else f"> {_LONGEST:.0f} %"
        for g in rows
    ]  # fmt: skip
    plot.texts([right / 1.15] * len(rows), [g.name for g in rows], figures,
               "middle left", textfont={"color": inks})  # fmt: skip
    plot.upright(100.0 * WEAK_ERROR).upright(50.0, dash="dash")
    return plot.axes(
        {"type": "log", "dtick": 1, "range": [math.log10(left), math.log10(right)],
         "exponentformat": "none", "side": "bottom"},
        {"categoryorder": "array", "categoryarray": [g.name for g in reversed(rows)],
         "showgrid": False, "ticks": "", "automargin": True, "range": [-0.6, len(rows) - 0.4]},
        barmode="overlay", margin={"l": 20, "r": 10, "t": 46, "b": 46},
    )  # fmt: skip


def correlation_plot(identification: Identification) -> Panel:
    """Correlations of the estimates as a square of colours, strong ones with their figure."""
    names, matrix = list(identification.determinacy.names), identification.determinacy.correlations
    has_figures = len(names) <= _MOST_FIGURES
    rows = max(10, len(identification.model.structure.parameters))
    plot = Panel(height=_MARGINS + _BAR * min(rows, 2 * len(names) + 2))
    cells = [(i, k, float(np.clip(matrix[i, k], -1.0, 1.0)))
             for i in range(len(names)) for k in range(i + 1)]  # fmt: skip
    signs = ((1.0, colours.EXTENDED, "positive"), (-1.0, colours.BASE, "negative"))
    for sign, colour, name in signs:
        part = [(i, k, v) for i, k, v in cells if sign * v > 0.0]
        look = {"color": colour, "opacity": [abs(v) for _, _, v in part]}
        plot.bars(  # a cell is a bar with its base at its column
            [0.92] * len(part), [names[i] for i, _, _ in part], name, look, width=0.92,
            base=[k - 0.46 for _, k, _ in part],
            text=[_correlation_text(v) if has_figures and i > k else "" for i, k, v in part],
            textposition="inside", insidetextanchor="middle", textangle=0, constraintext="none",
            textfont={"size": 10, "color": colours.INK},
            hovertext=[f"{names[i]} and {names[k]}: {v:.3f}" for i, k, v in part],
            hovertemplate="%{hovertext}<extra></extra>",
        )  # fmt: skip
    bare = {"showgrid": False, "ticks": "", "mirror": False, "showline": False, "automargin": True}
    count = len(names)
    return plot.axes(
        {**bare, "tickangle": -60, "tickvals": list(range(count)), "ticktext": names,
         "range": [-0.5, count - 0.5]},
        {**bare, "categoryorder": "array", "categoryarray": names, "range": [count - 0.5, -0.5]},
        margin={"l": 20, "r": 12, "t": 40, "b": 20}, meta={"square": True}, barmode="overlay",
    )  # fmt: skip


def _correlation_text(value: float) -> str:
    if abs(value) < 0.5:
        return ""
    return f"{value:.2f}".replace("-", "−").replace("0.", ".").replace("1.00", "1")


def profile_plot(p: Profile) -> Panel:
    """Increase of the cost over the parameter's value, with the limit and the 95 % interval shaded.

    A dotted parabola shows the linearised interval; where it departs from the profile, the standard
    error misleads. The axis is logarithmic where the profile spans more than a factor of three.
    """
    values = np.array([convert(float(v), p.unit, p.display_unit) for v in p.values])
    span = (float(values[0]), float(values[-1]))
    log = p.log and span[1] > 3.0 * span[0] > 0.0
    unit = "" if p.unit == "1" else f" [{p.display_unit}]"
    plot = Panel(f"{p.name}{unit}", "increase of the cost", 380)
    plot.marks(values, p.increase, "all other parameters fitted anew",
               line={"color": colours.EXTENDED, "width": 2.0})  # fmt: skip
    if p.log:  # the linearised interval, in the logarithm where it has one
        at = np.geomspace(p.values[0], p.values[-1], _PARABOLA_POINTS)
        away = np.log(at / p.estimate) * p.estimate / p.standard_error
    else:
        at = np.linspace(p.values[0], p.values[-1], _PARABOLA_POINTS)
        away = (at - p.estimate) / p.standard_error
    values_at = np.array([convert(float(v), p.unit, p.display_unit) for v in at])
    plot.line(values_at, away**2, "linearised", colours.NOISE, dash="dot")
    low, high = (
        edge if end is None else convert(end, p.unit, p.display_unit)
        for end, edge in ((p.low, span[0]), (p.high, span[1]))
    )
    plot.across(PROFILE_LIMIT).bands([(low, high)])
    reach = [float(np.log10(v)) for v in span] if log else list(span)
    return plot.axes(
        {**(logarithmic(span) if log else {}), "range": reach},
        {"range": [-0.1 * PROFILE_LIMIT, _TOP * PROFILE_LIMIT]},
    )
