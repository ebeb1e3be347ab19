"""Plot of a profile likelihood."""

import numpy as np
import plotly.graph_objects as go

from psa_casadi.identification.profile import PROFILE_LIMIT, Profile
from psa_casadi.report.plots.theme import INK, Plot, logarithmic, styled
from psa_casadi.report.words.series import EXTENDED_COLOUR, HELD_OUT_COLOUR, NOISE_COLOUR
from psa_casadi.units import convert

#: The cost is shown up to this many limits; beyond, a curve only hides its foot.
_TOP = 2.5
_PARABOLA_POINTS = 81


def profile_plot(p: Profile) -> Plot:
    """Increase of the cost over the parameter's value, with the limit and the 95 % interval shaded.

    A dotted parabola shows the linearised interval; where it departs from the profile, the standard
    error misleads. The axis is logarithmic where the profile spans more than a factor of three.
    """
    values = np.array([convert(float(v), p.unit, p.display_unit) for v in p.values])
    log = p.log and values[-1] > 3.0 * values[0] > 0.0
    plot = go.Figure()
    plot.add_scatter(
        x=values, y=p.increase, mode="lines+markers", name="all other parameters fitted anew",
        line={"color": EXTENDED_COLOUR, "width": 2.0}, marker={"size": 6},
    )  # fmt: skip
    _parabola(plot, p)
    plot.add_hline(PROFILE_LIMIT, line={"color": INK, "dash": "dash", "width": 1.2})
    ends = [
        edge if end is None else convert(end, p.unit, p.display_unit)
        for end, edge in ((p.low, values[0]), (p.high, values[-1]))
    ]
    plot.add_vrect(*ends, fillcolor=HELD_OUT_COLOUR, layer="below", line_width=0)
    unit = "" if p.unit == "1" else f" [{p.display_unit}]"
    span = (float(values[0]), float(values[-1]))
    axis = logarithmic(span) if log else {}
    limits = [float(np.log10(v)) for v in span] if log else list(span)
    plot.update_xaxes(title_text=f"{p.name}{unit}", range=limits, **axis)
    plot.update_yaxes(
        title_text="increase of the cost", range=[-0.1 * PROFILE_LIMIT, _TOP * PROFILE_LIMIT]
    )
    return styled(plot, 380)


def _parabola(plot: Plot, p: Profile) -> None:
    """Add what the standard error alone says, in the logarithm for a parameter that has one."""
    if p.log:
        shown = np.geomspace(p.values[0], p.values[-1], _PARABOLA_POINTS)
        away = np.log(shown / p.estimate) * p.estimate / p.standard_error
    else:
        shown = np.linspace(p.values[0], p.values[-1], _PARABOLA_POINTS)
        away = (shown - p.estimate) / p.standard_error
    plot.add_scatter(
        x=[convert(float(v), p.unit, p.display_unit) for v in shown], y=away**2, mode="lines",
        name="linearised", line={"color": NOISE_COLOUR, "dash": "dot", "width": 1.4},
    )  # fmt: skip
