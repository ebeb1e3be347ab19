"""Several devices in words: the comparison of two, and a population."""

import math
from collections.abc import Sequence

from psa_casadi.diagnosis.held_out import Share
from psa_casadi.population.finding import NORMAL_95, BudgetShare, Finding
from psa_casadi.population.population import (
    Difference,
    Estimates,
    Frequency,
    Outlier,
    Population,
    Spread,
    differences,
    display_unit,
)
from psa_casadi.population.statistics import FEWEST, Batch, MixedFit
from psa_casadi.report.words.phrases import (
    Scale,
    either,
    handy_scale,
    listing,
    number,
    percent,
    plain,
    with_unit,
)
from psa_casadi.report.words.tables import Table
from psa_casadi.report.words.verdict_words import VERDICTS
from psa_casadi.units import convert

#: So many names stand in a sentence; the table has all.
_MOST_NAMED = 6


def p_text(p: float) -> str:
    """Return a p value."""
    return "< 0.001" if p < 1e-3 else number(p, 2)


def value_text(e: Estimates, theta: float, *, unit: bool = True) -> str:
    """Return a theta as a value in the unit that the parameter is shown in."""
    shown = display_unit(e.name, e.unit)
    text = number(float(convert(e.value(theta), e.unit, shown)), 4)
    return with_unit(text, shown) if unit else text


def interval_text(e: Estimates, ends: tuple[float, float]) -> str:
    """Return an interval of theta in the unit that the parameter is shown in."""
    low, high = (value_text(e, end, unit=False) for end in ends)
    return f"{low} to {high}"


def spread_text(e: Estimates, tau: float) -> str:
    """Return a spread: in percent on a logarithmic scale, else in the parameter's unit."""
    if e.log:
        return f"{number(100.0 * math.expm1(tau), 2)} %"
    shown = display_unit(e.name, e.unit)
    factor = float(convert(1.0, e.unit, shown)) - float(convert(0.0, e.unit, shown))
    return with_unit(number(factor * tau, 2), shown)


def population_sentences(p: Population) -> tuple[str, ...]:
    """Return the main findings, a sentence each."""
    devices = list(dict.fromkeys(o.device for o in p.outliers))
    if devices:
        named = listing(devices[:_MOST_NAMED])
        more = f" and {len(devices) - _MOST_NAMED} more" if len(devices) > _MOST_NAMED else ""
        verb = "stands" if len(devices) == 1 else "stand"
        first = f"{len(devices)} of {len(p.findings)} devices {verb} out: {named}{more}."
    else:
        first = f"None of {len(p.findings)} devices stands out beyond noise and spread."
    sentences = [first]
    if p.batch_p:
        sentences.append(
            f"Batches differ in {listing(p.batches_differ)}."
            if p.batches_differ
            else "Batches do not differ beyond the spread of their devices."
        )
    if p.drift_p:
        sentences.append(
            f"Over the date, {listing(p.drifting)} {'drifts' if len(p.drifting) == 1 else 'drift'}."
            if p.drifting
            else "No parameter drifts over the date beyond noise and spread."
        )
    if p.causes:
        c = p.causes[0]
        sentences.append(
            f"The most frequent cause is {plain(c.what)}: {c.count} of {c.of} devices."
        )
    return tuple(sentences)


def outlier_table(p: Population) -> Table:
    """Return the devices that stand out: value, what the others predict, z and adjusted p."""
    return Table(
        ("device", "batch", "date", "parameter", "value", "the others (95 %)", "z", "p, adjusted"),
        tuple(_outlier_row(p, o) for o in p.outliers),
    )


def _outlier_row(p: Population, o: Outlier) -> tuple[str, ...]:
    spread = next(s for s in p.spreads if s.estimates.name == o.parameter)
    e, place = spread.estimates, next(k for k, f in enumerate(p.findings) if f.device == o.device)
    found = p.findings[place]
    theta = float(e.theta[e.places.index(place)])
    return (
        o.device, found.batch, found.day.isoformat() if found.day else "", o.parameter,
        value_text(e, theta), interval_text(e, belonging(spread.common)), number(o.z, 3),
        p_text(o.p_adjusted),
    )  # fmt: skip


