"""The part of a page that lists parameters: those that the records determine, the others folded."""

from collections.abc import Mapping

from psa_casadi.identification.identify import Identification
from psa_casadi.model.compose import Model
from psa_casadi.report.page.document import Document
from psa_casadi.report.words.fit_words import determined
from psa_casadi.report.words.tables import parameter_table


def add_parameters(
    page: Document,
    model: Model,
    found: Identification | None = None,
    marks: Mapping[str, str] | None = None,
) -> None:
    """Add the parameters of a model; a status that is in `marks` gets that style."""
    known = determined(model, found)
    others = [n for n in model.parameter_names if n not in known]
    if known:
        page.table(parameter_table(model, found, known), marks)
    if others:
        words = f"Not determined by these records, or not fitted ({len(others)})"
        page.table(parameter_table(model, found, others), marks, folded=words if known else "")
