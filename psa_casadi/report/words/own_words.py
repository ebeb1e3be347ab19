"""The diagnosis of a model that is no stack, in sentences and tables."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.any_model.identify import OdeIdentification
from psa_casadi.any_model.result import OdeDiagnosis
from psa_casadi.diagnosis.held_out import Share
from psa_casadi.report.words.budget_words import share_row
from psa_casadi.report.words.phrases import (
    either,
    listing,
    number,
    percent,
    plain,
    prefixed_scale,
    rest_sentence,
    with_unit,
)
from psa_casadi.report.words.series import FloatArray, Series
from psa_casadi.report.words.tables import Table
from psa_casadi.report.words.verdict_words import (
    VERDICTS,
    added,
    cause_size,
    named_cause,
    naming_sentence,
    within,
)

#: Outputs that a sentence names one by one.
_NAMED = 4


def own_verdict_sentence(d: OdeDiagnosis) -> str:
    """Say the verdict in one sentence, with confidence and gain."""
    if d.verdict == "adequate":
        return f"Nothing beyond the noise is missing from the base model; {_base_errors(d)}."
    if d.verdict == "unexplained" or not d.causes:
        free = d.correction
        words = ""
        if free is not None:
            share = percent(within(free.share))
            words = (
                f"a free function of {free.of} in {free.port} would remove {share} of the error"
                " above the noise; "
            )
        return (
            "Something is missing, and no effect in the table explains it: no cause is named;"
            f" {words}{_base_errors(d)}."
        )
    named = [named_cause(c, c.port) for c in d.causes]
    return naming_sentence(d, named)


def _base_errors(d: OdeDiagnosis) -> str:
    spans = _spans(d)
    each = [f"{number(100.0 * e.base / spans[e.output], 2)} %" for e in d.errors]
    if len(each) == 1:
        return f"the base model's held-out error is {each[0]} of the range"
    if len(each) > _NAMED:
        shares = [100.0 * e.base / spans[e.output] for e in d.errors]
        low, high = number(min(shares), 2), number(max(shares), 2)
        return f"the base model's held-out errors are {low} to {high} % of the ranges"
    pairs = [f"{share} of {e.output}" for e, share in zip(d.errors, each, strict=True)]
    return f"the base model's held-out errors are {listing(pairs)}, over their ranges"


def _spans(d: OdeDiagnosis) -> dict[str, float]:
    """Return the range of every output over all records."""
    whole = np.vstack([r.outputs for r in d.runs])
    spans = np.nanmax(whole, axis=0) - np.nanmin(whole, axis=0)
    return dict(zip(d.model.output_names, map(float, spans), strict=True))


def own_lines(d: OdeDiagnosis) -> list[tuple[str, str]]:
    """Return the lines of a terminal's story: a label and what is told."""
    lines = [("verdict", f"{VERDICTS[d.verdict]}. {own_verdict_sentence(d)}")]
    lines += [("records", listing([f"{r.name} ({len(r.time)} samples)" for r in d.runs]))]
    for e in d.errors:
        shown = [with_its_unit(v, e.unit) for v in (e.base, e.extended, e.noise)]
        extended = f", {shown[1]} of the extended model" if added(d) else ""
        text = f"{e.output}: held-out rms {shown[0]} of the base{extended}; noise {shown[2]}"
        lines.append(("error", text))
    for c in d.causes:
        told = f"{plain(c.effect)} ({c.port}, confidence {percent(c.confidence)})"
        lines.append(("cause", f"{told}: {cause_size(d, c)}"))
        if c.cannot_be_told_from:
            rivals = either(c.cannot_be_told_from)
            lines.append(("rivals", f"these data cannot distinguish it from {rivals}"))
    return [*lines, ("remains", rest_sentence(d)), *(("note", n) for n in d.notes)]


