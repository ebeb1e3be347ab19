"""Devices side by side, in sentences and tables."""

from collections.abc import Sequence

from psa_casadi.diagnosis.held_out.shares import Share
from psa_casadi.population.finding import BudgetShare, Finding
from psa_casadi.population.population import Difference, Estimates, differences, display_unit
from psa_casadi.report.words.phrases import (
    Scale,
    either,
    handy_scale,
    listing,
    number,
    percent,
    plain,
)
from psa_casadi.report.words.population_words import p_text
from psa_casadi.report.words.tables import Table
from psa_casadi.report.words.verdict_words import VERDICTS
from psa_casadi.units import convert


def difference_sentence(
    findings: Sequence[Finding], found: Sequence[Difference] | None = None
) -> str:
    """Say which parameters differ beyond noise, and how the verdicts do."""
    rows = differences(findings) if found is None else found
    differing = [d.estimates.name for d in rows if d.differs]
    if not rows:
        sentence = "The files share no parameter that two devices determine."
    elif differing:
        sentence = (
            f"Beyond noise, {listing(differing)} {'differ' if len(differing) > 1 else 'differs'}"
        )
        sentence += f" ({len(rows)} parameters compared)."
    else:
        sentence = f"None of the {len(rows)} parameters differs beyond noise."
    verdicts = {f.verdict for f in findings if f.verdict}
    if len(verdicts) > 1:
        told = [f"{f.device}: {VERDICTS.get(f.verdict, f.verdict)}" for f in findings if f.verdict]
        sentence += f" Verdicts differ ({listing(told)})."
    return sentence


def error_scale(findings: Sequence[Finding]) -> Scale:
    """Return the unit in which the errors of all devices are handy numbers."""
    errors = [f.errors.base for f in findings if f.errors]
    errors += [f.rms_m for f in findings if f.rms_m is not None]
    return handy_scale(max(errors, default=1e-9))


def verdict_table(findings: Sequence[Finding], scale: Scale) -> Table:
    """Return verdict, causes with confidence and errors, one device in a row."""
    head = (
        "device", "verdict", "cause (confidence)", f"base, held out [{scale.unit}]",
        f"extended, held out [{scale.unit}]", f"noise [{scale.unit}]",
        f"fitted, rms [{scale.unit}]", "% of range",
    )  # fmt: skip
    return _without_empty(Table(head, tuple(_verdict_row(f, scale) for f in findings)))


def _verdict_row(f: Finding, scale: Scale) -> tuple[str, ...]:
    e = f.errors
    errors = (
        [number(scale.factor * x) for x in (e.base, e.extended, e.noise)] if e else ["", "", ""]
    )
    share = e.extended_percent if e else f.rms_percent
    return (
        f.device, VERDICTS.get(f.verdict, f.verdict), causes_text(f), *errors,
        "" if f.rms_m is None else number(scale.factor * f.rms_m),
        "" if share is None else number(share, 2),
    )  # fmt: skip


def causes_text(f: Finding) -> str:
    """Return the named causes with their confidence, rivals joined by "or"."""
    told = [f"{either((c.effect, *c.or_else))} ({percent(c.confidence)})" for c in f.causes]
    return listing(told)


def budget_table(findings: Sequence[Finding]) -> Table:
    """Return what each cause removes of the base model's held-out error, one device a column."""
    what = list(dict.fromkeys(s.what for f in findings for s in f.budget))
    diagnosed = [f for f in findings if f.budget]
    rows = [
        (
            plain(w),
            *(_share_text(next((s for s in f.budget if s.what == w), None)) for f in diagnosed),
        )
        for w in what
    ]
    return Table(("removed by", *(f.device for f in diagnosed)), tuple(rows))


def _share_text(s: BudgetShare | None) -> str:
    return "" if s is None else Share(s.what, s.share, s.interval).text


def difference_table(findings: Sequence[Finding], rows: Sequence[Difference]) -> Table:
    """Return the shared parameters with intervals, one device a column, and whether they differ."""
    return Table(
        ("parameter", "unit", *(f.device for f in findings), "p, adjusted", "differ"),
        tuple(
            (
                d.estimates.name,
                display_unit(d.estimates.name, d.estimates.unit),
                *_values(findings, d.estimates),
                p_text(d.p_adjusted),
                "yes" if d.differs else "within noise",
            )
            for d in rows
        ),
    )


def _values(findings: Sequence[Finding], e: Estimates) -> list[str]:
    return [_value(f, e) if k in e.places else "not determined" for k, f in enumerate(findings)]


def _value(f: Finding, e: Estimates) -> str:
    p = f.parameters[e.name]
    shown = display_unit(e.name, e.unit)
    low, high = p.interval or (p.value, p.value)
    texts = [number(float(convert(x, e.unit, shown)), 4) for x in (p.value, low, high)]
    return f"{texts[0]} ({texts[1]} to {texts[2]})"


def file_table(findings: Sequence[Finding]) -> Table:
    """Return the records behind every device."""
    rows = ((f.device, name, sha) for f in findings for name, sha in f.records)
    return Table(("device", "record", "SHA-256"), tuple(rows))


def _without_empty(table: Table) -> Table:
    """Leave out columns in which nothing stands."""
    kept = [k for k in range(len(table.head)) if any(row[k] for row in table.rows)]
    rows = (tuple(row[k] for k in kept) for row in table.rows)
    return Table(tuple(table.head[k] for k in kept), tuple(rows))
