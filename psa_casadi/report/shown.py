"""What results show of themselves: pictures, pages, a notebook's cell, a line."""

import base64
import io
import os
from collections.abc import Callable, Sequence
from html import escape
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from psa_casadi.any_model.identify import OdeIdentification
from psa_casadi.any_model.result import OdeDiagnosis
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.identification.identify import Identification
from psa_casadi.model.compose import Model
from psa_casadi.posterior.sample import Posterior
from psa_casadi.records.record import Record
from psa_casadi.report.documents.diagnosis_file import DiagnosisFile
from psa_casadi.report.documents.own_model_file import OwnModelFile
from psa_casadi.report.page.diagnosis import write_report
from psa_casadi.report.page.fit_page import write_fit_report
from psa_casadi.report.plots.figure import (
    diagnosis_figure,
    fit_figure,
    record_figure,
    trajectory_figure,
)
from psa_casadi.report.plots.one_output import one_output
from psa_casadi.report.plots.posterior_figure import posterior_figure
from psa_casadi.report.words.own_words import own_fit_series, own_series
from psa_casadi.report.words.phrases import number, percent, plain
from psa_casadi.report.words.series import most_telling
from psa_casadi.report.words.tables import Table, parameter_table
from psa_casadi.report.words.text import identification_text, posterior_text, story
from psa_casadi.simulation.simulate import Trajectory

Own = OdeDiagnosis | OdeIdentification
Result = Diagnosis | Identification | Trajectory | Posterior | Own

_FIGURES: dict[type, Callable[[Any], Figure]] = {
    Diagnosis: diagnosis_figure,
    Identification: fit_figure,
    Trajectory: trajectory_figure,
    Posterior: posterior_figure,
    OdeDiagnosis: lambda d: record_figure(most_telling(own_series(d))),
    OdeIdentification: lambda found: record_figure(most_telling(own_fit_series(found))),
    Record: lambda record: one_output(record, None, None),
}


def plot(result: Result | Record, ax: Axes | None = None, output: str | None = None) -> Figure:
    """Return the picture of a result, or of one output of it, as a matplotlib figure.

    Raises InputError for an output that it does not have.
    """
    if ax is None and output is None:
        return _FIGURES[type(result)](result)
    return one_output(result, ax, output)


def page(
    result: Diagnosis | Identification | Own,
    path: str | os.PathLike[str],
    still: bool = False,
) -> None:
    """Write the page of a result, one HTML file. Raises InputError when that cannot be."""
    if isinstance(result, Diagnosis | OdeDiagnosis):
        write_report(result, path, still=still)
    else:
        write_fit_report(result, path, still=still)


def line(result: Result | DiagnosisFile | OwnModelFile) -> str:
    """Return a result in one line."""
    if isinstance(result, OwnModelFile):
        causes = ", ".join(f"{plain(c.effect)} {percent(c.confidence)}" for c in result.causes)
        return f"<Diagnosis of an own model {result.verdict}{': ' if causes else ''}{causes}>"
    if isinstance(result, Own):
        return repr(result).partition("\n")[0]
    if isinstance(result, Diagnosis | DiagnosisFile):
        return _diagnosis_line(result)
    if isinstance(result, Identification):
        records = _count(len(result.experiments), "record")
        span = max(e.record.range_m for e in result.experiments)
        rest = number(100.0 * result.fit.rms / span, 2)
        free = len(result.determinacy.names)
        return f"<Identification: {free} parameters from {records}; residual {rest} % of range rms>"
    if isinstance(result, Posterior):
        names = ", ".join(f.name for f in result.figures)
        return f"<Posterior of {names}: {result.chains} chains of {result.draws} draws>"
    outputs = ", ".join(result.outputs)
    return (
        f"<Trajectory: {len(result.time)} samples from {number(float(result.time[0]))} to"
        f" {number(float(result.time[-1]))} s; outputs {outputs}>"
    )


def _diagnosis_line(d: Diagnosis | DiagnosisFile) -> str:
    causes = ", ".join(f"{plain(c.effect)} {percent(c.confidence)}" for c in d.causes)
    before, after = (e.holdout_nrmse_percent for e in (d.base_errors, d.extended_errors))
    errors = f"{number(after, 2)} % of range rms"
    if before != after:
        errors = f"{number(before, 2)} -> {errors}"
    return f"<Diagnosis {d.verdict}{': ' if causes else ''}{causes}; held-out error {errors}>"


def cell(result: Result | Record | Model | DiagnosisFile | OwnModelFile) -> str:
    """Return a result as a notebook shows it: its words, and its picture or table."""
    if isinstance(result, Model):
        return f"<p>{escape(repr(result))}</p>{_html_table(parameter_table(result))}"
    if isinstance(result, DiagnosisFile | OwnModelFile):
        lines = [line(result), result.remaining.where, *result.notes]
        return "".join(f"<p>{escape(text)}</p>" for text in lines)
    if isinstance(result, Record):
        return f"<p>{escape(repr(result))}</p>{_picture(result, repr(result))}"
    if isinstance(result, Diagnosis):
        words = story(result)
    elif isinstance(result, Identification):
        words = identification_text(result)
    elif isinstance(result, Posterior):
        words = posterior_text(result)
    elif isinstance(result, Own):
        words = repr(result)
    else:
        words = line(result)
    told = f'<pre style="white-space: pre; overflow-x: auto">{escape(words)}</pre>'
    return told + _picture(result, line(result))


def _picture(result: Result | Record, told: str) -> str:
    buffer = io.BytesIO()
    plot(result).savefig(buffer, format="png", dpi=60)
    picture = base64.b64encode(buffer.getvalue()).decode("ascii")
    return (
        f'<img style="max-width: 100%" alt="{escape(told)}" src="data:image/png;base64,{picture}">'
    )


def _html_table(table: Table) -> str:
    def row(cells: Sequence[str], kind: str) -> str:
        return f"<tr>{''.join(f'<{kind}>{escape(c)}</{kind}>' for c in cells)}</tr>"

    rows = "".join(row(cells, "td") for cells in table.rows)
    return f"<table><thead>{row(table.head, 'th')}</thead><tbody>{rows}</tbody></table>"


def _count(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"
