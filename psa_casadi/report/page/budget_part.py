"""The part of a page that says where the error goes, with the unnamed correction's picture."""

from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.patch_plot import patch_plot
from psa_casadi.report.words.phrases import added, scale_of
from psa_casadi.report.words.verdict_words import budget_table, patch_text


def add_budget(page: Document, d: Diagnosis) -> None:
    """Add the error budget, and what the unnamed correction adds."""
    b = d.budget
    if b is None or b.excess_rms_m <= 0.0:
        return
    scale = scale_of(d.experiments, b.excess_rms_m)
    page.section("Where the error goes")
    page.paragraph(
        f"The base model's held-out error above the noise is {scale.text(b.excess_rms_m)} rms."
        " Shares are of its power; each effect's is what the model fitted again without it would"
        " leave more."
    )
    page.table(budget_table(d, scale))
    if d.patch is None:
        return
    beside = "beyond the extended model" if added(d) else "that no effect of the table describes"
    text = patch_text(d.patch)
    page.paragraph(f"What is missing {beside} is best described by {text}. It has no name.")
    coordinate, plot = patch_plot(d, d.patch)
    page.picture(Picture(f"Unnamed correction: {d.patch.name}, over the {coordinate}", plot))
