"""Models that are no stacks in words: sentences, tables, and series to draw."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from psa_casadi.any_model.result import OdeDiagnosis
from psa_casadi.diagnosis.held_out import Share
from psa_casadi.identification.experiments import varied
from psa_casadi.identification.result import Identification
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment, noise_share
from psa_casadi.report.words import colours, verdict_words
from psa_casadi.report.words.fit_words import determined_sentence, grades
from psa_casadi.report.words.phrases import (
    added,
    either,
    in_brackets,
    labelled,
    listing,
    number,
    percent,
    plain,
    prefixed_scale,
    rest_sentence,
    with_unit,
)
from psa_casadi.report.words.series import Curve, FloatArray, Series
from psa_casadi.report.words.tables import Table

#: Outputs that a sentence names one by one.
_NAMED = 4


def own_verdict_sentence(d: OdeDiagnosis) -> str:
    """Say the verdict in one sentence, with confidence and gain."""
    if d.verdict == "adequate":
        return f"Nothing beyond the noise is missing from the base model; {_base_errors(d)}."
    if d.verdict == "unexplained" or not d.causes:
        free, words = d.correction, ""
        if free is not None:
            words = (
                f"a free function of {free.of} in {free.port} would remove"
                f" {percent(verdict_words.within(free.share))} of the error above the noise; "
            )
        return (
            "Something is missing, and no effect in the table explains it: no cause is named;"
            f" {words}{_base_errors(d)}."
        )
    named = [verdict_words.named_cause(c, c.port) for c in d.causes]
    return verdict_words.naming_sentence(d, named)


def _base_errors(d: OdeDiagnosis) -> str:
    """Say the base model's error in every output, over its range in all records."""
    ranges = {}
    for k, channel in enumerate(d.experiments[0].channels):
        whole = np.concatenate([e.measured(k) for e in d.experiments])
        ranges[channel.column] = float(np.nanmax(whole) - np.nanmin(whole))
    shares = {e.output: 100.0 * e.base / ranges[e.output] for e in d.errors}
    each = [f"{number(share, 2)} %" for share in shares.values()]
    if len(each) == 1:
        return f"the base model's held-out error is {each[0]} of the range"
    if len(each) > _NAMED:
        low, high = (number(f(shares.values()), 2) for f in (min, max))
        return f"the base model's held-out errors are {low} to {high} % of the ranges"
    pairs = [f"{share} of {output}" for output, share in zip(shares, each, strict=True)]
    return f"the base model's held-out errors are {listing(pairs)}, over their ranges"


def own_lines(d: OdeDiagnosis) -> list[tuple[str, str]]:
    """Return the lines of a terminal's story: a label and what is told."""
    lines = [("verdict", f"{verdict_words.VERDICTS[d.verdict]}. {own_verdict_sentence(d)}")]
    lines += [
        ("records", listing([f"{e.record.name} ({e.record.n} samples)" for e in d.experiments]))
    ]
    for e in d.errors:
        shown = [with_its_unit(v, e.unit) for v in (e.base, e.extended, e.noise)]
        extended = f", {shown[1]} of the extended model" if added(d) else ""
        text = f"{e.output}: held-out rms {shown[0]} of the base{extended}; noise {shown[2]}"
        lines.append(("error", text))
    for c, share in zip(d.causes, d.budget.causes, strict=True):
        told = f"{plain(c.effect)} ({c.port}, confidence {percent(c.confidence)})"
        removes = f"it removes {share.text} of the held-out error above the noise"
        lines.append(("cause", f"{told}: {verdict_words.cause_size(d, c)}; {removes}"))
        if c.cannot_be_told_from:
            rivals = either(c.cannot_be_told_from)
            lines.append(("rivals", f"these data cannot distinguish it from {rivals}"))
    lines += [("moved", m) for m in d.moved]
    rest = [("note", n) for n in (*d.notes, d.unnamed) if n]
    return [*lines, ("remains", rest_sentence(d)), *rest]


