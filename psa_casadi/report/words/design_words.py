"""A designed experiment, mechanism or input in sentences and tables."""

from dataclasses import dataclass

import numpy as np

from psa_casadi.design.experiment.experiment import CHANCE, PLAYS, Informative, Separated
from psa_casadi.design.mechanism.mechanism import MechanismDesign
from psa_casadi.design.tracking.targets import AmplifierLimits, Response, TrackingError, usage
from psa_casadi.report.words.catalogue import say
from psa_casadi.report.words.phrases import (
    in_display_unit,
    interval_text,
    number,
    plain,
    probability_text,
)
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.start import is_stack


@dataclass(frozen=True)
class Titled:
    """A table under a title, with a note on how to read it, "" where that is plain."""

    title: str
    table: Table
    note: str = ""


def sentences(design: Separated | Informative) -> tuple[str, ...]:
    """Return what the design promises, and what it asks of the amplifier."""
    model = design.rivals[0].model
    capacitance = model.values.get("C_p") if is_stack(model) else None
    promises = _chances(design) if isinstance(design, Separated) else (_narrower(design),)
    record, parts, several = design.record, [], len(design.record.columns) > 1
    for name, values in record.columns.items():
        unit = "" if record.units[name] == "1" else f" {record.units[name]}"
        rate = float(np.max(np.abs(np.diff(values) / np.diff(record.time))))
        ends = {"least": values.min(), "most": values.max(), "rate": rate, "unit": unit}
        current = 1e3 * capacitance * rate if capacitance else None
        parts.append(say("design.column", several=several, name=name, current=current, **ends))
    return *promises, say("design.input", design=design, record=record, parts=parts)


def _chances(design: Separated) -> tuple[str, ...]:
    """Say how surely the record names each effect if it is the cause, and what would be sure."""
    parts = [f"{plain(n)} with {probability_text(p)}" for n, p in design.chance.items()]
    usual = [f"{number(design.factor(n), 2)} times what a {n} gives" for n in design.usual_chance]
    least = min(p.designed for p in design.pairs)
    text = say("design.chances", parts=parts, usual=usual, least=least)
    if design.plays == 1:
        return (text,)
    if design.plays is None:
        return text, say("design.indecisive", chance=CHANCE, most=PLAYS[-1])
    return text, say("design.several_runs", chance=CHANCE, plays=design.plays)


def _narrower(design: Informative) -> str:
    """Say by how much the intervals are narrower than with the usual voltages."""
    parts = [f"{number(f, 2)} times narrower than with a {n}" for n, f in design.factor.items()]
    return say("design.narrower", design=design, parts=parts)


def design_tables(design: Separated | Informative) -> tuple[Titled, ...]:
    """Return the figures behind the sentences."""
    if isinstance(design, Informative):
        note = "The model's values are taken as true; what is not known of the start is free."
        return (Titled("Predicted intervals", _intervals(design), note),)
    usual = list(design.usual_chance)
    pairs = [
        (plain(p.truth), plain(p.other), number(p.designed), *(number(p.usual[n]) for n in usual))
        for p in design.pairs
    ]
    chances = [
        (plain(n), *map(probability_text, (p, *(design.usual_chance[u][n] for u in usual))))
        for n, p in design.chance.items()
    ]
    head = ("if it is", "over", "designed [ln]", *(f"{n} [ln]" for n in usual))
    named = ("if it is", "named after designed", *(f"after {u}" for u in usual))
    return (
        Titled("Growth of ln of the Bayes factor", Table(head, tuple(pairs)), say("design.pairs")),
        Titled("Probability of being named", Table(named, tuple(chances))),
    )


def _intervals(design: Informative) -> Table:
    """Return the predicted 95 % interval of every chosen parameter, before and after."""
    rows, model = [], design.rivals[0].model
    for name, after in design.intervals.items():
        values = (model.values[name], *design.before[name], *after)
        unit, (value, *ends) = in_display_unit(model, name, *values)
        half = 0.5 * (after[1] - after[0]) / max(abs(model.values[name]), 1e-300)
        bounded = half < 10 and after != model.parameter(name).bounds
        width = f"{number(100.0 * half, 2)} %" if bounded else "open"
        intervals = interval_text(*ends[:2]), interval_text(*ends[2:])
        rows.append((name, number(value, 4), unit, *intervals, width))
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
    for name, figure, factor, unit in (
        ("least damping ratio of the mechanics", "damping", 1.0, "1"),
        ("bandwidth of the mechanics", "bandwidth", 1.0, "Hz"),
        ("bandwidth with lag and amplifier", "whole_bandwidth", 1.0, "Hz"),
        ("stroke loss", "stroke_loss", 100.0, "%"),
        ("overshoot in a step of rated voltage", "overshoot", 100.0, "%"),
        ("peak force in the mechanism in that step", "peak_force", 1.0, "N"),
    ):
        free, reached = (number(factor * getattr(r, figure), 4) for r in (d.free, d.reached))
        rows.append((name, free, reached, unit))
    return Table(("", "free stack", "with the mechanism", "unit"), tuple(rows))


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
    """Return the result in sentences: reached or not, the binding limits, the lag's pole."""
    corner, bandwidth = -d.lag_pole / (2.0 * np.pi), d.reached.bandwidth
    tip = [say("design.at_tip")] if d.acts_on == "tip" else []
    lag = say("design.lag", pole=d.lag_pole, corner=corner, bandwidth=bandwidth)
    return say("design.mechanism", d=d), lag, *tip, say("design.agreeing", d=d)


def error_table(rows: list[tuple[str, TrackingError]]) -> Titled:
    """Return errors in percent of the path's range, rms and largest, by source."""
    body = tuple((n, number(e.rms_percent), number(e.largest_percent)) for n, e in rows)
    return Titled("Errors", Table(("voltage, judged by", "rms [% of range]", "largest [%]"), body))


def limits_table(response: Response, limits: AmplifierLimits) -> Titled:
    """Return what the response takes of each limit, and the margin that is left."""
    rows = []
    for name, low, high, limit, unit in usage(response, limits):
        used = high if name == "voltage" else max(abs(low), abs(high))
        text = number(limit) if np.isfinite(limit) else "none"
        margin = number(limit - used) if np.isfinite(limit) else ""
        if name == "voltage" and np.isfinite(limits.min_voltage):
            text = f"{number(limits.min_voltage)} to {text if margin else 'any'}"
            margin = number(min(limit - high, low - limits.min_voltage))
        rows.append((f"{name} [{unit}]", number(low), number(high), text, margin))
    head = ("quantity", "least", "largest", "limit", "margin")
    return Titled("Limits and margins", Table(head, tuple(rows)))
