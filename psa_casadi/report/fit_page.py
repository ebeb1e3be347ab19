"""An identification as one HTML page."""

import os

from psa_casadi.files import atomic_write
from psa_casadi.identification.identify import Identification
from psa_casadi.report.document import Document
from psa_casadi.report.page import add_record, points_each
from psa_casadi.report.phrases import number
from psa_casadi.report.series import series_of_fit
from psa_casadi.report.tables import parameter_table, record_table


def write_fit_report(
    found: Identification, path: str | os.PathLike[str], *, origin: str = "measured"
) -> None:
    """Write the page of an identification, whole or not at all.

    It shows measured and model, residual, loop, spectrum, and every parameter with its interval.
    `origin`, "measured" or "synthetic", is what the page calls the records. Raises InputError when
    `path` cannot be written to.
    """
    series = series_of_fit(found)
    page = Document("Identification of a stack", origin)
    span = max(e.record.range_m for e in found.experiments)
    page.paragraph(
        f"The model misses the {origin} displacement by"
        f" {series[0].residual_scale.text(found.fit.rms)} rms,"
        f" {number(100.0 * found.fit.rms / span, 2)} % of the largest range.",
        "verdict",
    )
    if found.warnings:
        page.bullets(found.warnings)
    page.heading(f"Record by record: {origin} and model")
    for s in series:
        add_record(page, s, origin, points_each(series))
    page.heading("Parameters")
    page.table(parameter_table(found.model, found))
    for note in found.model.provenance.notes:
        page.paragraph(note, "note")
    page.heading("Records")
    page.table(record_table(found.experiments, origin))
    atomic_write(path, page.text())