def own_budget_table(d: OdeDiagnosis) -> Table:
    """Return the shares of the base model's held-out error above the noise, with intervals."""
    b = d.budget
    rows = [verdict_words.share_row(plain(s.what), s) for s in b.causes]
    if len(rows) > 1:
        rows.append(verdict_words.share_row("all causes together", b.together))
    if b.unnamed is not None:
        rows.append(
            verdict_words.share_row(f"unnamed: a free function of {b.unnamed.what}", b.unnamed)
        )
    low, high = b.together.interval
    left = Share("left", 1.0 - b.together.share, (1.0 - high, 1.0 - low))
    rows.append(verdict_words.share_row("remains above the noise", left))
    return Table(("what", "removes", "95 % interval"), tuple(rows))


def own_error_tables(d: OdeDiagnosis, series: Sequence[Series]) -> tuple[Table, Table]:
    """Return noise and held-out rms of the base and of the extended model by output and by record.

    The rms of a record is over its used samples where none is held out.
    """
    outputs = [(e.output, e.unit, e.noise, e.base, e.extended) for e in d.errors]
    records = [
        (s.name, s.unit, s.noise, s.judged_rms(s.curves[0]), s.judged_rms(s.curves[-1]))
        for s in series
    ]
    head = ("unit", "noise rms", "base, held-out rms")
    more = ("extended, held-out rms", "falls by") if d.causes else ()
    tables = []
    for what, given in (("output", outputs), ("record", records)):
        rows = []
        for name, unit, noise, base, extended in given:
            scale = prefixed_scale(base, unit)
            shown = [noise, base, *([extended] if d.causes else [])]
            falls = [f"{100.0 * (1.0 - extended / base):.0f} %"] if d.causes and base > 0 else []
            rows.append((name, scale.unit, *(number(scale.factor * v) for v in shown), *falls))
        tables.append(Table((what, *head, *more), tuple(rows)))
    return tables[0], tables[1]


def own_fit_table(found: Identification, series: Sequence[Series]) -> Table:
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


def own_fit_sentence(found: Identification) -> str:
    """Say how far the model is from its records, and how many parameters these determine."""
    parts = []
    for name, rms in found.rms.items():
        unit = next(o.unit for o in found.model.structure.outputs if o.name == name) or "1"
        noise = found.noise[name]
        ratio = f" ({number(rms / noise, 2)} times its noise)" if noise > 0 else ""
        parts.append(f"{name} by {prefixed_scale(rms, unit).text(rms)}{ratio}")
    return f"The model misses {listing(parts)} rms. {determined_sentence(grades(found))}"


def with_its_unit(value: float, unit: str) -> str:
    """Return a figure of an output with its unit, with a prefix where that has one."""
    scale = prefixed_scale(value, unit or "1")
    return with_unit(number(scale.factor * value), scale.unit or "1")


#: Readings that an output must have in a record to be a series.
_FEWEST = 8


def own_series(d: OdeDiagnosis) -> tuple[Series, ...]:
    """Return every measured output of every record, with the base and the extended model."""
    noise = {e.output: e.noise for e in d.errors}
    curves = [("base model", colours.BASE, d.base)]
    if added(d):
        curves.append(("extended model", colours.EXTENDED, d.extended))
    return tuple(_series(d.model, d.experiments, noise, curves))


def own_fit_series(found: Identification) -> tuple[Series, ...]:
    """Return every measured output of every record, with the fitted model."""
    predicted = found.fit.outputs(found.experiments)
    curves = [("model", colours.EXTENDED, predicted)]
    return tuple(_series(found.model, found.experiments, found.noise, curves))


def _series(
    model: Model,
    experiments: Sequence[Experiment],
    noise: Mapping[str, float],
    curves: Sequence[tuple[str, str, Sequence[FloatArray]]],
) -> Iterator[Series]:
    channels = [(j, c) for j, c in enumerate(experiments[0].channels) if c.column in noise]
    units = {i.name: i.unit for i in model.structure.inputs}
    for i, e in enumerate(experiments):
        record, moving = e.record, varied(model, e)
        along = None if moving is None else record.column(moving)
        for j, channel in channels:
            if np.isfinite(e.measured(j)).sum() < _FEWEST:
                continue
            name = channel.column
            place = model.output_names.index(name)
            yield Series(
                name=record.name if len(noise) == 1 else f"{name} of {record.name}",
                time=record.time - record.time[0],
                voltage=np.zeros(record.n) if along is None else along,
                measured=e.measured(j),
                curves=tuple(Curve(told, c, y[i][:, place]) for told, c, y in curves),
                held_out=e.at(j, e.held_out),
                noise=noise[name] * e.share(j) / noise_share(experiments, j),
                counts=False,
                quantity=name,
                unit=channel.unit or "1",
                against="" if moving is None else in_brackets(moving, units[moving]),
            )


