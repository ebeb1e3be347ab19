"""Tables of text that the terminal and the HTML page both show."""

import math
import textwrap
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING

from psa_casadi.diagnosis.result import BlindSpot, Diagnosis, StackDiagnosis
from psa_casadi.identification.grades import grade
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.result import Identification, StartOutcome
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.stacks import Stack, stack_model
from psa_casadi.records.split import Experiment
from psa_casadi.report.words.catalogue import say
from psa_casadi.report.words.phrases import (
    Scale,
    added,
    in_brackets,
    in_display_unit,
    interval_text,
    number,
    percent,
    plain,
    prefixed_scale,
    probability_text,
    with_unit,
)
from psa_casadi.report.words.series import ResidualFigures, Series
from psa_casadi.simulation.timings import Stage

if TYPE_CHECKING:
    from psa_casadi.export.check.check import CheckReport


@dataclass(frozen=True)
class Table:
    """A head and rows of text, every row as long as the head."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def __str__(self) -> str:
        """Return the table in columns of plain text, without spaces at line ends."""
        return self.fitted()

    def fitted(self, width: float = math.inf) -> str:
        """Return the table in columns of plain text whose lines have `width` characters at most.

        Cells go on in further lines where their column is narrower. `laid_out` decides which way
        the table lies.
        """
        return self.laid_out(width)._lines(width)

    def laid_out(self, width: float, between: int = 2) -> "Table":
        """Return the table, or with rows for columns where only so its words are whole.

        `width` is the room in characters, of which `between` lie between two columns.
        """
        columns = tuple(zip(self.head, *self.rows, strict=True))
        turned = Table(columns[0], columns[1:]) if columns else self
        if self._least(between) <= width or turned._least(between) > width:
            return self
        return turned

    def _least(self, between: int) -> int:
        """Return the width in which every word is whole."""
        columns = zip(self.head, *self.rows, strict=True)
        words = (max(map(len, " ".join(column).split()), default=0) for column in columns)
        return sum(words) + between * (len(self.head) - 1)

    def _lines(self, width: float) -> str:
        widths = self.widths(width - 2 * (len(self.head) - 1))
        lines: list[str] = []
        for row in (self.head, tuple("-" * w for w in widths), *self.rows):
            cells = (
                textwrap.wrap(cell, max(w, 1), break_on_hyphens=False)
                for cell, w in zip(row, widths, strict=True)
            )
            for line in zip_longest(*cells, fillvalue=""):
                padded = (part.ljust(w) for part, w in zip(line, widths, strict=True))
                lines.append("  ".join(padded).rstrip())
        return "\n".join(lines)

    def widths(self, room: float) -> list[int]:
        """Return the characters of each column, which have `room` together.

        The widest columns are made narrower. One becomes narrower than its longest word only where
        no other way is left.
        """
        columns = list(zip(self.head, *self.rows, strict=True))
        widths = [max(map(len, column)) for column in columns]
        least = [max(map(len, " ".join(column).split()), default=0) for column in columns]
        while sum(widths) > room and max(widths) > 1:
            spare = [w if w > n else 0 for w, n in zip(widths, least, strict=True)]
            widest = spare if any(spare) else widths
            widths[widest.index(max(widest))] -= 1
        return widths


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    return Table(tuple(head), tuple(tuple(row) for row in rows))


def parameter_table(
    model: Model, identification: Identification | None = None, only: Collection[str] | None = None
) -> Table:
    """Return every parameter with value, 95 % interval, unit, source, and meaning.

    With `only` those that it names.
    """
    rows = []
    for p in (p for p in model.structure.parameters if only is None or p.name in only):
        interval = model.provenance.intervals.get(p.name)
        known = (interval.low, interval.high) if interval else ()
        unit, (value, *ends) = in_display_unit(model, p.name, model.values[p.name], *known)
        text, status = interval_text(*ends) if ends else "", _status(model, p.name, identification)
        rows.append((p.name, number(value, 4), text, unit, status, p.description))
    return _table(("parameter", "value", "95 % interval", "unit", "found by", "meaning"), rows)


def _status(model: Model, name: str, identification: Identification | None) -> str:
    if isinstance(identification, StackIdentification) and name in identification.read_off:
        return "read off"
    if name not in model.provenance.free:
        return "current" if name in model.provenance.intervals else "not fitted"
    degree = grade(identification, name).degree if identification is not None else "determined"
    return "fit" if degree in ("determined", "fixed") else f"fit, {degree}"


def candidate_table(d: Diagnosis) -> Table:
    """Return every effect tried: evidence, share of the excess, and probability if one is named."""
    head = ["effect", "evidence over the base [ln]", "explains of the excess, alone"]
    named = {c.effect for c in d.causes} if len(d.causes) > 1 else set()
    shares = {c.what: c for c in d.budget.causes if c.what in named}
    rows = [
        [plain(c.effect), number(round(c.evidence, 6)),
         say("verdict.share", c=c, others=shares.get(c.effect))]
        for c in d.candidates
    ]  # fmt: skip
    if added(d):
        head.append("probability" if len(d.causes) < 2 else "probability as the first cause")
        for row, c in zip(rows, d.candidates, strict=True):
            row.append(probability_text(c.probability))
    return _table(head, rows)


def error_table(d: Diagnosis, scale: Scale) -> Table:
    """Return the errors of base and extended model, and the noise.

    Of a stack they are lengths in the unit of the scale, else those of every output in its unit.
    """
    if not isinstance(d, StackDiagnosis):
        rows = [(e.output, e.unit, e.noise, e.base, e.extended) for e in d.errors]
        return _falls("output", rows, added(d))
    unit, factor = scale.unit, scale.factor
    lines = []
    models = [("base", d.base_errors), ("extended", d.extended_errors)]
    for name, e in models if added(d) else models[:1]:
        lengths = (e.train_rms_m, e.holdout_rms_m, e.holdout_max_m)
        figures = (number(factor * v) for v in lengths)
        lines.append((name, *figures, number(e.holdout_nrmse_percent)))
    noise = number(factor * d.noise_floor_rms_m)
    lines.append(("noise", noise, noise, "", ""))
    head = (f"training rms [{unit}]", f"held-out rms [{unit}]", f"held-out largest [{unit}]")
    return _table(("model", *head, "held-out rms [% of range]"), lines)


def record_error_table(series: Sequence[Series]) -> Table:
    """Return noise and held-out rms of the first and the last curve by record.

    The rms of a record is over its used samples where none is held out.
    """
    rows = [
        (s.name, s.unit, s.noise, s.judged_rms(s.curves[0]), s.judged_rms(s.curves[-1]))
        for s in series
    ]
    return _falls("record", rows, len(series[0].curves) > 1)


def _falls(
    what: str, inputs: Iterable[tuple[str, str, float, float, float]], extended: bool
) -> Table:
    """Return rows of a name, unit, noise and two errors, and by how much the error falls."""
    head = (what, "unit", "noise rms", "base, held-out rms")
    rows = []
    for name, unit, noise, base, after in inputs:
        scale = prefixed_scale(base, unit)
        figures = [noise, base, *([after] if extended else [])]
        falls = [f"{100.0 * (1.0 - after / base):.0f} %"] if extended and base > 0 else []
        rows.append((name, scale.unit, *(number(scale.factor * v) for v in figures), *falls))
    return _table((*head, *(("extended, held-out rms", "falls by") if extended else ())), rows)


def column_table(d: StackDiagnosis) -> Table:
    """Return what base and extended model miss of every further column, and its noise."""
    rows = []
    for c in d.columns:
        errors = (c.noise, c.base_rms, c.extended_rms if added(d) else None)
        figures = ("" if e is None else number(e) for e in errors)
        rows.append((c.column, c.role, c.unit, *figures))
    head = ("noise rms", "base, held-out rms", "extended, held-out rms")
    return _table(("column", "used as", "unit", *head), rows)


def fit_error_table(series: Sequence[Series], figures: Sequence[ResidualFigures]) -> Table:
    """Return what the model leaves of every record, and the record's noise level.

    Each quantity has its unit, that of its largest error.
    """
    scales = {s.quantity: s.residual_scale for s in sorted(series, key=lambda s: -s.miss(0))}
    for s in series:
        scales[s.quantity] = max(scales[s.quantity], s.residual_scale, key=lambda q: 1.0 / q.factor)
    one = next(iter(scales.values())).unit if len(scales) == 1 else ""
    lines = []
    for s, f in zip(series, figures, strict=True):
        scale = scales[s.quantity]
        sizes = (number(scale.factor * v) for v in (f.rms, f.largest, f.noise))
        ratio = number(f.rms / f.noise, 2) if f.noise > 0 else ""
        others = (ratio, number(100.0 * f.range_share, 2), number(f.neighbours, 2))
        lines.append((s.name, *(() if one else (scale.unit,)), *sizes, *others))
    lengths = [in_brackets(what, one) for what in ("rms", "largest", "noise")]
    others = ("rms / noise", "rms [% of range]", "correlation of neighbours")
    return _table(("record", *(() if one else ("unit",)), *lengths, *others), lines)


def starts_table(starts: Iterable[StartOutcome], scale: Scale) -> Table:
    """Return where the fits from several starts ended."""
    ends = {True: "the best fit", False: "another minimum", None: "not followed to its end"}
    rows = [
        (s.name, number(s.cost, 5), number(scale.factor * s.rms, 4), ends[s.agrees]) for s in starts
    ]
    return _table(("start", "cost", f"rms [{scale.unit}]", "led to"), rows)


def record_table(experiments: "Sequence[Experiment]", origin: str) -> Table:
    """Return the records with their size, how they were used, and their SHA-256."""
    rows = []
    for e in experiments:
        record = e.record
        counts = (str(int(part.sum())) for part in (e.used, e.held_out))
        rows.append((record.name, origin, number(record.duration), *counts, record.sha256))
    return _table(
        ("record", "origin", "duration [s]", "samples fitted", "samples held out", "SHA-256"), rows
    )


def blindest(d: StackDiagnosis) -> tuple[BlindSpot, ...]:
    """Return the blind spots, the largest detectable gain over its ordinary size first."""

    def excess(spot: BlindSpot) -> float:
        effect = EFFECTS.get(spot.effect)
        if effect is None or effect.gain is None:
            return 0.0
        extended = d.model.with_effect(effect)
        ordinary = extended.parameter(effect.gain).typical({**extended.values, effect.gain: 0.0})
        return spot.smallest_detectable_gain / ordinary

    return tuple(sorted(d.blind_to, key=excess, reverse=True))


def blind_table(d: StackDiagnosis) -> Table:
    """Return the effects of practical size that the records could not have revealed."""
    rows = []
    for b in blindest(d):
        # a screening without any direction for the effect reports the largest number there is
        detectable = b.smallest_detectable_gain < 1e100
        size = with_unit(number(b.smallest_detectable_gain), b.unit) if detectable else "at no size"
        rows.append((plain(b.effect), size, b.why))
    return _table(("effect", "shows from", "why"), rows)


def effects_table(effects: Iterable[Component]) -> Table:
    """Return the effects with where they belong and what an engineer sees."""
    rows = [(e.name, e.belongs_to, e.description, e.looks_like) for e in effects]
    return _table(("effect", "belongs to", "what it is", "expected signature"), rows)


def effect_parameter_table(effect: Component) -> Table:
    """Return the parameters of one effect with unit, bounds and meaning; the gain is marked."""
    rows = []
    for p in effect.parameters:
        bounds = f"{number(p.bounds[0])} to {number(p.bounds[1])}"
        note = " (0 removes the effect)" if p.name == effect.gain else ""
        rows.append((p.name, p.unit, number(p.value), bounds, p.description + note))
    return _table(("parameter", "unit", "default", "bounds", "meaning"), rows)


def stacks_table(stacks: Iterable[Stack]) -> Table:
    """Return the named stacks with rated voltage and how many of their figures are assumed."""
    rows = []
    for s in stacks:
        assumed = f"{len(s.assumed)} of {len(s.values)}"
        rows.append((s.name, number(s.values["u_rated"].value), assumed, s.description))
    return _table(("stack", "rated voltage [V]", "assumed figures", "what it is"), rows)


def stack_table(stack: Stack) -> Table:
    """Return every figure of a stack with its unit, whether it is assumed, and its source."""
    model = stack_model(stack.name)
    rows = []
    for name in model.parameter_names:
        figure = stack.values[name]
        unit, (value,) = in_display_unit(model, name, figure.value)
        assumed = "assumed" if figure.assumed else ""
        rows.append((name, number(value, 6), unit, assumed, figure.source))
    return _table(("parameter", "value", "unit", "", "source"), rows)


def check_table(report: "CheckReport") -> Table:
    """Return the checks of an FMU with figure, limit and result."""
    rows = []
    for r in report.rows:
        # where none is allowed it counts problems
        counted = r.limit == 0 and r.figure >= 0
        figure = str(int(r.figure)) if counted else number(r.figure)
        result = "note" if r.noted else "pass" if r.passed else "FAIL"
        rows.append((r.name, figure, number(r.limit), result, r.remark, r.clause))
    head = ("check", "found", "allowed", "result", "remark", "clause")
    if report.foreign:
        return _table((*head[:1], *head[3:]), [(row[0], *row[3:]) for row in rows])
    return _table(head[:-1], [row[:-1] for row in rows])


def timings_table(stages: Sequence[Stage]) -> Table:
    """Return time, processor time of all threads with its share, and simulations of every stage.

    The last column counts the simulations with sensitivities.
    """
    figures = ((s.wall, s.processor, s.runs, s.differentiated) for s in stages)
    total = Stage("total", *map(sum, zip(*figures, strict=True)))
    rows = []
    for s in (*stages, total):
        share = percent(s.processor / total.processor) if total.processor > 0 else ""
        runs = (str(s.runs), str(s.differentiated)) if s.runs else ("", "")
        rows.append((s.name, f"{s.wall:.2f} s", f"{s.processor:.2f} s", share, *runs))
    head = ("stage", "time", "processor", "share", "simulations", "with sensitivities")
    return _table(head, rows)
