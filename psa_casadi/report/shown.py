"""The views of results: pictures, pages, a notebook's cell, a line."""

import base64
import io
import os
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from psa_casadi.diagnosis.result import Diagnosis, StackDiagnosis
from psa_casadi.documents.files import AnyDiagnosisFile, DiagnosisFile
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.result import Identification
from psa_casadi.model.compose import Model
from psa_casadi.population.population import Finding, Population
from psa_casadi.posterior.sample import Posterior
from psa_casadi.records.signals import Signals
from psa_casadi.report.page.devices import write_comparison, write_population
from psa_casadi.report.page.document import filled
from psa_casadi.report.page.results import write_fit_report, write_posterior, write_report
from psa_casadi.report.plots.figures import Plotted, figure_of, one_output
from psa_casadi.report.words.catalogue import say
from psa_casadi.report.words.tables import parameter_table
from psa_casadi.report.words.text import identification_text, posterior_text, story
from psa_casadi.simulation.simulate import Trajectory

Reported = Diagnosis | Identification | Posterior | Population | Sequence[Finding]


def report(result: Reported, path: str | os.PathLike[str], *, still: bool = False) -> None:
    """Write the page of a result, one HTML file below 3 MB that needs no network.

    The model of a stack runs in the page unless it is to be `still`. Several findings
    (`read_findings`) come side by side.

    Raises:
        InputError: `path` cannot be written to.
    """
    if isinstance(result, Diagnosis):
        write_report(result, path, still=still)
    elif isinstance(result, Identification):
        write_fit_report(result, path, still=still)
    elif isinstance(result, Posterior):
        write_posterior(result, path)
    elif isinstance(result, Population):
        write_population(result, path)
    else:
        write_comparison(result, path)


def plot(result: Plotted, ax: Axes | None = None, output: str | None = None) -> Figure:
    """Return the picture of a result, or of one output of it, as a matplotlib figure.

    Raises InputError for an output that it does not have.
    """
    whole = ax is None and output is None
    return figure_of(result) if whole else one_output(result, ax, output)


#: The sentences of results in one line.
_LINES: tuple[tuple[Any, str], ...] = (
    (StackDiagnosis | DiagnosisFile, "stack_diagnosis"),
    (Diagnosis | AnyDiagnosisFile, "diagnosis"),
    (StackIdentification, "identification"),
    (Posterior, "posterior"),
    (Trajectory, "trajectory"),
)


def line(result: Plotted | AnyDiagnosisFile) -> str:
    """Return a result in one line."""
    code = next((code for kind, code in _LINES if isinstance(result, kind)), None)
    return say(f"line.{code}", r=result) if code else repr(result).partition("\n")[0]


def cell(result: Plotted | Model | AnyDiagnosisFile) -> str:
    """Return a result as a notebook shows it: its words, and its picture or table."""
    if isinstance(result, Model):
        return filled("cell.html", lines=[repr(result)], table=parameter_table(result))
    if isinstance(result, AnyDiagnosisFile):
        return filled("cell.html", lines=[line(result), result.remaining.where, *result.notes])
    buffer = io.BytesIO()
    plot(result).savefig(buffer, format="png", dpi=60)
    picture = base64.b64encode(buffer.getvalue()).decode("ascii")
    if isinstance(result, Signals):
        return filled("cell.html", lines=[repr(result)], name=repr(result), picture=picture)
    if isinstance(result, StackDiagnosis):
        words = story(result)
    elif isinstance(result, StackIdentification):
        words = identification_text(result)
    elif isinstance(result, Posterior):
        words = posterior_text(result)
    else:
        words = line(result) if isinstance(result, Trajectory) else repr(result)
    return filled("cell.html", words=words, name=line(result), picture=picture)
