"""The part of a page right below the verdict: what to do now."""

from psa_casadi.any_model.result import OdeDiagnosis
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.report.page.document import Document
from psa_casadi.report.words.remedy_words import what_now


def add_what_now(
    page: Document, d: Diagnosis | OdeDiagnosis, model_file: str | None = None
) -> None:
    """Add what to do about every cause, and the commands to type; see `what_now`."""
    advice = what_now(d, model_file)
    page.advice("What now", (*advice.causes, *advice.beside), advice.commands)