def _identification(found: Identification) -> str:
    """Return the parameters with their standard errors, and what is left of the outputs."""
    model = found.model
    rows = [
        f"  {n} = {model.values[n]:.6g} +- {e:.2g} {model.parameter(n).unit}"
        for n, e in found.errors.items()
    ]
    left = [f"  {n}: {v:.3g} rms left, noise {found.noise[n]:.3g}" for n, v in found.rms.items()]
    said = [f"  {w}" for w in found.warnings]
    return "\n".join([f"identified '{model.name}':", *rows, *left, *said])


def _estimate(value: float, low: float, high: float) -> str:
    """Return a value with its interval, in as many digits as tell them apart, four at least."""
    half = max(high - value, value - low)
    digits = 4
    if 0.0 < half < abs(value):
        digits = max(4, min(9, 1 + math.ceil(math.log10(abs(value) / half))))
    return f"{value:.{digits}g} ({low:.{digits}g} to {high:.{digits}g})"


OWN_MODELS: Mapping[str, str | Callable[..., str]] = {
    "own_diagnosis": lambda d: f"{d.verdict}\n{labelled(own_lines(d), 100)}",
    "own_identification": _identification,
    "moved": lambda name, estimate, without, unit, causes: (
        f"{name} = {with_unit(_estimate(*estimate), unit)}, without the cause{'s' * (causes > 1)}"
        f" {without:.4g}"
    ),
    # the records
    "stairs": (
        "The input '{input}' stands still between jumps in {records}, and each jump is read as a"
        " ramp of one sampling interval; if it is held between samples, as by a digital controller,"
        ' say so of these records: psa.Signals(..., hold="zero").'
    ),
    "no_column": "No record has a column '{output}'; that output is not compared.",
    "no_unit": lambda record, names: (
        f"{record} states no unit of {listing(names)}; the model's are taken."
    ),
    # the fit
    "cut_off": "The fit was cut off before it converged; its values are not final.",
    "one_start": (
        "Of {starts} starts only one led to this minimum; it is the best found, and may not be the"
        " best there is."
    ),
    "on_bound": "'{name}' sits on a bound of its range; its interval means nothing.",
    "output_missed": (
        "'{output}' is missed by {ratio:.2g} times its noise: the model lacks something, so that"
        " the values bend to it, and their errors are too small; psa.diagnose looks for the cause."
    ),
    "output_not_followed": (
        "'{output}' is left with {share:.0p} % of its own movement: see that its column, and those"
        " of the inputs, are in the model's units."
    ),
    # the verdict
    "own_few_held_out": (
        "Only {count} readings are held out, and no model can be judged by fewer than {least}:"
        " nothing is named."
    ),
    "held_out_unlike": (
        "The fitted samples leave no more than noise, but the held-out ones of {output}"
        " {ratio:.1f} times their noise: these records do not say the same, or their inputs are not"
        " read alike (see `hold`)."
    ),
    "free_function": (
        "A free function of {of} in {port} would remove {share:.0%} of what is left above the"
        " noise."
    ),
    "own_withdrawn": lambda names, share, output, why: (
        f"{' and '.join(names)} would remove {f'{share:.0%}' if share > 0 else 'nothing'} of the"
        " held-out error above the noise"
        f"{f' of {output}' if output else ''}; not named, because {why}."
    ),
    "free_beats": "a free function of {of} in {port} explains more ({share:.0%})",
    "own_little": "that is less than {least:.0%} and much remains",
    "slight": (
        "{names: and } together fit better (ln of the Bayes factor higher by {more:.0f}). Not"
        " named, because {small: and } would remove less than {least:.0%} of what the rest does,"
        " and so little may only correct its form."
    ),
}
