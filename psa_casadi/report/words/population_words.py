"""Several devices in words: the comparison of two, and a population."""

import math
from collections.abc import Sequence

from psa_casadi.common.units import convert
from psa_casadi.diagnosis.held_out import Share
from psa_casadi.model.variables import NORMAL_95
from psa_casadi.population import population
from psa_casadi.population.population import Finding
from psa_casadi.population.statistics import FEWEST
from psa_casadi.report.words.catalogue import say
from psa_casadi.report.words.phrases import (
    Scale,
    either,
    handy_scale,
    in_brackets,
    listing,
    number,
    percent,
    plain,
    prefixed_scale,
    with_unit,
)
from psa_casadi.report.words.tables import Table
from psa_casadi.report.words.verdict_words import VERDICTS

#: The output of a stack.
_LENGTH = "displacement"
#: Names in a sentence, at most; the table has all.
_MOST_NAMED = 6
METHOD = say("devices.method")


class _ParameterText:
    """A parameter's estimates as text, in the display unit of the parameter."""

    def __init__(self, e: population.Estimates) -> None:
        self.e, self.name, self.unit = e, e.name, population.display_unit(e.name, e.unit)

    def number(self, value: float) -> str:
        """Return a value of the parameter, without its unit."""
        return number(float(convert(value, self.e.unit, self.unit)), 4)

    def value(self, theta: float) -> str:
        """Return a theta with its unit."""
        return with_unit(self.number(self.e.value(theta)), self.unit)

    def interval(self, ends: tuple[float, float]) -> str:
        """Return an interval of theta."""
        return " to ".join(self.number(self.e.value(end)) for end in ends)

    def spread(self, tau: float) -> str:
        """Return a spread: in percent on a logarithmic scale, else in the parameter's unit."""
        if self.e.log:
            return f"{number(100.0 * math.expm1(tau), 2)} %"
        zero, one = (float(convert(v, self.e.unit, self.unit)) for v in (0.0, 1.0))
        return with_unit(number((one - zero) * tau, 2), self.unit)

    def spreads(self, ends: tuple[float, float]) -> str:
        """Return an interval of a spread."""
        return " to ".join(map(self.spread, ends))


def _p(p: float | None) -> str:
    """Return a p value, "" where there is none."""
    if p is None:
        return ""
    return "< 0.001" if p < 1e-3 else number(p, 2)


def population_sentences(p: population.Population) -> tuple[str, ...]:
    """Return the main findings, a sentence each."""
    devices, count = list(dict.fromkeys(o.device for o in p.outliers)), len(p.findings)
    sentences = [say("devices.outliers", devices=devices, count=count, most=_MOST_NAMED)]
    sentences += [say("devices.batches", names=p.batches_differ)] if p.batch_p else []
    sentences += [say("devices.drift", names=p.drifting)] if p.drift_p else []
    sentences += [say("devices.cause", c=c) for c in p.causes[:1]]
    return (*sentences, *missed_sentences(p.findings))


def missed_sentences(findings: Sequence[Finding]) -> tuple[str, ...]:
    """Return which devices' fits miss their records, a sentence; none where no fit does."""
    rows = sorted((-f.noise_ratio, f.device) for f in findings if f.noise_ratio is not None)
    each = [f"{device} ({number(-times, 2)} times the noise)" for times, device in rows]
    return (say("devices.missed", each=each, most=_MOST_NAMED),) if rows else ()


def population_tables(p: population.Population) -> dict[str, Table]:
    """Return the tables of outliers, parameters, batches, drifts, verdicts and causes.

    That is: value, what the others predict, z and adjusted p; mean and spread; the means of batches
    that differ; the change over a year; verdicts and causes with Wilson's interval of their share.
    """
    devices = {f.device: k for k, f in enumerate(p.findings)}
    spreads = {s.estimates.name: s for s in p.spreads}
    outliers, rows, batches, drifts = [], [], [], []
    for o in p.outliers:
        s, place = spreads[o.parameter], devices[o.device]
        finding, text = p.findings[place], _ParameterText(s.estimates)
        mean, half = float(s.common.b[0]), NORMAL_95 * s.common.tau
        theta = float(s.estimates.theta[s.estimates.places.index(place)])
        outliers.append(
            (o.device, finding.batch, finding.day.isoformat() if finding.day else "", o.parameter,
             text.value(theta), text.interval((mean - half, mean + half)), number(o.z, 3),
             _p(o.p_adjusted))
        )  # fmt: skip
    for name, s in spreads.items():
        common, text = s.common, _ParameterText(s.estimates)
        centre = text.value(float(common.b[0])), text.interval(common.interval())
        spread = text.spread(common.tau), text.spreads(common.tau_interval), _p(common.p_value)
        count, outside = len(s.estimates.places), sum(o.parameter == name for o in p.outliers)
        tests = _p(p.batch_p.get(name)), _p(p.drift_p.get(name))
        rows.append((name, str(count), *centre, *spread, str(outside), *tests))
        if s.batches is not None and name in p.batches_differ:
            for b in s.batches.batches:
                centre = text.value(b.mean), text.interval(b.interval)
                differs = text.spread(b.differs_by), _p(b.p_adjusted)
                batches.append((name, b.name, str(b.devices), *centre, *differs))
        if s.drift is not None and name in p.drifting:
            slope = text.spread(s.drift.slope)
            drifts.append((name, slope, text.spreads(s.drift.interval), _p(p.drift_p[name])))
    return {
        "outliers": Table(
            ("device", "batch", "date", "parameter", "value", "the others (95 %)", "z",
             "p, adjusted"), tuple(outliers)),
        "spreads": Table(
            ("parameter", "devices", "mean", "95 % interval", "spread tau", "95 % interval",
             "p, no spread", "stand out", "p, batches", "p, drift"), tuple(rows)),
        "batches": Table(
            ("parameter", "batch", "devices", "mean", "95 % interval", "against the others", "p"),
            tuple(batches)),
        "drifts": Table(("parameter", "change in a year", "95 % interval", "p"), tuple(drifts)),
        "verdict_counts": _counts("verdict", p.verdicts),
        "cause_counts": _counts("cause", p.causes),
    }  # fmt: skip


