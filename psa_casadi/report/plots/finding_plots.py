"""Plots of the HTML pages that show a finding: evidence of effects, what is determined."""

import math
from typing import TYPE_CHECKING

import numpy as np
import plotly.graph_objects as go

from psa_casadi.diagnosis.result import Candidate, Diagnosis
from psa_casadi.identification.identify import Identification
from psa_casadi.report.plots.theme import (
    AXIS,
    BOUND_COLOUR,
    INK,
    WEAK_COLOUR,
    Plot,
    styled,
)
from psa_casadi.report.words.fit_words import DEGREES, WEAK_ERROR, Degree, Grade
from psa_casadi.report.words.phrases import number, percent, plain, probability_text
from psa_casadi.report.words.series import BASE_COLOUR, EXTENDED_COLOUR, NOISE_COLOUR, bar_colour

if TYPE_CHECKING:  # which take long to load
    from psa_casadi.any_model.result import OdeDiagnosis

_DEGREE_COLOURS: dict[Degree, str] = {
    "determined": EXTENDED_COLOUR,
    "weak": WEAK_COLOUR,
    "undetermined": BASE_COLOUR,
    "on its bound": BOUND_COLOUR,
    "fixed": NOISE_COLOUR,
}
#: The bars begin and end here [%]; what lies beyond says so in its figure.
_SHORTEST, _LONGEST = 0.01, 1000.0
#: Heights of a bar, and of a plot's margins with its axis and legend.
_BAR, _MARGINS = 22, 124
#: Correlations of more parameters than this leave no room for figures on a phone.
_MOST_FIGURES = 12


def determinacy_plot(graded: tuple[Grade, ...]) -> Plot:
    """One bar for every parameter: its standard error over its value, on a logarithmic axis."""
    fitted = sorted((g for g in graded if g.degree != "fixed"), key=lambda g: g.error)
    rows = [*fitted, *(g for g in graded if g.degree == "fixed")]
    shown = [min(max(100.0 * g.error, _SHORTEST), _LONGEST) for g in fitted]
    left = 10.0 ** math.floor(math.log10(min([1.0, *shown]) * 0.5))
    right = max([100.0, *shown]) * 15.0
    plot = go.Figure()
    for degree in DEGREES:
        group = [(g, x) for g, x in zip(fitted, shown, strict=True) if g.degree == degree]
        if group:
            plot.add_bar(
                x=[x for _, x in group], y=[g.name for g, _ in group], orientation="h",
                name=degree, marker={"color": _DEGREE_COLOURS[degree]}, width=0.66,
                hovertemplate="%{y}: %{x:.3g} %<extra></extra>",
            )  # fmt: skip
    plot.add_scatter(
        x=[right / 1.15] * len(rows), y=[g.name for g in rows], mode="text",
        text=[_error_text(g) for g in rows], textposition="middle left",
        textfont={"color": [NOISE_COLOUR if g.degree == "fixed" else INK for g in rows]},
        showlegend=False, hoverinfo="skip",
    )  # fmt: skip
    plot.add_vline(100.0 * WEAK_ERROR, line={"color": AXIS, "dash": "dot", "width": 1.2})
    plot.add_vline(100.0 * 0.5, line={"color": AXIS, "dash": "dash", "width": 1.2})
    styled(plot, _MARGINS + _BAR * len(rows))
    plot.update_layout(barmode="overlay", margin={"l": 20, "r": 10, "t": 46, "b": 46})
    plot.update_xaxes(
        type="log", dtick=1, range=[math.log10(left), math.log10(right)],
        title_text="relative standard error [%]", exponentformat="none", side="bottom",
    )  # fmt: skip
    names = [g.name for g in reversed(rows)]
    return plot.update_yaxes(
        categoryorder="array", categoryarray=names, showgrid=False, ticks="", automargin=True,
        range=[-0.6, len(rows) - 0.4],
    )  # fmt: skip


def _error_text(grade: Grade) -> str:
    if grade.degree == "fixed":
        return "fixed"
    if not grade.error <= _LONGEST / 100.0:
        return f"> {_LONGEST:.0f} %"
    return f"{number(100.0 * grade.error, 2)} %"


