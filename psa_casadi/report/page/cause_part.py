"""The part of a page that says why a cause was named: evidence, signature beside the data."""

from psa_casadi.any_model.result import OdeDiagnosis, PortCause
from psa_casadi.diagnosis.misfit import Misfit
from psa_casadi.diagnosis.result import Cause, Diagnosis
from psa_casadi.diagnosis.signature import Signature, signature
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.misfit_part import data_view, drawn
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.plots.finding_plots import evidence_plot
from psa_casadi.report.plots.signature_figure import size_sentence
from psa_casadi.report.plots.view_plots import signature_plot, view_named
from psa_casadi.report.words.misfit_words import AXES
from psa_casadi.report.words.phrases import either, lowered, percent, plain
from psa_casadi.report.words.verdict_words import alternative_sentence, cause_size

#: Causes whose signatures are drawn.
_DRAWN = 3


def add_evidence(page: Document, d: Diagnosis) -> None:
    """Add the evidence of every effect, and for every cause its signature beside the data."""
    add_evidence_of_all(page, d)
    for cause in d.causes[:_DRAWN]:
        _signature(page, d, cause)


def add_evidence_of_all(
    page: Document, d: Diagnosis | OdeDiagnosis, most: int | None = None
) -> None:
    """Add the evidence of every effect that was tried, or of so many."""
    if d.causes:
        page.section("Why this cause" if len(d.causes) == 1 else "Why these causes")
    else:
        page.section("Every effect that was tried")
    said = (
        "the probability that it is the cause, given that one effect of the table is"
        if d.causes
        else "the share of the base model's error above the noise that it explains alone"
    )
    note = (
        f"Figures: the evidence, and {said}. Blue: named; orange: fitted in full; grey: screened"
        " only."
    )
    if len(d.causes) > 1:
        note += " Alone, a cause may have little evidence that has much beside the others."
    if most is not None and len(d.candidates) > most:
        note += f" {most} of {len(d.candidates)}; the table below has all."
    page.picture(
        Picture("Evidence for each effect over the base model", evidence_plot(d, most), note)
    )


def add_rivals(page: Document, cause: Cause | PortCause) -> None:
    """Say what a named cause cannot be told from, if there is anything."""
    if cause.cannot_be_told_from:
        page.paragraph(
            f"These data cannot distinguish it from {either(cause.cannot_be_told_from)}."
        )


def add_causes(page: Document, d: Diagnosis) -> None:
    """Add the named causes with confidence, size, and what each cannot be told from."""
    if not d.causes:
        return
    page.section("What was named")
    for cause in d.causes:
        page.heading(f"{plain(cause.effect)} ({cause.belongs_to})")
        page.paragraph(
            f"Confidence {percent(cause.confidence)}. "
            f"Found, with 95 % intervals of parameters: {cause_size(d, cause)}."
        )
        add_rivals(page, cause)
        for a in d.alternatives:
            if a.cause == cause.effect:
                said = alternative_sentence(d, a)
                page.paragraph(f"{said[0].upper()}{said[1:]}.")


def _signature(page: Document, d: Diagnosis, cause: Cause) -> None:
    """Add the signature of a cause beside the same view of the record that shows most of it."""
    effect = next((c for c in d.model.components if c.name == cause.effect), None)
    if effect is None or effect.more_of:  # several modes look as their tones make them look
        return
    seen = signature(effect)
    page.heading(f"{plain(effect.name)}, as it looks and as the data look")
    page.paragraph(f"Its signature: {effect.looks_like}.")
    note = size_sentence(seen)
    if seen.telling.name == "holds":
        note += " Counted from the beginning of the hold, in the direction of the last change."
    title = lowered(AXES[seen.telling.name].title)
    caption = f"{plain(effect.name).capitalize()}, simulated: {title}"
    pictures = [Picture(caption, signature_plot(seen), note)]
    data = _of_the_data(d, seen)
    page.pictures([*pictures, data] if data is not None else pictures)


def _of_the_data(d: Diagnosis, seen: Signature) -> Picture | None:
    """Return the data's view along the signature's coordinate, or the one that shows most."""
    name = seen.telling.name
    shown = [m for m in d.misfit if name == "spectrum" or view_named(m, name) is not None]
    if shown:
        best = max(shown, key=lambda m: (_share(m, name), m.rms))
        data = data_view(d, best, name)
        if data is None or _share(best, name) > 0:
            return data
        return Picture(data.caption, data.plot, "This view alone does not show it for certain.")
    strongest = drawn(d.misfit)
    if not strongest:
        return None
    other = data_view(d, *strongest[0])
    title = AXES[name].title.lower()
    note = f"No record has {title} to compare; this is the view that shows most."
    return Picture(other.caption, other.plot, note) if other is not None else None


def _share(m: Misfit, name: str) -> float:
    view = view_named(m, name)
    return m.spectrum.share if name == "spectrum" or view is None else view.share
