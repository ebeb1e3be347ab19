"""A designed experiment, mechanism or input in sentences and tables."""

from dataclasses import dataclass
from typing import TypeGuard

import numpy as np

from psa_casadi.design.experiment.experiment import ASKED, PLAYS, Informative, Separated
from psa_casadi.design.mechanism.mechanism import MechanismDesign, Reached
from psa_casadi.design.tracking.targets import AmplifierLimits, Response, TrackingError, usage
from psa_casadi.model.compose import Model
from psa_casadi.report.words.phrases import (
    interval_text,
    listing,
    number,
    percent,
    plain,
    probability_text,
    shown_in,
)
from psa_casadi.report.words.tables import Table
from psa_casadi.units import convert

_FAMILIES = {
    "free": "free-form voltage, linear between corners",
    "triangles": "triangles between reversal points",
    "steps": "steps and holds",
    "multisine": "multisine",
    "sine": "sine (no designed voltage was better)",
    "triangle": "triangle (no designed voltage was better)",
}


@dataclass(frozen=True)
class Titled:
    """A table under a title, with a note on how to read it, "" where that is plain."""

    title: str
    table: Table
    note: str = ""


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


def design_tables(design: Separated | Informative, model: Model) -> tuple[Titled, ...]:
    """Return the figures behind the sentences."""
    if isinstance(design, Informative):
        note = "The model's values are taken as true; the sensor's offset and the start are free."
        return (Titled("Predicted intervals", interval_table(design, model), note),)
    note = (
        "Each other effect is fitted again, as far as the data at hand let it; the true one is"
        " taken a standard error weaker than it was fitted."
    )
    growth = Titled("Growth of ln of the Bayes factor", pair_table(design), note)
    return growth, Titled("Probability of being named", chance_table(design))


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


def error_table(rows: list[tuple[str, TrackingError]]) -> Titled:
    """Return errors in percent of the path's range, rms and largest, by who says so."""
    body = tuple((n, number(e.rms_percent), number(e.largest_percent)) for n, e in rows)
    return Titled("Errors", Table(("voltage, judged by", "rms [% of range]", "largest [%]"), body))


def limits_table(response: Response, limits: AmplifierLimits) -> Titled:
    """Return what the response takes of each limit, and the margin that is left."""
    rows = []
    for name, low, high, limit, unit in usage(response, limits):
        used = high if name == "voltage" else max(abs(low), abs(high))
        given = number(limit) if np.isfinite(limit) else "none"
        margin = number(limit - used) if np.isfinite(limit) else ""
        if name == "voltage" and np.isfinite(limits.min_voltage):
            given = f"{number(limits.min_voltage)} to {given if margin else 'any'}"
            margin = number(min(limit - high, low - limits.min_voltage))
        rows.append((f"{name} [{unit}]", number(low), number(high), given, margin))
    head = ("quantity", "least", "largest", "limit", "margin")
    return Titled("Limits and margins", Table(head, tuple(rows)))
