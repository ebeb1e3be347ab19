"""A diagnosis as one HTML page that works offline, on a phone and on paper."""

import os
from collections.abc import Sequence

from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.files import atomic_write
from psa_casadi.report.document import Document, Picture
from psa_casadi.report.finding_plots import evidence_plot
from psa_casadi.report.phrases import (
    VERDICTS,
    added,
    cause_estimates,
    gain_sentence,
    listing,
    percent,
    plain,
    rest_sentence,
    verdict_sentence,
)
from psa_casadi.report.record_part import add_records
from psa_casadi.report.residuals import residual_figures
from psa_casadi.report.series import Series, series_of
from psa_casadi.report.tables import (
    blind_table,
    candidate_table,
    error_table,
    parameter_table,
    record_table,
)


def write_report(
    diagnosis: Diagnosis, path: str | os.PathLike[str], *, origin: str = "measured"
) -> None:
    """Write the page of a diagnosis, whole or not at all.

    `origin`, "measured" or "synthetic", is what the page calls the records. Raises InputError when
    `path` cannot be written to.
    """
    d = diagnosis
    count = len(d.experiments)
    badges = [f"{origin} data", f"{count} record{'s' if count > 1 else ''}"]
    page = Document(f"Diagnosis: {VERDICTS[d.verdict]}", badges)
    page.paragraph(verdict_sentence(d), "verdict")
    _gain(page, d)
    series = series_of(d)
    _records(page, series, origin)
    _candidates(page, d)
    _causes(page, d)
    _rest(page, d)
    page.section("Parameters of the extended model" if added(d) else "Parameters of the base model")
    page.table(parameter_table(d.model))
    for note in d.notes:
        page.paragraph(note, "note")
    page.section("Records")
    page.table(record_table(d.experiments, origin))
    atomic_write(path, page.text())


def _gain(page: Document, d: Diagnosis) -> None:
    page.section("What is gained")
    sentence = gain_sentence(d) if added(d) else "nothing was added to the base model"
    page.paragraph(f"{sentence[0].upper()}{sentence[1:]}.")
    scale = series_of(d)[0].residual_scale
    page.table(error_table(d, scale.unit, scale.factor))


def _records(page: Document, series: Sequence[Series], origin: str) -> None:
    second = series[0].curves[-1].label if len(series[0].curves) > 1 else ""
    curves = listing([origin, "base model", *([second] if second else [])])
    page.section(f"Record by record: {curves}")
    add_records(page, series, [residual_figures(s, s.curves[-1]) for s in series], origin)


def _candidates(page: Document, d: Diagnosis) -> None:
    page.section("Every effect that was tried")
    note = (
        "Figures: the evidence, and the share of the base model's error above the noise that the"
        " effect explains alone. Blue: named; orange: fitted in full; grey: screened only."
    )
    page.picture(Picture("Evidence for each effect over the base model", evidence_plot(d), note))
    page.table(candidate_table(d))


def _causes(page: Document, d: Diagnosis) -> None:
    if not d.causes:
        return
    page.section("What was named")
    for cause in d.causes:
        page.heading(f"{plain(cause.effect)} ({cause.belongs_to})")
        page.paragraph(
            f"Confidence {percent(cause.confidence)}. "
            f"Size (95 % interval): {'; '.join(cause_estimates(d, cause))}."
        )
        if cause.cannot_be_told_from:
            rivals = listing([plain(n) for n in cause.cannot_be_told_from], "or")
            page.paragraph(f"On these data it cannot be told from {rivals}.")


def _rest(page: Document, d: Diagnosis) -> None:
    page.section("What remains")
    page.paragraph(rest_sentence(d))
    page.section("What these records could not have shown")
    if d.blind_to:
        page.table(blind_table(d))
    else:
        page.paragraph("No effect of the table that is of ordinary size.")
    page.section("Next experiment")
    page.paragraph(d.next_experiment.why)
    if d.next_experiment.voltage_csv:
        page.paragraph(f"Voltage to play: {d.next_experiment.voltage_csv}")
