"""An identification as one HTML page that works offline, on a phone and on paper."""

import os
from collections.abc import Sequence

import numpy as np

from psa_casadi.any_model.identify import OdeIdentification
from psa_casadi.files import atomic_write
from psa_casadi.identification.identify import Identification
from psa_casadi.identification.profile import Profile
from psa_casadi.report.page.document import Document
from psa_casadi.report.page.live_part import LiveModel, add_live, live_fit
from psa_casadi.report.page.own_model_page import write_own_fit_report
from psa_casadi.report.page.packed import Picture
from psa_casadi.report.page.parameter_part import add_parameters
from psa_casadi.report.page.record_part import add_records, add_still
from psa_casadi.report.plots.finding_plots import correlation_plot, determinacy_plot
from psa_casadi.report.plots.profile_plot import profile_plot
from psa_casadi.report.words.advice_words import profile_sentences
from psa_casadi.report.words.fit_words import (
    Grade,
    determined_sentence,
    error_bar_note,
    error_sentence,
    grades,
    named,
    pairs_sentence,
    strong_pairs,
)
from psa_casadi.report.words.phrases import Scale, number, one_unit
from psa_casadi.report.words.series import (
    ResidualFigures,
    Series,
    most_telling,
    residual_figures,
    series_of_fit,
)
from psa_casadi.report.words.tables import (
    fit_error_table,
    record_table,
    starts_table,
)


def write_fit_report(
    found: Identification | OdeIdentification,
    path: str | os.PathLike[str],
    *,
    origin: str = "measured",
    profiles: Sequence[Profile] = (),
    still: bool = False,
) -> None:
    """Write the page of an identification, whole or not at all.

    It shows what the records determine, measured and model, and what the residual is.
    `origin`, "measured" or "synthetic", is what the page calls the records; `profiles` are shown
    beside the determinacy. Unless it is to be `still`, the model runs in the page; that of one's
    own does not.

    Raises InputError when `path` cannot be written to.
    """
    if isinstance(found, OdeIdentification):
        write_own_fit_report(found, path)
        return
    series = series_of_fit(found)
    live = None if still else live_fit(found, series)
    with one_unit(_scale(series)):
        page = fit_page(found, series, origin=origin, profiles=profiles, live=live)
    atomic_write(path, page)


def fit_page(
    found: Identification,
    series: Sequence[Series],
    *,
    origin: str = "measured",
    profiles: Sequence[Profile] = (),
    live: LiveModel | None = None,
) -> str:
    """Return the page; `series` are the records of the identification with the model's curve.

    `live` is the model if it is to run in the page.
    """
    figures = [residual_figures(s, s.curves[0]) for s in series]
    graded = grades(found)
    count = len(series)
    records = f"{count} record{'s' if count > 1 else ''}"
    page = Document("Identification of a stack", [f"{origin} data", records])
    _verdict(page, found, figures, graded, origin, _scale(series))
    add_still(page, most_telling(series), origin)
    if live is not None:
        add_live(page, live)
    _determined(page, found, graded)
    if profiles:
        page.section("Profile likelihoods")
        page.pictures(
            [
                Picture(f"Profile of {p.name}", profile_plot(p), " ".join(profile_sentences(p)))
                for p in profiles
            ]
        )
    _bullets(page, "What these records leave open", [c.sentence for c in found.combinations])
    _bullets(page, "What to measure next", [a.sentence for a in found.advice])
    if found.starts:
        page.section("Starts")
        page.paragraph("Where the search ended from each of its starts.")
        page.table(starts_table(found.starts, _scale(series)), {"another minimum": "weak"})
    page.section("Parameters")
    add_parameters(page, found.model, found, _STATUS_STYLES)
    for note in found.model.provenance.notes:
        page.paragraph(note, "note")
    _records(page, series, figures, origin)
    page.section("Where the records come from")
    page.table(record_table(found.experiments, origin))
    for sentence in found.sentences:
        page.paragraph(sentence, "note")
    return page.text()


_STATUS_STYLES = {
    "fit": "good",
    "read off": "good",
    "fit, weak": "weak",
    "fit, undetermined": "bad",
    "fit, on its bound": "bad",
    "not fitted": "quiet",
}


def _scale(series: Sequence[Series]) -> Scale:
    return max((s.residual_scale for s in series), key=lambda scale: 1.0 / scale.factor)


def _verdict(
    page: Document,
    found: Identification,
    figures: Sequence[ResidualFigures],
    graded: tuple[Grade, ...],
    origin: str,
    scale: Scale,
) -> None:
    rms = found.fit.rms
    span = max(e.record.range_m for e in found.experiments)
    noise = float(np.sqrt(np.mean([f.noise**2 for f in figures])))
    sentence = error_sentence(rms, noise, span, scale, origin)
    page.paragraph(f"{sentence} {determined_sentence(graded)}", "verdict")
    fitted = [g for g in graded if g.degree != "fixed"]
    largest = max(f.largest for f in figures)
    tiles = [
        ("error, rms", scale.text(rms), f"{number(100.0 * rms / span, 2)} % of the range"),
        (
            "error, largest",
            scale.text(largest),
            f"{number(100.0 * largest / span, 2)} % of the range",
        ),
        ("noise, rms", scale.text(noise), "from fast differences"),
    ]
    if fitted:
        count = f"{len(named(graded, 'determined'))} of {len(fitted)}"
        tiles.append(("parameters determined", count, "to 10 % or better"))
    page.tiles(tiles)
    page.warnings(found.warnings)


def _determined(page: Document, found: Identification, graded: tuple[Grade, ...]) -> None:
    if not found.determinacy.names:
        return
    page.section("What the records determine")
    note = error_bar_note(graded)
    pictures = [
        Picture("Relative standard error of each parameter", determinacy_plot(graded), note)
    ]
    if len(found.determinacy.names) > 1:
        words = pairs_sentence(strong_pairs(found))
        pictures.append(Picture("Correlation of the estimates", correlation_plot(found), words))
    page.pictures(pictures)


def _bullets(page: Document, title: str, sentences: Sequence[str]) -> None:
    if sentences:
        page.section(title)
        page.bullets(sentences)


def _records(
    page: Document, series: Sequence[Series], figures: Sequence[ResidualFigures], origin: str
) -> None:
    page.section(f"Record by record: {origin} and model")
    named_figures = [(s.name, f) for s, f in zip(series, figures, strict=True)]
    page.table(fit_error_table(named_figures, _scale(series)))
    add_records(page, series, figures, origin)