def own_budget_table(d: OdeDiagnosis) -> Table:
    """Return the shares of the base model's held-out error above the noise, with intervals."""
    b = d.budget
    rows = [share_row(plain(s.what), s) for s in b.causes]
    if len(rows) > 1:
        rows.append(share_row("all causes together", b.together))
    if b.unnamed is not None:
        rows.append(share_row(f"unnamed: a free function of {b.unnamed.what}", b.unnamed))
    low, high = b.together.interval
    left = Share("left", 1.0 - b.together.share, (1.0 - high, 1.0 - low))
    rows.append(share_row("remains above the noise", left))
    return Table(("what", "removes", "95 % interval"), tuple(rows))


def own_error_table(d: OdeDiagnosis) -> Table:
    """Return noise and held-out rms of every output, of the base and of the extended model."""
    rows = [_errors(e.output, e.unit, e.noise, e.base, e.extended, d) for e in d.errors]
    return _error_table("output", rows, d)


def own_record_table(d: OdeDiagnosis, series: Sequence[Series]) -> Table:
    """Return the same of every record; rms over its used samples where none is held out."""
    rows = []
    for s in series:
        rms = [_judged_rms(s, s.residual(c)) for c in s.curves]
        rows.append(_errors(s.name, s.unit, s.noise, rms[0], rms[-1], d))
    return _error_table("record", rows, d)


def _errors(
    name: str, unit: str, noise: float, base: float, extended: float, d: OdeDiagnosis
) -> tuple[str, ...]:
    scale = prefixed_scale(base, unit)
    shown = [noise, base, *([extended] if d.causes else [])]
    falls = [f"{100.0 * (1.0 - extended / base):.0f} %"] if d.causes and base > 0 else []
    return (name, scale.unit, *(number(scale.factor * v) for v in shown), *falls)


def _error_table(what: str, rows: Sequence[tuple[str, ...]], d: OdeDiagnosis) -> Table:
    head = (what, "unit", "noise rms", "base, held-out rms")
    more = ("extended, held-out rms", "falls by") if d.causes else ()
    return Table((*head, *more), tuple(rows))


def _judged_rms(s: Series, residual: FloatArray) -> float:
    counted = s.held_out if s.held_out.any() else np.isfinite(residual)
    return float(np.sqrt(np.nanmean(residual[counted] ** 2)))


def own_fit_table(found: OdeIdentification, series: Sequence[Series]) -> Table:
    """Return what the model leaves of every record, beside the noise."""
    rows = []
    for s in series:
        scale, residual = s.residual_scale, s.residual(s.curves[0])
        rms = float(np.sqrt(np.nanmean(residual**2)))
        ratio = number(rms / s.noise, 2) if s.noise > 0 else ""
        rows.append(
            (s.name, scale.unit, number(scale.factor * rms), number(scale.factor * s.noise), ratio)
        )
    return Table(("record", "unit", "rms", "noise", "rms / noise"), tuple(rows))


def own_fit_sentence(found: OdeIdentification) -> str:
    """Say how far the model is from its records, and how many parameters these determine."""
    parts = []
    for name, rms in found.rms.items():
        unit = next(o.unit for o in found.model.structure.outputs if o.name == name) or "1"
        noise = found.noise[name]
        ratio = f" ({number(rms / noise, 2)} times its noise)" if noise > 0 else ""
        parts.append(f"{name} by {prefixed_scale(rms, unit).text(rms)}{ratio}")
    count, open_ = len(found.errors), len(found.undetermined)
    told = "all" if not open_ else f"{count - open_} of"
    return (
        f"The model misses {listing(parts)} rms. The records determine {told} {count} fitted"
        f" parameter{'s' if count > 1 else ''}."
    )


def with_its_unit(value: float, unit: str) -> str:
    """Return a figure of an output with its unit, with a prefix where that has one."""
    scale = prefixed_scale(value, unit or "1")
    return with_unit(number(scale.factor * value), scale.unit or "1")
