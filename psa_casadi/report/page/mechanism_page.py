"""A designed prestress mechanism: what it reaches, its root locus, and the answers to a step."""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from psa_casadi.design.mechanism.loop import Mounting, response_times, step_response
from psa_casadi.design.mechanism.mechanism import (
    MechanismDesign,
    Reached,
    mounted_model,
    root_locus,
)
from psa_casadi.design.tracking.targets import respond
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.report.page.design_page import write_design_page
from psa_casadi.report.page.live_part import LiveModel, live_design
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.theme import INK, Plot, styled
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.series import BASE_COLOUR, EXTENDED_COLOUR, NOISE_COLOUR
from psa_casadi.report.words.tables import Table

_FREE = Mounting(0.0, 0.0, 0.0)
#: Samples of the step that the page's model runs on.
_STEP_SAMPLES = 3000


@dataclass(frozen=True)
class _Titled:
    title: str
    table: Table
    note: str = ""


def mechanism_table(d: MechanismDesign) -> Table:
    """Return the mechanism and what the stack does without it and with it."""
    m = d.mounting
    rows = [
        ("mass", "-", number(1e3 * m.mass, 4), "g"),
        ("damping", "-", number(m.damping, 4), "N.s/m"),
        ("stiffness", "-", number(1e-6 * m.stiffness, 4), "N/um"),
    ]
    free, reached = _figures(d.free), _figures(d.reached)
    for (name, before, unit), (_, after, _) in zip(free, reached, strict=True):
        rows.append((name, number(before, 4), number(after, 4), unit))
    return Table(("", "free stack", "with the mechanism", "unit"), tuple(rows))


def _figures(r: Reached) -> tuple[tuple[str, float, str], ...]:
    return (
        ("least damping ratio of the mechanics", r.damping, "1"),
        ("bandwidth of the mechanics", r.bandwidth, "Hz"),
        ("bandwidth with lag and amplifier", r.whole_bandwidth, "Hz"),
        ("stroke loss", 100.0 * r.stroke_loss, "%"),
        ("overshoot in a step of rated voltage", 100.0 * r.overshoot, "%"),
        ("peak force in the mechanism in that step", r.peak_force, "N"),
    )


def pole_table(d: MechanismDesign) -> Table:
    """Return every pole without and with the mechanism, and the lag's, which does not move."""
    rows = [
        ("mechanics", _pole(before), _pole(after))
        for before, after in zip(d.free_poles, d.poles, strict=True)
    ]
    rows.append(("lag, -1/tau (the paper's creep)", _pole(d.lag_pole), _pole(d.lag_pole)))
    return Table(("pole of", "free stack [rad/s]", "with the mechanism [rad/s]"), tuple(rows))


def _pole(pole: complex) -> str:
    value = complex(pole)
    if value.imag == 0.0:
        return number(value.real, 4)
    sign = "+" if value.imag > 0.0 else "-"
    return f"{number(value.real, 4)} {sign} {number(abs(value.imag), 4)}j"


def mechanism_sentences(d: MechanismDesign) -> tuple[str, ...]:
    """Return the result in sentences: reached or not, what stands in the way, the lag's pole."""
    wanted = " and ".join(d.goals)
    if d.attained:
        first = f"Wanted {wanted}: reached within the limits."
    else:
        at = f"; the design stands at its limit of {' and '.join(d.binding)}" if d.binding else ""
        first = f"Wanted {wanted}: out of reach{at}. This comes as near as it can."
    corner = -d.lag_pole / (2.0 * np.pi)
    slower = corner < d.reached.bandwidth
    lag = (
        f"The lag's pole at {number(d.lag_pole, 4)} rad/s ({number(corner, 4)} Hz) stands outside"
        " the loop: no mechanism moves it."
    )
    if slower:
        lag += " It is slower than the mechanics, so that it sets the bandwidth of the whole."
    sentences = [first, lag]
    if d.acts_on == "tip":
        sentences.append(
            "The mechanism acts on the output mass only; in a stack without reciprocal coupling the"
            " wafers' poles stay where they are."
        )
    sentences.append(f"{d.agreeing} of {d.starts} starts of the search led to this design.")
    return tuple(sentences)