def _counts(what: str, rows: Sequence[population.Frequency]) -> Table:
    return Table(
        (what, "devices", "share", "95 % interval"),
        tuple(
            (plain(f.what), f"{f.count} of {f.of}", percent(f.count / f.of),
             f"{100.0 * f.interval[0]:.0f} to {percent(f.interval[1])}")
            for f in rows
        ),
    )  # fmt: skip


def left_out_sentence(p: population.Population) -> str:
    """Name the parameters that too few devices determine, "" where there are none."""
    names = p.left_out
    return say("devices.left_out", fewest=FEWEST, names=names) if names else ""


def difference_sentence(findings: Sequence[Finding], rows: Sequence[population.Difference]) -> str:
    """Say which parameters differ beyond noise, how the verdicts do, and which fits miss."""
    names = [d.estimates.name for d in rows]
    differing = [d.estimates.name for d in rows if d.differs]
    sentence = say("devices.differences", names=names, differing=differing)
    if len({f.verdict for f in findings if f.verdict}) > 1:
        named = [f"{f.device}: {VERDICTS.get(f.verdict, f.verdict)}" for f in findings if f.verdict]
        sentence += f" Verdicts differ ({listing(named)})."
    return " ".join((sentence, *missed_sentences(findings)))


def error_scale(findings: Sequence[Finding]) -> Scale:
    """Return the unit in which the errors of all displacements are handy numbers."""
    errors = [e.base for f in findings for e in f.errors if e.output == _LENGTH]
    errors += [f.rms_m for f in findings if f.rms_m is not None]
    return handy_scale(max(errors, default=1e-9))


def verdict_table(findings: Sequence[Finding], scale: Scale) -> Table:
    """Return verdict, causes with confidence and errors, one device in a row."""
    columns: list[tuple[str, ...]] = [
        ("device", *(f.device for f in findings)),
        ("verdict", *(VERDICTS.get(f.verdict, f.verdict) for f in findings)),
        ("cause (confidence)", *(causes_text(f) for f in findings)),
    ]
    for output in dict.fromkeys(e.output for f in findings for e in f.errors):
        errors = [next((e for e in f.errors if e.output == output), None) for f in findings]
        known = [e for e in errors if e is not None]
        unit, name = scale, ""
        if output != _LENGTH:
            unit, name = prefixed_scale(max(e.base for e in known), known[0].unit), f"{output}, "
        for head, part in (
            (f"{name}base, held out", "base"),
            (f"{name}extended, held out", "extended"),
            (f"{name}noise", "noise"),
        ):
            cells = ("" if e is None else number(unit.factor * getattr(e, part)) for e in errors)
            columns.append((in_brackets(head, unit.unit), *cells))
    fitted = ("" if f.rms_m is None else number(scale.factor * f.rms_m) for f in findings)
    columns.append((f"fitted, rms [{scale.unit}]", *fitted))
    shares = (f.errors[0].extended_percent if f.errors else f.rms_percent for f in findings)
    columns.append(("% of range", *("" if s is None else number(s, 2) for s in shares)))
    misfit = ("" if f.noise_ratio is None else number(f.noise_ratio, 2) for f in findings)
    columns.append(("missed, times the noise", *misfit))
    top, *body = zip(*(c for c in columns if any(c[1:])), strict=True)
    return Table(top, tuple(body))


def causes_text(f: Finding) -> str:
    """Return the named causes with their confidence, rivals joined by "or"."""
    texts = [f"{either((c.effect, *c.or_else))} ({percent(c.confidence)})" for c in f.causes]
    return listing(texts)


def budget_table(findings: Sequence[Finding]) -> Table:
    """Return what each cause removes of the base model's held-out error, one device a column."""
    diagnosed = [f for f in findings if f.budget]
    rows = []
    for what in dict.fromkeys(s.what for f in diagnosed for s in f.budget):
        shares = (next((s for s in f.budget if s.what == what), None) for f in diagnosed)
        texts = ("" if s is None else Share(what, s.share, s.interval).text for s in shares)
        rows.append((plain(what), *texts))
    return Table(("removed by", *(f.device for f in diagnosed)), tuple(rows))


def difference_table(findings: Sequence[Finding], rows: Sequence[population.Difference]) -> Table:
    """Return the shared parameters with intervals, one device a column, and whether they differ."""
    body = []
    for d in rows:
        text, cells = _ParameterText(d.estimates), []
        for k, f in enumerate(findings):
            p = f.parameters.get(text.name)
            if p is None or k not in d.estimates.places:
                cells.append("not determined")
                continue
            low, high = map(text.number, p.interval or (p.value, p.value))
            cells.append(f"{text.number(p.value)} ({low} to {high})")
        differ = "yes" if d.differs else "within noise"
        body.append((text.name, text.unit, *cells, _p(d.p_adjusted), differ))
    head = ("parameter", "unit", *(f.device for f in findings), "p, adjusted", "differ")
    return Table(head, tuple(body))


def file_table(findings: Sequence[Finding]) -> Table:
    """Return the records behind every device."""
    rows = ((f.device, name, sha) for f in findings for name, sha in f.records)
    return Table(("device", "record", "SHA-256"), tuple(rows))
