"""The results as plain text for a terminal."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from psa_casadi.common.errors import InputError
from psa_casadi.common.notes import Note
from psa_casadi.diagnosis.misfit import Misfit
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.diagnosis.result import Cause, Diagnosis, StackDiagnosis
from psa_casadi.export.check.rows import OF_BINARIES
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.result import Identification
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.posterior.sample import Posterior
from psa_casadi.records.signals import in_parts
from psa_casadi.records.split import Experiment
from psa_casadi.report.words import verdict_words
from psa_casadi.report.words.catalogue import say
from psa_casadi.report.words.notes import brief_text
from psa_casadi.report.words.phrases import (
    MOST_NAMES,
    added,
    in_display_unit,
    labelled,
    listing,
    number,
    percent,
    place_of,
    plain,
    probability_text,
    rest_sentence,
    scale_of,
)
from psa_casadi.report.words.remedy_words import effect_advice, effect_size, what_now
from psa_casadi.report.words.tables import Table, blindest, effect_parameter_table, parameter_table

if TYPE_CHECKING:
    from psa_casadi.export.check.check import CheckReport

Lines = Sequence[tuple[str, str]]


def story(
    d: Diagnosis, *, origin: str = "measured", width: int = 100, model_file: str | None = None
) -> str:
    """Return a diagnosis in ten to twenty lines: verdict with gain, errors, cause, what now, rest.

    `origin` is what the records are called, `model_file` where the model was written. Raises
    InputError for what is no diagnosis.
    """
    if not isinstance(d, Diagnosis):
        raise InputError(
            f"`story` describes a diagnosis, and this is of type {type(d).__name__}; print it."
        )
    advice = what_now(d, model_file)
    now = [("what now", text) for text in advice.causes]
    now += [("then", command) for command in advice.commands[:1]]
    lines = _lines(d, origin)
    return labelled([lines[0], *now, *lines[1:]], width)


def diagnosis_text(d: Diagnosis) -> str:
    """Return how a diagnosis of any model prints: its verdict, and its story without advice."""
    return f"{d.verdict}\n{labelled(_lines(d, 'measured'), 100)}"


def _lines(d: Diagnosis, origin: str) -> list[tuple[str, str]]:
    stack = d if isinstance(d, StackDiagnosis) else None
    lines = [
        ("verdict", f"{verdict_words.VERDICTS[d.verdict]}. {verdict_words.verdict_sentence(d)}")
    ]
    wrong = strongest(stack.misfit) if stack else None
    lines += [("wrong", brief_text(wrong))] if wrong else []
    lines.append(("records", _records_text(d.experiments, origin)))
    lines += (
        _displacement_errors(stack)
        if stack
        else [("error", say("fit.output_held_out", e=e, added=added(d))) for e in d.errors]
    )
    for c in d.causes:
        sure = f"{place_of(c)}, {percent(c.confidence)}"
        lines.append(("cause", f"{plain(c.effect)} ({sure}): {verdict_words.cause_size(d, c)}"))
        if kind := verdict_words.family_sentence(c.families):
            lines.append(("kind", kind))
        lines.append(("rivals", _rivals(d, c)))
    if stack:
        columns = [verdict_words.column_sentence(stack, c) for c in stack.columns]
        others = [verdict_words.alternative_sentence(stack, a) for a in stack.alternatives]
        lines += [("column", text) for text in columns] + [("export", f"{t}.") for t in others]
    if d.verdict not in ("adequate", "not_driven"):
        lines.append(("budget", f"{verdict_words.budget_sentence(d)}."))
    if d.families:
        lines.append(("unnamed", f"most like {verdict_words.family_sentence(d.families)}"))
    lines += [] if stack else [("moved", m) for m in d.moved]
    lines.append(("remains", rest_sentence(d)))
    if stack:
        blind = [plain(b.effect) for b in blindest(stack)]
        none = ["no effect of ordinary size in the table"]
        lines.append(("blind to", listing(blind or none, most=MOST_NAMES)))
        lines.append(("next", stack.next_experiment.why))
    firsts = (note.partition(". ") for note in d.notes)
    lines.extend(("note", f"{first}{dot.rstrip()}") for first, dot, _ in firsts)
    return lines


def weight(m: Misfit) -> float:
    """Return the excess over the noise, by which records are compared."""
    return m.excess * (m.rms / m.floor.level if m.floor.level > 0 else 1.0)


def strongest(misfits: Sequence[Misfit]) -> Note | None:
    """Return the finding with the largest excess, None if nothing is above the noise."""
    above_noise = [m for m in misfits if len(m.findings) > 1]
    return max(above_noise, key=weight).findings[1] if above_noise else None


def _displacement_errors(d: StackDiagnosis) -> list[tuple[str, str]]:
    scale = scale_of(d.experiments, d.base_errors.holdout_rms_m)
    sources = listing(list(dict.fromkeys(n.source for n in d.noise)))
    noise = f"{scale.text(d.noise_floor_rms_m)} rms{f', from {sources}' if sources else ''}"
    rows = [("base", d.base_errors), ("extended", d.extended_errors)][: 1 + added(d)]
    errors = [(name, say("fit.held_out", e=e, scale=scale)) for name, e in rows]
    return [("noise", noise), *errors]


def _rivals(d: Diagnosis, cause: Cause) -> str:
    """Return the effects that the data cannot separate from a cause, else the next probable one."""
    known = {c.effect: c.probability for c in d.candidates}
    # the candidates are those of the first step, whose cause may be without a name
    steps = [c.what for c in d.budget.causes]
    first = cause.effect == (steps or [d.causes[0].effect])[0]
    if cause.cannot_be_told_from:
        rivals = [
            f"{plain(n)} ({probability_text(known[n])})" if first and known.get(n) else plain(n)
            for n in cause.cannot_be_told_from
        ]
        return f"these data cannot distinguish it from {listing(rivals, 'or', most=MOST_NAMES)}"
    named = {c.effect for c in d.causes}
    others = [(p, n) for n, p in known.items() if n not in named]
    if not others or not first:
        return "none left open"
    probability, name = max(others)
    return f"none left open; the next is {plain(name)} ({probability_text(probability)})"


def identification_text(
    identification: StackIdentification, *, origin: str = "measured", width: int = 100
) -> str:
    """Return an identification: error, parameters with intervals, warnings, what is left open."""
    scale = scale_of(identification.experiments, identification.fit.rms)
    span = max(e.record.range_m for e in identification.experiments)
    share = number(100.0 * identification.fit.rms / span, 2)
    head = [
        ("records", _records_text(identification.experiments, origin)),
        ("error", f"{scale.text(identification.fit.rms)} rms, {share} % of the largest range"),
    ]
    tail = [("warning", w) for w in identification.warnings]
    tail += [("open", c.sentence) for c in identification.combinations]
    tail += [("next", a.sentence) for a in identification.advice]
    tail += [
        ("note", n) for n in (*identification.sentences, *identification.model.provenance.notes)
    ]
    return _around(head, parameter_table(identification.model, identification), tail, width)


def fit_sentence(identification: Identification) -> str:
    """Say how far a model is from its records."""
    units = {o.name: o.unit or "1" for o in identification.model.structure.outputs}
    return say("fit.outputs", i=identification, units=units)


def effect_page(
    effect: Component, width: int = 100, example: tuple[Model, Sequence[Size]] | None = None
) -> str:
    """Return one effect: what it is, equation, signature, source, what now, parameters.

    `example` is a model that holds it, and how large it is there (`diagnosis.remedy.example`).
    """
    lines = [
        ("what", effect.description),
        ("belongs to", effect.belongs_to),
        ("equation", effect.equation_text),
        ("signature", effect.looks_like),
        ("source", effect.source),
    ]
    lines += [("how large", effect_size(effect, *example))] if example is not None else []
    lines += zip(("what now", "record"), effect_advice(effect), strict=True)
    return f"{effect.name}\n\n{_around(lines, effect_parameter_table(effect), (), width)}"


def check_sentence(report: "CheckReport") -> str:
    """Say how the check of an FMU ended."""
    unseen = [name for name in report.left_out if name in OF_BINARIES]
    fixed = [name for name in report.left_out if name not in OF_BINARIES]
    name = Path(report.path).name
    return say("check.ended", report=report, name=name, fixed=fixed, unseen=unseen)


def _records_text(experiments: Sequence[Experiment], origin: str) -> str:
    """Return the records with their samples, duration and what they are."""
    parts, held_out = [], {id(e.record): int(e.held_out.sum()) for e in experiments}
    for name, records in in_parts(e.record for e in experiments):
        held, lasts = sum(held_out[id(r)] for r in records), sum(r.duration for r in records)
        rest = f", {held} of them held out" if held else ""
        cut = f"{len(records)} parts, " * (len(records) > 1)
        size = f"{cut}{sum(r.n for r in records)} samples in {number(lasts)} s{rest}"
        parts.append(f"{name} ({origin}: {size})")
    return "; ".join(parts)


def posterior_table(posterior: Posterior) -> Table:
    """Return every parameter with mean, sd, 94 % interval, effective draws and r-hat."""
    rows = []
    for f in posterior.figures:
        values = (f.mean, f.low, f.high, f.mean + f.sd)
        unit, (mean, low, high, upper) = in_display_unit(posterior.model, f.name, *values)
        interval = f"{number(low, 4)} to {number(high, 4)}"
        sampling = (unit, f"{f.ess:.0f}", f"{f.r_hat:.3f}")
        meaning = posterior.model.parameter(f.name).description
        rows.append((f.name, number(mean, 4), number(upper - mean), interval, *sampling, meaning))
    head = ("parameter", "mean", "sd", "94 % interval", "unit", "ess", "r-hat", "meaning")
    return Table(head, tuple(rows))


def drawn(posterior: Posterior) -> str:
    """Return how much was drawn."""
    return say("fit.drawn", p=posterior)


def left_table(posterior: Posterior) -> Table:
    """Return the rms that the fit leaves of every output of every record, and how many samples."""
    rows = []
    for b in posterior.task.density.blocks:
        e, channel = posterior.task.experiments[b.record], posterior.task.channel(b)
        samples, gain = str(int(e.at(b.channel).sum())), number(b.correlation_time)
        rows.append((e.record.name, channel.column, number(b.level), channel.unit, samples, gain))
    head = ("record", "output", "rms left", "unit", "samples", "that count as one")
    return Table(head, tuple(rows))


def posterior_text(posterior: Posterior, *, origin: str = "measured", width: int = 100) -> str:
    """Return a posterior: records, chains, the parameters, warnings."""
    head = [
        ("records", _records_text(posterior.task.experiments, origin)),
        ("drawn", drawn(posterior)),
    ]
    tail = [("warning", w) for w in posterior.warnings] + [("note", n) for n in posterior.sentences]
    return _around(head, posterior_table(posterior), tail, width)


def _around(head: Lines, table: Table, tail: Lines, width: int) -> str:
    """Return a table between labelled lines."""
    blocks = (labelled(head, width), table.fitted(width), labelled(tail, width))
    return "\n\n".join(b for b in blocks if b)
