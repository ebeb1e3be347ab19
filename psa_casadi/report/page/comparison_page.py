"""Two or more devices side by side as one HTML page, such as before and after a repair."""

import os
from collections.abc import Sequence

from psa_casadi.errors import InputError
from psa_casadi.files import atomic_write
from psa_casadi.population.finding import Finding
from psa_casadi.population.population import Difference, differences
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.device_plots import budget_plot, difference_plot, error_plots
from psa_casadi.report.words.phrases import number, one_unit
from psa_casadi.report.words.population_words import (
    budget_table,
    causes_text,
    difference_sentence,
    difference_table,
    error_scale,
    file_table,
    verdict_table,
)
from psa_casadi.report.words.verdict_words import VERDICTS

#: More devices than this are a population.
MOST = 20
#: Tiles at the top for so many devices; the table has all.
_MOST_TILES = 4


def write_comparison(findings: Sequence[Finding], path: str | os.PathLike[str]) -> None:
    """Write the page of devices side by side (`read_findings`), whole or not at all.

    It shows verdicts, causes with confidence, error budgets, parameters with intervals and which
    differ beyond noise, and the errors over time and voltage of the records that models carry.

    Raises:
        InputError: there are fewer than two devices or too many, or `path` cannot be written to.
    """
    if len(findings) < 2:
        raise InputError(
            "One device is nothing to compare; give the files of two or more. (A model and a"
            " diagnosis of the same records are one device.)"
        )
    if len(findings) > MOST:
        raise InputError(
            f"{len(findings)} devices have no room side by side; give {MOST} at most, or the folder"
            " of results of `psa batch` for the page of a population."
        )
    with one_unit(error_scale(findings)):
        text = _page(findings)
    atomic_write(path, text)


def _page(findings: Sequence[Finding]) -> str:
    rows = differences(findings)
    page = Document(f"Comparison of {len(findings)} devices", [])
    page.paragraph(difference_sentence(findings, rows), "verdict")
    page.tiles(_tile(f) for f in findings[:_MOST_TILES])
    page.section("Verdicts, causes and errors")
    page.table(verdict_table(findings, error_scale(findings)))
    for f in findings:
        if f.doubt:
            page.paragraph(f"{f.device}: {f.doubt}.", "note")
    if any(f.budget for f in findings):
        page.section("Where the error goes")
        page.paragraph("What each cause removes of the base model's held-out error: shares of its"
                       " power above the noise.")  # fmt: skip
        page.picture(Picture("What each cause removes", budget_plot(findings)))
        page.table(budget_table(findings))
    _parameters(page, findings, rows)
    _errors(page, findings)
    page.section("Records")
    page.table(file_table(findings))
    return page.text()


def _tile(f: Finding) -> tuple[str, str, str]:
    """Return a device with its verdict and cause, or with the error of its fit."""
    if f.verdict:
        return f.device, VERDICTS.get(f.verdict, f.verdict), causes_text(f)
    if f.rms_percent is not None:
        return f.device, f"{number(f.rms_percent, 2)} % of range", "rms of the fit"
    return f.device, "model", ""


def _parameters(page: Document, findings: Sequence[Finding], rows: Sequence[Difference]) -> None:
    page.section("Parameters")
    if not rows:
        page.paragraph("The files share no parameter that two devices determine. A diagnosis alone"
                       " holds those of its causes; its MODEL.json (-o) holds all.")  # fmt: skip
        return
    page.paragraph(
        "A parameter differs where Cochran's Q says that one value for all devices, within the"
        " intervals, is out of the question (p below 0.05, adjusted over the parameters by Holm)."
    )
    if len({f.force_scale for f in findings if f.force_scale}) > 1:
        page.warnings(["The scale of forces is given for some devices and assumed for others:"
                       " forces, stiffnesses and masses cannot be compared."])  # fmt: skip
    note = "Bars are 95 % intervals; * differs beyond noise."
    page.picture(Picture("Parameters against their mean", difference_plot(findings, rows), note))
    page.table(difference_table(findings, rows), {"yes": "bad", "within noise": "quiet"})


def _errors(page: Document, findings: Sequence[Finding]) -> None:
    if not any(f.trace for f in findings):
        return
    page.section("Errors over time and voltage")
    page.paragraph(
        "The first part of a record of each device, as its MODEL.json carries it, less what the"
        " model makes of its voltage."
    )
    over_time, over_voltage, loops = error_plots(findings)
    page.picture(Picture("Error over time", over_time))
    page.pictures([Picture("Error over voltage", over_voltage), Picture("Loops", loops)])
