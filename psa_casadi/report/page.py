"""A diagnosis as one HTML page that works offline, on a phone and on paper."""

import os
from collections.abc import Sequence

from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.files import atomic_write
from psa_casadi.report.document import Document
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
from psa_casadi.report.plots import evidence_plot, loop_plot, spectrum_plot, time_plot, zoom_plot
from psa_casadi.report.series import Series, series_of
from psa_casadi.report.tables import (
    blind_table,
    candidate_table,
    error_table,
    parameter_table,
    record_table,
)

#: Points that all curves of all records may have together: about 2 MB of text.
_MOST_POINTS = 100_000
#: Points of one record's curve beyond which no screen shows more.
_POINTS = 12_000


def write_report(
    diagnosis: Diagnosis, path: str | os.PathLike[str], *, origin: str = "measured"
) -> None:
    """Write the page of a diagnosis, whole or not at all.

    `origin`, "measured" or "synthetic", is what the page calls the records. Raises InputError when
    `path` cannot be written to.
    """
    d = diagnosis
    page = Document(f"Diagnosis: {VERDICTS[d.verdict]}", origin)
    page.paragraph(verdict_sentence(d), "verdict")
    _gain(page, d)
    series = series_of(d)
    _records(page, series, origin)
    _candidates(page, d)
    _causes(page, d)
    _rest(page, d)
    page.heading("Parameters of the extended model" if added(d) else "Parameters of the base model")
    page.table(parameter_table(d.model))
    for note in d.notes:
        page.paragraph(note, "note")
    page.heading("Records")
    page.table(record_table(d.experiments, origin))
    atomic_write(path, page.text())


def points_each(series: Sequence[Series]) -> int:
    """Return how many points a curve of one record may have."""
    return max(200, min(_POINTS, _MOST_POINTS // (8 * len(series))))


def add_record(page: Document, s: Series, origin: str, limit: int) -> None:
    """Add the pictures of one record: time and residual, loop, spectrum of the residual."""
    page.heading(f"{s.name} ({origin})", 3)
    page.plot(time_plot(s, origin, limit))
    note = "Below, measured minus model; dashed: two standard deviations of the noise."
    page.paragraph(f"{note} Shaded: held out." if s.held_out.any() else note, "note")
    page.heading("Where the difference is largest", 3)
    page.plot(zoom_plot(s, origin))
    page.heading("Loop: displacement over voltage", 3)
    page.plot(loop_plot(s, origin, limit))
    page.heading("Spectrum of the residual", 3)
    page.plot(spectrum_plot(s))
    page.paragraph("Dashed: white noise of the level of the noise floor.", "note")


def _gain(page: Document, d: Diagnosis) -> None:
    page.heading("What is gained")
    sentence = gain_sentence(d) if added(d) else "nothing was added to the base model"
    page.paragraph(f"{sentence[0].upper()}{sentence[1:]}.")
    scale = series_of(d)[0].residual_scale
    page.table(error_table(d, scale.unit, scale.factor))


def _records(page: Document, series: Sequence[Series], origin: str) -> None:
    second = series[0].curves[-1].label if len(series[0].curves) > 1 else ""
    curves = listing([origin, "base model", *([second] if second else [])])
    page.heading(f"Record by record: {curves}")
    for s in series:
        add_record(page, s, origin, points_each(series))


def _candidates(page: Document, d: Diagnosis) -> None:
    page.heading("Every effect that was tried")
    page.plot(evidence_plot(d))
    page.paragraph(
        "Blue: named; orange: fitted in full; grey: screened only. The share is that of the base"
        " model's error above the noise which the effect explains alone.",
        "note",
    )
    page.table(candidate_table(d))


def _causes(page: Document, d: Diagnosis) -> None:
    if not d.causes:
        return
    page.heading("What was named")
    for cause in d.causes:
        page.heading(f"{plain(cause.effect)} ({cause.belongs_to})", 3)
        page.paragraph(
            f"Confidence {percent(cause.confidence)}. "
            f"Size (95 % interval): {'; '.join(cause_estimates(d, cause))}."
        )
        if cause.cannot_be_told_from:
            rivals = listing([plain(n) for n in cause.cannot_be_told_from], "or")
            page.paragraph(f"On these data it cannot be told from {rivals}.")


def _rest(page: Document, d: Diagnosis) -> None:
    page.heading("What remains")
    page.paragraph(rest_sentence(d))
    page.heading("What these records could not have shown")
    if d.blind_to:
        page.table(blind_table(d))
    else:
        page.paragraph("No effect of the table that is of ordinary size.")
    page.heading("Next experiment")
    page.paragraph(d.next_experiment.why)
    if d.next_experiment.voltage_csv:
        page.paragraph(f"Voltage to play: {d.next_experiment.voltage_csv}")
