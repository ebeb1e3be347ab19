"""The views of results: pictures, pages, a notebook's cell, a line."""

import base64
import io
import os
from collections.abc import Sequence

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
from psa_casadi.report.words.phrases import counted, number, percent, plain
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


def line(result: Plotted | AnyDiagnosisFile) -> str:
    """Return a result in one line."""
    if isinstance(result, Diagnosis | AnyDiagnosisFile):
        return _diagnosis(result)
    if isinstance(result, StackIdentification):
        records = counted(len(result.experiments), "record")
        span = max(e.record.range_m for e in result.experiments)
        rest = number(100.0 * result.fit.rms / span, 2)
        free = len(result.determinacy.names)
        return f"<Identification: {free} parameters from {records}; residual {rest} % of range rms>"
    if isinstance(result, Identification | Signals):
        return repr(result).partition("\n")[0]
    if isinstance(result, Posterior):
        names = ", ".join(f.name for f in result.figures)
        return f"<Posterior of {names}: {result.chains} chains of {result.draws} draws>"
    ends = " to ".join(number(float(result.time[k])) for k in (0, -1))
    outputs = ", ".join(result.outputs)
    return f"<Trajectory: {len(result.time)} samples from {ends} s; outputs {outputs}>"


def _diagnosis(d: Diagnosis | AnyDiagnosisFile) -> str:
    named = ", ".join(f"{plain(c.effect)} {percent(c.confidence)}" for c in d.causes)
    causes = f": {named}" if named else ""
    if not isinstance(d, StackDiagnosis | DiagnosisFile):
        return f"<Diagnosis of an own model {d.verdict}{causes}>"
    before, after = (e.holdout_nrmse_percent for e in (d.base_errors, d.extended_errors))
    first = f"{number(before, 2)} -> " if before != after else ""
    errors = f"{first}{number(after, 2)} % of range rms"
    return f"<Diagnosis {d.verdict}{causes}; held-out error {errors}>"


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