def correlation_plot(found: Identification) -> Plot:
    """Correlations of the estimates as a square of colours, strong ones with their figure."""
    names, matrix = list(found.determinacy.names), found.determinacy.correlations
    written, plot = len(names) <= _MOST_FIGURES, go.Figure()
    cells = [(i, k, float(np.clip(matrix[i, k], -1.0, 1.0)))
             for i in range(len(names)) for k in range(i + 1)]  # fmt: skip
    for sign, colour, said in ((1.0, EXTENDED_COLOUR, "positive"), (-1.0, BASE_COLOUR, "negative")):
        shown = [(i, k, v) for i, k, v in cells if sign * v > 0.0]
        plot.add_bar(  # a cell is a bar that begins at its column
            base=[k - 0.46 for _, k, _ in shown], x=[0.92] * len(shown), width=0.92,
            y=[names[i] for i, _, _ in shown], orientation="h", name=said,
            marker={"color": colour, "opacity": [abs(v) for _, _, v in shown]},
            text=[_correlation_text(v) if written and i > k else "" for i, k, v in shown],
            textposition="inside", insidetextanchor="middle", textangle=0, constraintext="none",
            textfont={"size": 10, "color": INK},
            hovertext=[f"{names[i]} and {names[k]}: {v:.3f}" for i, k, v in shown],
            hovertemplate="%{hovertext}<extra></extra>",
        )  # fmt: skip
    rows = max(10, len(found.model.structure.parameters))
    styled(plot, _MARGINS + _BAR * min(rows, 2 * len(names) + 2))
    plot.update_layout(
        margin={"l": 20, "r": 12, "t": 40, "b": 20}, meta={"square": True}, barmode="overlay"
    )
    plot.update_xaxes(
        showgrid=False, ticks="", tickangle=-60, mirror=False, showline=False, automargin=True,
        tickvals=list(range(len(names))), ticktext=names, range=[-0.5, len(names) - 0.5],
    )  # fmt: skip
    return plot.update_yaxes(
        showgrid=False,
        ticks="",
        categoryorder="array",
        categoryarray=names,
        range=[len(names) - 0.5, -0.5],
        mirror=False,
        showline=False,
        automargin=True,
    )


def _correlation_text(value: float) -> str:
    if abs(value) < 0.5:
        return ""
    return f"{value:.2f}".replace("-", "−").replace("0.", ".").replace("1.00", "1")


def evidence_plot(d: "Diagnosis | OdeDiagnosis", most: int | None = None) -> Plot:
    """One bar for every effect that was tried; text says the share of the excess it explains.

    Named causes come first, with their confidence. Of many, the first and most telling ones where
    only so many are to be drawn.
    """
    causes = {c.effect: c.confidence for c in d.causes}
    order = sorted(d.candidates, key=lambda c: c.effect not in causes)  # keeps the others' order
    rows = order[: None if most is None else max(most, len(causes))][::-1]
    # asinh shows small, large and negative evidence in one picture; the labels give the figures
    values = [float(np.arcsinh(c.evidence / 10.0)) for c in rows]
    names = [plain(c.effect).replace("independent ", "independent<br>") for c in rows]
    colours = [bar_colour(c, set(causes)) for c in rows]
    plot = go.Figure(
        go.Bar(x=values, y=names, orientation="h", marker={"color": colours}, hoverinfo="skip")
    )
    # the figures stand to the right of bar and zero, clear of the names
    plot.add_scatter(
        x=[max(v, 0.0) for v in values], y=names, mode="text", textposition="middle right",
        text=[f" {round(c.evidence):,}; {_figure(c, d)}" for c in rows], cliponaxis=False,
        hoverinfo="skip",
    )  # fmt: skip
    largest = max([abs(v) for v in values], default=1.0) or 1.0
    styled(plot, 110 + 30 * len(rows))
    plot.update_layout(margin={"l": 10, "r": 8, "t": 16, "b": 44})
    plot.update_xaxes(
        title_text="evidence [ln units], compressed",
        showticklabels=False,
        ticks="",
        range=[min([0.0, *values]) * 1.1, (2.3 if causes else 1.75) * largest],
    )
    plot.update_layout(showlegend=False)
    return plot.update_yaxes(showgrid=False, ticks="", automargin=True)


def _figure(candidate: Candidate, d: "Diagnosis | OdeDiagnosis") -> str:
    """Return how sure a named cause is, the probability of others; else the share it explains."""
    named = next((c for c in d.causes if c.effect == candidate.effect), None)
    if named is not None:
        return f"named, {probability_text(named.confidence)}"
    if d.causes:
        return probability_text(candidate.probability)
    share = candidate.explained_share
    if not candidate.fitted and share == 0:
        return "screened"
    return percent(share) if share >= 0 else "fits worse"
