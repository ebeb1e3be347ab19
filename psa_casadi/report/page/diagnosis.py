"""A diagnosis as one HTML page that works offline, on a phone and on paper."""

import os
from collections.abc import Sequence

from psa_casadi.any_model.result import OdeDiagnosis
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.files import atomic_write
from psa_casadi.report.page.blocks import FLOOR, Bar
from psa_casadi.report.page.budget_part import add_budget
from psa_casadi.report.page.cause_part import add_causes, add_evidence
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.live_part import add_live, live_diagnosis
from psa_casadi.report.page.misfit_part import add_misfit, add_remainder
from psa_casadi.report.page.own_model_page import write_own_report
from psa_casadi.report.page.parameter_part import add_parameters
from psa_casadi.report.page.record_part import add_records, add_worst
from psa_casadi.report.page.remedy_part import add_what_now
from psa_casadi.report.words.phrases import (
    added,
    handy_scale,
    listing,
    one_unit,
    rest_sentence,
    scale_of,
)
from psa_casadi.report.words.series import Series, most_telling, residual_figures, series_of
from psa_casadi.report.words.tables import (
    blind_table,
    candidate_table,
    column_table,
    error_table,
    record_table,
)
from psa_casadi.report.words.verdict_words import (
    OWN_VOLTAGES,
    VERDICTS,
    gain_sentence,
    verdict_sentence,
)


def write_report(
    diagnosis: Diagnosis | OdeDiagnosis,
    path: str | os.PathLike[str],
    *,
    origin: str = "measured",
    still: bool = False,
    model_file: str | None = None,
) -> None:
    """Write the page of a diagnosis, whole or not at all: the story first, then the details.

    `origin`, "measured" or "synthetic", is what the page calls the records; `model_file` is where
    the extended model was written, which the commands of the page read. Unless it is to be
    `still`, the model runs in the page: sliders for its parameters, switches for its effects. The
    page is below 3 MB; where scripts are off it has one still picture. That of a model of one's
    own holds no model that runs.

    Raises InputError when `path` cannot be written to.
    """
    if isinstance(diagnosis, OdeDiagnosis):
        write_own_report(diagnosis, path)
        return
    d, series = diagnosis, series_of(diagnosis)
    live = None if still else live_diagnosis(d, series)  # compiles beside what follows
    page = Document(f"Diagnosis: {VERDICTS[d.verdict]}", _badges(d, origin))
    with one_unit(scale_of(d.experiments, d.base_errors.holdout_rms_m)):
        page.paragraph(verdict_sentence(d), "verdict")
        add_what_now(page, d, model_file)
        _add_floor(page, d)
        page.bullets(_answers(d))
        add_worst(page, series, origin)
        add_budget(page, d)
        if live is not None:
            add_live(page, live)
        add_misfit(page, d)
        add_evidence(page, d)
        add_causes(page, d)
        _columns(page, d)
        _gain(page, d)
        _rest(page, d)
        _details(page, d, series, origin)
        text = page.text()
    atomic_write(path, text)


def _badges(d: Diagnosis, origin: str) -> list[str]:
    count = len(d.experiments)
    return [f"{origin} data", f"{count} record{'s' if count > 1 else ''}"]


def _answers(d: Diagnosis) -> list[str]:
    """Return what remains and what to do next, in a sentence each."""
    told = (("Remains", rest_sentence(d)), ("Next", d.next_experiment.why))
    return [f"{label}: {text}" for label, text in told if text]


def _add_floor(page: Document, d: Diagnosis) -> None:
    """Add the held-out errors as bars over the noise, which no model can go below."""
    scale = scale_of(d.experiments, d.base_errors.holdout_rms_m)
    models = [("base model", "--base", d.base_errors.holdout_rms_m)]
    if added(d):
        models.append(("extended model", "--extended", d.extended_errors.holdout_rms_m))
    rows = [Bar(name, rms, colour, scale.text(rms)) for name, colour, rms in models]
    noise = d.noise_floor_rms_m
    rows.append(Bar("noise", noise, "--noise", scale.text(noise)))
    span = max(e.record.range_m for e in d.experiments)
    text = handy_scale(span, counts=scale.unit == "counts").text(span)
    sources = listing(list(dict.fromkeys(n.source for n in d.noise)))
    found = f" It is estimated from: {sources}." if sources else ""
    page.bars(
        f"Error on held-out samples, rms; the displacement's range is {text}",
        rows,
        noise,
        f"{FLOOR}{found}",
    )


def _columns(page: Document, d: Diagnosis) -> None:
    if d.columns:
        page.section("What the further columns decided")
        page.bullets(c.sentence for c in d.columns)
        page.table(column_table(d))


def _gain(page: Document, d: Diagnosis) -> None:
    page.section("What is gained")
    sentence = gain_sentence(d) if added(d) else "nothing was added to the base model"
    page.paragraph(f"{sentence[0].upper()}{sentence[1:]}.")
    if added(d) and not d.gain.held_out_records:
        page.paragraph(OWN_VOLTAGES)
    scale = series_of(d)[0].residual_scale
    page.table(error_table(d, scale.unit, scale.factor))


def _rest(page: Document, d: Diagnosis) -> None:
    page.section("What remains")
    page.paragraph(rest_sentence(d))
    add_remainder(page, d)
    page.section("What these records could not have shown")
    if d.blind_to:
        page.table(blind_table(d))
    else:
        page.paragraph("No effect of the table that is of ordinary size.")
    page.section("Next experiment")
    page.paragraph(d.next_experiment.why)
    if d.next_experiment.voltage_csv:
        page.paragraph(f"Voltage to apply: {d.next_experiment.voltage_csv}")


def _details(page: Document, d: Diagnosis, series: Sequence[Series], origin: str) -> None:
    page.section("Details: record by record")
    figures = [residual_figures(s, s.curves[-1]) for s in series]
    add_records(page, series, figures, origin, above=most_telling(series).name)
    page.section("Every effect that was tried: figures")
    page.table(candidate_table(d))
    which = "extended" if added(d) else "base"
    page.section(f"Parameters of the {which} model")
    add_parameters(page, d.model)
    for note in d.notes:
        page.paragraph(note, "note")
    if d.noise:
        page.section("Noise")
        page.bullets(n.sentence for n in d.noise)
    page.section("Records")
    page.table(record_table(d.experiments, origin))
