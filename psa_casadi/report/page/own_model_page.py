"""Diagnosis and identification of a model that is no stack, each as one HTML page."""

import os
from collections.abc import Sequence

from psa_casadi.any_model.identify import OdeIdentification
from psa_casadi.any_model.result import OdeDiagnosis, PortCause
from psa_casadi.component import Component
from psa_casadi.files import atomic_write
from psa_casadi.report.page.blocks import FLOOR, Bar
from psa_casadi.report.page.cause_part import add_evidence_of_all, add_rivals
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.page.parameter_part import add_parameters
from psa_casadi.report.page.record_part import add_records, add_worst
from psa_casadi.report.page.remedy_part import add_what_now
from psa_casadi.report.plots.patch_plot import free_plot
from psa_casadi.report.words.fit_words import whiteness_sentence
from psa_casadi.report.words.own_words import (
    own_budget_table,
    own_error_table,
    own_fit_sentence,
    own_fit_series,
    own_fit_table,
    own_record_table,
    own_series,
    own_verdict_sentence,
    with_its_unit,
)
from psa_casadi.report.words.phrases import added, percent, plain, rest_sentence
from psa_casadi.report.words.series import Series, most_telling, residual_figures
from psa_casadi.report.words.tables import candidate_table, parameter_table, record_table
from psa_casadi.report.words.verdict_words import VERDICTS

#: Outputs whose errors are drawn as bars, series whose residual is told at once, effects with bars.
_DRAWN, _TOLD, _BARS = 4, 4, 16
_ORIGIN = "measured"


def write_own_report(d: OdeDiagnosis, path: str | os.PathLike[str]) -> None:
    """Write the page of a diagnosis, whole or not at all: the story first, then the details.

    Raises InputError when `path` cannot be written to.
    """
    atomic_write(path, _page(d))


def write_own_fit_report(found: OdeIdentification, path: str | os.PathLike[str]) -> None:
    """Write the page of an identification, whole or not at all.

    Raises InputError when `path` cannot be written to.
    """
    atomic_write(path, _fit_page(found))


def _page(d: OdeDiagnosis) -> str:
    series = own_series(d)
    page = Document(f"Diagnosis of {plain(d.model.name)}: {VERDICTS[d.verdict]}", _badges(d.runs))
    page.paragraph(own_verdict_sentence(d), "verdict")
    add_what_now(page, d)
    _add_floors(page, d)
    add_worst(page, series, _ORIGIN)
    _budget(page, d)
    _missed(page, d, series)
    add_evidence_of_all(page, d, _BARS)
    _causes(page, d)
    page.section("What is gained")
    page.table(own_error_table(d))
    if len(d.runs) > 1:
        page.table(own_record_table(d, series))
    page.section("What remains")
    page.paragraph(rest_sentence(d))
    page.section("Details: record by record")
    figures = [residual_figures(s, s.curves[-1]) for s in series]
    add_records(page, series, figures, _ORIGIN, above=most_telling(series).name)
    page.section("Every effect that was tried: figures")
    page.table(candidate_table(d))
    page.section(f"Parameters of the {'extended' if added(d) else 'base'} model")
    add_parameters(page, d.model)
    for note in d.notes:
        page.paragraph(note, "note")
    page.section("Records")
    page.table(record_table(d.runs, _ORIGIN))
    return page.text()


def _badges(runs: Sequence[object]) -> list[str]:
    return [f"{_ORIGIN} data", f"{len(runs)} record{'s' if len(runs) > 1 else ''}"]


def _add_floors(page: Document, d: OdeDiagnosis) -> None:
    """Add the held-out errors of every output as bars over its noise."""
    for e in d.errors[:_DRAWN]:
        models = [("base model", e.base, "--base")]
        models += [("extended model", e.extended, "--extended")] if added(d) else []
        page.bars(
            f"{e.output}: error on held-out samples, rms",
            [Bar(n, v, c, with_its_unit(v, e.unit))
             for n, v, c in (*models, ("noise", e.noise, "--noise"))],
            e.noise,
            FLOOR,
        )  # fmt: skip


def _budget(page: Document, d: OdeDiagnosis) -> None:
    if not (added(d) or d.correction):
        return
    page.section("Where the error goes")
    page.paragraph(
        "Shares are of the power of the base model's held-out error above the noise, outputs"
        " over their noise; each cause's is what the model fitted again without it leaves more."
        " Intervals are taken over held-out records, or over blocks of them if fewer than four."
    )
    page.table(own_budget_table(d))
    free = d.correction
    if free is None:
        return
    page.paragraph(
        "What is missing that no effect of the table describes is best described by a free function"
        f" of {free.of} in {free.port}. It has no name."
    )
    caption = f"Unnamed correction: what it adds to {free.port}, over {free.variable}"
    page.picture(Picture(caption, free_plot(free)))


def _missed(page: Document, d: OdeDiagnosis, series: Sequence[Series]) -> None:
    page.section("What the base model gets wrong")
    page.paragraph(d.missed.where)
    rows = [(s, residual_figures(s, s.curves[0])) for s in series]
    rows.sort(key=lambda row: -row[1].range_share)
    page.bullets(
        f"{s.name}: {whiteness_sentence(f, s.curves[0].label, s.time_scale)}"
        for s, f in rows[:_TOLD]
    )


def _causes(page: Document, d: OdeDiagnosis) -> None:
    """Add the named causes with place, confidence, size, and what each cannot be told from."""
    if not d.causes:
        return
    page.section("What was named")
    for cause, share in zip(d.causes, d.budget.causes, strict=True):
        page.heading(f"{plain(cause.effect)} ({cause.belongs_to})")
        page.paragraph(
            f"Confidence {percent(cause.confidence)}. In {cause.description}. It removes"
            f" {share.text} of the held-out error above the noise."
        )
        _law(page, d, cause)
        page.table(parameter_table(d.model, only=cause.parameters))
        add_rivals(page, cause)
    if d.moved:
        page.heading("What that changes in the base model's parameters")
        page.bullets(d.moved)


def _law(page: Document, d: OdeDiagnosis, cause: PortCause) -> None:
    effect: Component = next(c for c in d.model.components if c.name == cause.effect)
    if effect.equation_text:
        page.paragraph(f"Its law: {effect.equation_text}. What it looks like: {effect.looks_like}.")


def _fit_page(found: OdeIdentification) -> str:
    series = own_fit_series(found)
    page = Document(f"Identification of {plain(found.model.name)}", _badges(found.runs))
    page.paragraph(own_fit_sentence(found), "verdict")
    add_worst(page, series, _ORIGIN)
    page.warnings(found.warnings)
    page.section("Parameters")
    add_parameters(page, found.model)
    if len(found.costs) > 1:
        page.paragraph(f"Of {len(found.costs)} starts {found.agreed} led to this minimum.", "note")
    page.section(f"Record by record: {_ORIGIN} and model")
    page.table(own_fit_table(found, series))
    figures = [residual_figures(s, s.curves[0]) for s in series]
    add_records(page, series, figures, _ORIGIN, above=most_telling(series).name)
    page.section("Where the records come from")
    page.table(record_table(found.runs, _ORIGIN))
    return page.text()
