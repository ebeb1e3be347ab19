"""A designed experiment in words, tables and plots: for the terminal, the page and the picture."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np
import plotly.graph_objects as go

from psa_casadi.design.experiment.criteria import Rival
from psa_casadi.design.experiment.experiment import ASKED, PLAYS, Informative, Separated
from psa_casadi.model.compose import Model
from psa_casadi.records import write_record
from psa_casadi.records.record import Record
from psa_casadi.report.page.design_page import write_design_page
from psa_casadi.report.page.live_part import live_design
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.theme import styled
from psa_casadi.report.words.phrases import (
    interval_text,
    length_scale,
    listing,
    number,
    percent,
    plain,
    probability_text,
    shown_in,
)
from psa_casadi.report.words.series import BASE_COLOUR, EXTENDED_COLOUR, MEASURED_COLOUR
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.simulate import simulate
from psa_casadi.units import FloatArray, convert

_COLOURS = (EXTENDED_COLOUR, BASE_COLOUR, MEASURED_COLOUR)
_FAMILIES = {
    "free": "free-form voltage, linear between corners",
    "triangles": "triangles between reversal points",
    "steps": "steps and holds",
    "multisine": "multisine",
    "sine": "sine (no designed voltage was better)",
    "triangle": "triangle (no designed voltage was better)",
}


@dataclass(frozen=True)
class Shown:
    """A table under a title, with a note on how to read it."""

    title: str
    table: Table
    note: str = ""


def write_voltage(path: str | os.PathLike[str], record: Record) -> None:
    """Write a designed voltage as a CSV that a signal generator plays and `psa simulate` reads."""
    write_record(path, {"time [s]": record.time, "voltage [V]": record.voltage})


def write_experiment_page(
    path: str | os.PathLike[str],
    design: Separated | Informative,
    model: Model,
    rivals: Mapping[str, Rival],
    *,
    still: bool = False,
) -> None:
    """Write the page of a designed experiment, in which the model runs unless it is to be `still`.

    Raises InputError where it cannot be written.
    """
    played = design.record.time, design.record.voltage
    live = None if still else live_design(model, (*played, simulate(model, *played).displacement))
    several = isinstance(design, Separated)
    title = "Experiment that separates effects" if several else "Experiment for the parameters"
    responses = {n: r.predict(design.record, r.truth) for n, r in rivals.items()}
    write_design_page(
        path,
        title=title,
        summary=sentences(design, model.values.get("C_p")),
        tables=design_tables(design, model),
        figures=(voltage_picture(design.record), response_picture(design.record, responses)),
        badges=(f"{design.record.n} samples", f"{number(design.limits.duration)} s"),
        live=live,
    )


def sentences(design: Separated | Informative, capacitance: float | None) -> tuple[str, ...]:
    """Return what the design promises, and what it asks of the amplifier."""
    said = chance_sentence(design) if isinstance(design, Separated) else narrower_sentence(design)
    voltage = voltage_sentence(design, capacitance)
    return (said, again_sentence(design), voltage) if _unsure(design) else (said, voltage)


def _unsure(design: Separated | Informative) -> TypeGuard[Separated]:
    return isinstance(design, Separated) and design.plays != 1


def again_sentence(design: Separated) -> str:
    """Say what would tell where one play of the record is not sure to."""
    if design.plays is None:
        return (
            f"No record was found that is predicted to decide with {percent(ASKED)}, not even one"
            f" that is repeated {PLAYS[-1]} times: within these limits the effects look alike."
            " Widen the range of voltages or the band, make the record longer, or lower the"
            " noise of the sensor."
        )
    return (
        f"One run may not decide; {design.plays} runs, each from rest and recorded on its"
        f" own, are predicted to name the cause with {percent(ASKED)} or more."
    )


def design_tables(design: Separated | Informative, model: Model) -> tuple[Shown, ...]:
    """Return the figures behind the sentences."""
    if isinstance(design, Informative):
        note = "The model's values are taken as true; the sensor's offset and the start are free."
        return (Shown("Predicted intervals", interval_table(design, model), note),)
    note = (
        "Each other effect is fitted again, as far as the data at hand let it; the true one is"
        " taken a standard error weaker than it was fitted."
    )
    growth = Shown("Growth of ln of the Bayes factor", pair_table(design), note)
    return growth, Shown("Probability of being named", chance_table(design))


def voltage_sentence(design: Separated | Informative, capacitance: float | None) -> str:
    """Say what the voltage is, and how much it asks of the amplifier."""
    record = design.record
    rate = float(np.max(np.abs(np.diff(record.voltage) / np.diff(record.time))))
    current = ""
    if capacitance:
        current = f", {number(1e3 * capacitance * rate)} mA into the stack"
    return (
        f"{_FAMILIES[design.kind].capitalize()}: {record.n} samples in"
        f" {number(design.limits.duration)} s, {number(record.voltage.min())} to"
        f" {number(record.voltage.max())} V, at most {number(rate)} V/s{current}."
    )


def chance_sentence(design: Separated) -> str:
    """Say how surely the record names each of the effects, if it is the cause."""
    parts = [f"{plain(n)} with {probability_text(p)}" for n, p in design.chance.items()]
    return (
        f"It is predicted to name the cause, if that is {listing(parts, 'or')}; the least ln of"
        f" the Bayes factor between two of them grows by"
        f" {number(min(p.designed for p in design.pairs))}, {_factors(design)}."
    )


def _factors(design: Separated) -> str:
    usual = [f"{number(design.factor(n), 2)} times what a {n} gives" for n in design.usual_chance]
    return f"{listing(usual)} of the same length and amplitude"


def narrower_sentence(design: Informative) -> str:
    """Say by how much the intervals are narrower than with the usual voltages."""
    parts = [f"{number(f, 2)} times narrower than with a {n}" for n, f in design.factor.items()]
    kinds = {"D": "volume", "A": "mean square", "E": "worst direction"}
    return (
        f"{design.optimality}-optimal ({kinds[design.optimality]} of the confidence region):"
        f" intervals {listing(parts)} of the same length and amplitude."
    )


def pair_table(design: Separated) -> Table:
    """Return the growth of ln of the Bayes factor for every truth and other effect."""
    usual = list(design.usual_chance)
    rows = [
        (plain(p.truth), plain(p.other), number(p.designed), *(number(p.usual[n]) for n in usual))
        for p in design.pairs
    ]
    head = ("if it is", "over", "designed [ln]", *(f"{n} [ln]" for n in usual))
    return Table(head, tuple(rows))


def chance_table(design: Separated) -> Table:
    """Return the probability of being named for every effect, with each voltage."""
    usual = list(design.usual_chance)
    rows = [
        (plain(n), probability_text(p), *(probability_text(design.usual_chance[u][n])
                                          for u in usual))
        for n, p in design.chance.items()
    ]  # fmt: skip
    return Table(("if it is", "named after designed", *(f"after {u}" for u in usual)), tuple(rows))


def interval_table(design: Informative, model: Model) -> Table:
    """Return the predicted 95 % interval of every chosen parameter, before and after."""
    rows = []
    for name, after in design.intervals.items():
        unit, display = shown_in(model, name)
        cells = []
        for low, high in (design.before[name], after):
            ends = (convert(v, unit, display) for v in (low, high))
            cells.append(interval_text(*ends))
        value = number(convert(model.values[name], unit, display), 4)
        half = 0.5 * (after[1] - after[0]) / max(abs(model.values[name]), 1e-300)
        rows.append((name, value, display, *cells, percent(half) if half < 10 else "open"))
    head = ("parameter", "value", "unit", "known before", "95 % interval after", "half width")
    return Table(head, tuple(rows))


def voltage_picture(record: Record) -> Picture:
    """Return the plot of the voltage to play."""
    plot = go.Figure()
    plot.add_scatter(
        x=record.time, y=record.voltage, mode="lines", name="voltage",
        line={"color": MEASURED_COLOUR, "width": 1.4},
    )  # fmt: skip
    plot.update_layout(showlegend=False)
    plot.update_xaxes(title="time [s]")
    plot.update_yaxes(title="voltage [V]")
    return Picture("The voltage to apply", styled(plot, 320))


def response_picture(record: Record, responses: Mapping[str, FloatArray]) -> Picture:
    """Return the plot of predicted displacements, less their mean where there are several."""
    several = len(responses) > 1
    middle = np.mean(list(responses.values()), axis=0) if several else np.zeros(record.n)
    shown = {n: y - middle for n, y in responses.items()}
    scale = length_scale(max(float(np.max(np.abs(y))) for y in shown.values()))
    plot = go.Figure()
    for (name, y), colour in zip(shown.items(), _COLOURS * len(shown), strict=False):
        plot.add_scatter(
            x=record.time, y=scale.factor * y, mode="lines", name=plain(name),
            line={"color": colour, "width": 1.4},
        )  # fmt: skip
    plot.update_xaxes(title="time [s]")
    plot.update_yaxes(title=f"displacement [{scale.unit}]")
    caption = "Where the predictions part" if several else "Predicted displacement"
    note = (
        "Each rival's prediction less the mean of all, before it is fitted again; the design"
        " maximises what such a fit leaves."
    )
    return Picture(caption, styled(plot, 340), note if several else "")