def belonging(common: MixedFit) -> tuple[float, float]:
    """Return where 95 % of the devices lie: mean and 1.96 tau to both sides."""
    half = NORMAL_95 * common.tau
    return float(common.b[0]) - half, float(common.b[0]) + half


def spread_table(p: Population) -> Table:
    """Return every parameter over the devices: mean, spread, outliers, batches, drift."""
    return Table(
        (
            "parameter", "devices", "mean", "95 % interval", "spread tau", "95 % interval",
            "p, no spread", "stand out", "p, batches", "p, drift",
        ),
        tuple(_spread_row(p, s) for s in p.spreads),
    )  # fmt: skip


def _spread_row(p: Population, s: Spread) -> tuple[str, ...]:
    e, c = s.estimates, s.common
    low, high = (spread_text(e, t) for t in c.tau_interval)
    return (
        e.name, str(len(e.places)), value_text(e, float(c.b[0])), interval_text(e, c.interval()),
        spread_text(e, c.tau), f"{low} to {high}", p_text(c.p_value),
        str(sum(o.parameter == e.name for o in p.outliers)),
        p_text(p.batch_p[e.name]) if e.name in p.batch_p else "",
        p_text(p.drift_p[e.name]) if e.name in p.drift_p else "",
    )  # fmt: skip


def batch_table(p: Population) -> Table:
    """Return the means of the batches in every parameter in which they differ."""
    rows = []
    for s in p.spreads:
        if s.batches is not None and s.estimates.name in p.batches_differ:
            rows += [_batch_row(s.estimates, b) for b in s.batches.batches]
    return Table(
        ("parameter", "batch", "devices", "mean", "95 % interval", "against the others", "p"),
        tuple(rows),
    )


def _batch_row(e: Estimates, b: Batch) -> tuple[str, ...]:
    differs = (
        f"{number(100.0 * math.expm1(b.differs_by), 2)} %"
        if e.log
        else spread_text(e, b.differs_by)
    )
    return (
        e.name, b.name, str(b.devices), value_text(e, b.mean), interval_text(e, b.interval),
        differs, p_text(b.p_adjusted),
    )  # fmt: skip


def drift_table(p: Population) -> Table:
    """Return the change over a year of the parameters that drift."""
    rows = []
    for s in p.spreads:
        if s.drift is not None and s.estimates.name in p.drifting:
            low, high = (spread_text(s.estimates, end) for end in s.drift.interval)
            rows.append(
                (
                    s.estimates.name, spread_text(s.estimates, s.drift.slope),
                    f"{low} to {high}", p_text(p.drift_p[s.estimates.name]),
                )
            )  # fmt: skip
    return Table(("parameter", "change in a year", "95 % interval", "p"), tuple(rows))


def frequency_table(what: str, rows: Sequence[Frequency]) -> Table:
    """Return how often each was found, with Wilson's interval of its share."""
    return Table(
        (what, "devices", "share", "95 % interval"),
        tuple(
            (
                plain(f.what), f"{f.count} of {f.of}", percent(f.count / f.of),
                f"{100.0 * f.interval[0]:.0f} to {percent(f.interval[1])}",
            )
            for f in rows
        ),
    )  # fmt: skip


METHOD = (
    "Every estimate comes with the interval of its own fit. The spread tau of the devices is what"
    " the estimates scatter beyond that (Paule and Mandel 1982; interval by the Q profile,"
    " Viechtbauer 2007); means have Knapp and Hartung's intervals (2003). A device stands out"
    " where the others, without those that stand out already, do not predict it (leave one out,"
    " Student's t; p values"
    " adjusted over all devices and parameters, Benjamini and Hochberg 1995). Batches are compared"
    " by an F test with the spread within batches; drift is a weighted regression on the date with"
    " tau."
)


def left_out_sentence(p: Population) -> str:
    """Say which parameters too few devices tell, "" where there are none."""
    if not p.left_out:
        return ""
    return f"Told by {FEWEST} devices or fewer, and left out here: {listing(p.left_out)}."


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