def root_locus_plot(d: MechanismDesign) -> Plot:
    """Poles in the complex plane as the mechanism grows from nothing to four times its size."""
    gains = np.concatenate([[0.0], np.geomspace(1e-4, 4.0, 300)])
    branches = root_locus(d, gains)[1 if d.acts_on == "tip" else 0 :]
    plot = go.Figure()
    for k, branch in enumerate(branches.T):
        _points(plot, branch, "size 0 to 4 times", NOISE_COLOUR, "lines", k == 0)
    _points(plot, d.free_poles, "free stack", BASE_COLOUR, "markers", True, symbol="x")
    _points(plot, d.poles, "with the mechanism", EXTENDED_COLOUR, "markers", True, symbol="circle")
    lag = np.array([complex(d.lag_pole)])
    _points(plot, lag, "lag, cannot be moved", INK, "markers", True, symbol="square")
    shown = np.concatenate([d.free_poles, d.poles, lag])
    shown = shown[np.abs(shown) < 4.0 * np.abs(d.free_poles).max()]
    reach = 1.15e-3 * max(float(np.abs(shown.real).max()), float(np.abs(shown.imag).max()))
    left = max(1.3e-3 * float(np.abs(shown.real).max()), 0.3 * reach)
    ratio = min(d.reached.damping, 1.0)
    edge = np.array([0.0, reach])
    for sign in (-1.0, 1.0):
        plot.add_scatter(
            x=-ratio * edge, y=sign * np.sqrt(1.0 - ratio**2) * edge, mode="lines",
            line={"color": EXTENDED_COLOUR, "dash": "dot", "width": 1.2}, hoverinfo="skip",
            name=f"damping ratio {number(ratio, 3)}", showlegend=sign > 0.0,
        )  # fmt: skip
    plot.update_xaxes(title_text="real part [1000 rad/s]", range=[-left, 0.06 * left])
    plot.update_yaxes(title_text="imaginary part [1000 rad/s]", range=[-reach, reach])
    return styled(plot, 520)


def _points(
    plot: Plot, values: np.ndarray[tuple[int, ...], np.dtype[np.complex128]], name: str,
    colour: str, mode: str, legend: bool, symbol: str = "circle",
) -> None:  # fmt: skip
    plot.add_scatter(
        x=1e-3 * values.real, y=1e-3 * values.imag, mode=mode, name=name, legendgroup=name,
        showlegend=legend, line={"color": colour, "width": 1.4},
        marker={"color": colour, "size": 10, "symbol": symbol},
    )  # fmt: skip


def step_plot(d: MechanismDesign) -> Plot:
    """Answers to a step of the rated voltage, free and mounted, over the final value of each."""
    plot = go.Figure()
    times = [response_times(d.mechanics, m, 1500) for m in (_FREE, d.mounting)]
    end = min(float(times[0][-1]), 2.0 * float(times[1][-1]))
    for mounting, name, colour in (
        (_FREE, "free stack", BASE_COLOUR),
        (d.mounting, "with the mechanism", EXTENDED_COLOUR),
    ):
        time = np.linspace(0.0, end, 3000)
        x = 1e6 * step_response(d.mechanics, mounting, time).displacement
        plot.add_scatter(
            x=1e3 * time, y=x, mode="lines", name=name, line={"color": colour, "width": 1.8}
        )
    plot.update_xaxes(title_text="time [ms]")
    plot.update_yaxes(title_text="displacement [µm]")
    return styled(plot, 400)


def _live(d: MechanismDesign, model: Model) -> LiveModel:
    """Begin what lets the mounted stack run in the page, on a step of the rated voltage."""
    whole = mounted_model(model, d)
    end = 2.0 * float(response_times(d.mechanics, d.mounting)[-1])
    time = np.linspace(0.0, end, _STEP_SAMPLES)
    voltage = np.where(time > 0.02 * end, model.values["u_rated"], 0.0)
    played = respond(whole, time, voltage)
    return live_design(whole, (time, voltage, played.displacement), rest=True)


def write_mechanism_page(
    d: MechanismDesign, path: str | os.PathLike[str], model: Model, *, still: bool = False
) -> None:
    """Write the design as an HTML page; `model` is the stack.

    Unless it is to be `still`, the stack with its mechanism runs in the page. Raises InputError if
    it cannot be written.
    """
    why, live = "", None
    try:
        live = None if still else _live(d, model)
    except InputError as error:
        why = f"The model does not run in this page. {error}"
    tables: Sequence[_Titled] = (
        _Titled("Mechanism", mechanism_table(d)),
        _Titled(
            "Poles",
            pole_table(d),
            "A mechanism acts as feedback around the mechanics (position, velocity and acceleration"
            " by its stiffness, damping and mass); the lag stands before the loop.",
        ),
    )
    figures = (
        Picture(
            "Root locus",
            root_locus_plot(d),
            "The poles as the whole mechanism grows; those beyond the picture are in the table.",
        ),
        Picture(
            "Step of the rated voltage",
            step_plot(d),
            "Linear answer in closed form, with the lag and the amplifier, without hysteresis.",
        ),
    )
    write_design_page(
        path,
        title=f"Prestress mechanism for {model.name}",
        summary=[*mechanism_sentences(d), *([why] if why else [])],
        live=live,
        tables=tables,
        figures=figures,
    )
