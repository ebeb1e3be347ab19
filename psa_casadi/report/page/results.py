"""Pages of diagnoses and identifications: what their templates show, the story first."""

import os
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from psa_casadi.common.files import atomic_write
from psa_casadi.diagnosis.held_out import StackBudget
from psa_casadi.diagnosis.misfit import WORTH_SAYING, Misfit
from psa_casadi.diagnosis.remedy import Signature, signature
from psa_casadi.diagnosis.result import Diagnosis, StackDiagnosis
from psa_casadi.identification import grades
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.profile import Profile
from psa_casadi.identification.result import Identification
from psa_casadi.model.component import Component
from psa_casadi.posterior.sample import Posterior
from psa_casadi.report.page.document import Picture, render
from psa_casadi.report.page.live import LiveModel, live_diagnosis, live_fit
from psa_casadi.report.plots import findings
from psa_casadi.report.plots.figures import posterior_figure, record_figure
from psa_casadi.report.words import notes, phrases, tables, text, verdict_words
from psa_casadi.report.words.catalogue import TITLES
from psa_casadi.report.words.phrases import added, lowered, number, plain
from psa_casadi.report.words.remedy_words import what_now
from psa_casadi.report.words.series import (
    Series,
    most_telling,
    residual_figures,
    series_of,
    series_of_fit,
)

#: Samples of all records that may be drawn together: with all their curves about 0.5 MB of text.
_MOST_SAMPLES = 13_000
#: Records that are drawn; of more, those that the model misses most.
MOST_RECORDS = 16
#: Causes whose signatures are drawn, views of residuals, records and sentences that are listed.
_SIGNATURES, _VIEWS, _TOLD_RECORDS, _TOLD = 3, 3, 4, 6
#: Of any model: outputs whose errors are drawn, series with a sentence, effects with bars.
_OUTPUTS, _SERIES, _EFFECTS = 4, 4, 16
#: Views that show nearly the same as another one: of these, and of gain and lag, one is drawn.
_FAMILIES = {"displacement": "voltage", "from_reversal": "since_reversal"}


def write_report(
    diagnosis: Diagnosis,
    path: str | os.PathLike[str],
    *,
    origin: str = "measured",
    still: bool = False,
    model_file: str | None = None,
) -> None:
    """Write the page of a diagnosis, whole or not at all: the story first, then the details.

    `origin`, "measured" or "synthetic", is what the page calls the records; `model_file` is where
    the extended model was written, which the commands of the page read. Unless it is to be
    `still`, the model runs in the page: sliders for its parameters, switches for its effects. The
    page is below 3 MB; where scripts are off it has one still picture.

    Raises InputError when `path` cannot be written to.
    """
    stack = diagnosis if isinstance(diagnosis, StackDiagnosis) else None
    scale = phrases.scale_of(stack.experiments, stack.base_errors.holdout_rms_m) if stack else None
    with phrases.one_unit(scale):
        atomic_write(path, _page(diagnosis, origin, still, model_file))


def write_fit_report(
    identification: Identification,
    path: str | os.PathLike[str],
    *,
    origin: str = "measured",
    profiles: Sequence[Profile] = (),
    still: bool = False,
) -> None:
    """Write the page of an identification, whole or not at all.

    It shows what the records determine, measured and model, and what the residual is.
    `origin`, "measured" or "synthetic", is what the page calls the records; `profiles` follow the
    determinacy. Unless it is to be `still`, the model runs in the page.

    Raises InputError when `path` cannot be written to.
    """
    series = series_of_fit(identification)
    live = None if still else live_fit(identification, series)
    page = fit_page(identification, series, origin=origin, profiles=profiles, live=live)
    atomic_write(path, page)


def _page(d: Diagnosis, origin: str, still: bool, model_file: str | None) -> str:
    series, stack = series_of(d), isinstance(d, StackDiagnosis)
    live = None if still else live_diagnosis(d, series)  # compiles meanwhile
    most, about = (None, "") if stack else (_EFFECTS, f" of {plain(d.model.name)}")
    parts = _of_stack(d) if isinstance(d, StackDiagnosis) else _of_any(d, series)
    return render(
        "diagnosis.html",
        f"Diagnosis{about}: {verdict_words.VERDICTS[d.verdict]}",
        **_shared(d, series, origin),
        **parts,
        d=d,
        stack=stack,
        series=series,
        advice=what_now(d, model_file),
        budget=_budget(d),
        live=live,
        most=most,
        most_records=_TOLD_RECORDS,
        evidence=findings.evidence_plot(d, most),
    )


def _of_any(d: Diagnosis, series: Sequence[Series]) -> dict[str, Any]:
    """Return what the page shows of a model that is no stack."""
    rows = [(s, residual_figures(s, s.curves[0])) for s in series]
    rows.sort(key=lambda row: -row[1].range_share)
    wrong = [
        f"{s.name}: {notes.whiteness_sentence(f, s.curves[0].label, s.time_scale)}"
        for s, f in rows[:_SERIES]
    ]
    captions = [f"{e.output}: error on held-out samples, rms" for e in d.errors]
    errors = [
        (caption, (e.base, e.extended, e.noise), partial(phrases.with_its_unit, unit=e.unit))
        for caption, e in zip(captions[:_OUTPUTS], d.errors, strict=False)
    ]
    return {
        "errors": errors,
        "noise_from": "",
        "wrong": [[[d.base_remaining.where, *wrong]], []],
        **dict.fromkeys(("views", "splits", "signatures"), ()),
    }


def _of_stack(d: StackDiagnosis) -> dict[str, Any]:
    """Return what the page shows of a stack alone."""
    span = max(e.record.range_m for e in d.experiments)
    scale = phrases.scale_of(d.experiments, d.base_errors.holdout_rms_m)
    reach = phrases.handy_scale(span, counts=scale.unit == "counts").text(span)
    sources = phrases.listing(dict.fromkeys(n.source for n in d.noise))
    caption = f"Error on held-out samples, rms; the displacement's range is {reach}"
    rms = d.base_errors.holdout_rms_m, d.extended_errors.holdout_rms_m, d.noise_floor_rms_m
    return {
        "errors": [(caption, rms, scale.text)],
        "noise_from": f" It is estimated from: {sources}." if sources else "",
        "wrong": [
            [m.sentences[:_TOLD] for m in sorted(misfits, key=lambda m: -text.weight(m))]
            for misfits in (d.misfit, d.remainder)
        ],
        "views": [p for m, name in drawn(d.misfit) if (p := _data_view(d, m, name)) is not None],
        "splits": [
            (m.record, table)
            for m in d.misfit[:_TOLD_RECORDS]
            if (table := split_table(m, *_compared(d, m))) is not None
        ],
        "signatures": [s for c in d.causes[:_SIGNATURES] if (s := _signature(d, c.effect))],
    }


def fit_page(
    identification: Identification,
    series: Sequence[Series],
    *,
    origin: str = "measured",
    profiles: Sequence[Profile] = (),
    live: LiveModel | None = None,
) -> str:
    """Return the page; `series` are the records of the identification with the model's curve.

    `live` is the model if it is to run in the page.
    """
    scale = max((s.residual_scale for s in series), key=lambda s: 1.0 / s.factor)
    stack = identification if isinstance(identification, StackIdentification) else None
    with phrases.one_unit(scale if stack else None):
        figures = [residual_figures(s, s.curves[0]) for s in series]
        graded, sizes = grades.grades(identification), dict[str, Any]()
        if stack:
            noise = float(np.sqrt(np.mean([f.noise**2 for f in figures])))
            span = max(e.record.range_m for e in identification.experiments)
            error = notes.error_sentence(identification.fit.rms, noise, span, scale, origin)
            sizes = {"noise": noise, "span": span, "largest": max(f.largest for f in figures)}
        else:
            error = text.fit_sentence(identification)
        return render(
            "fit.html",
            f"Identification of {'a stack' if stack else plain(identification.model.name)}",
            **_shared(identification, series, origin),
            **sizes,
            verdict=f"{error} {notes.determined_sentence(graded)}",
            stack=stack,
            live=live,
            scale=scale,
            graded=graded,
            grades=grades,
            profiles=profiles,
            first_scale=series[0].residual_scale,
            errors=tables.fit_error_table(series, figures),
        )


def write_posterior(posterior: Posterior, path: str | os.PathLike[str]) -> None:
    """Write the page of a posterior, whole or not at all: picture, parameters, what is left.

    Raises InputError when `path` cannot be written to.
    """
    name = plain(posterior.model.name)
    records = phrases.counted(len(posterior.task.experiments), "record")
    verdict = f"The posterior of {name}, from {records}: {text.drawn(posterior)}."
    options = {"posterior": posterior, "verdict": verdict, "figure": posterior_figure(posterior)}
    atomic_write(path, render("posterior.html", f"Posterior of {name}", [records], **options))


def _shared(
    result: Diagnosis | Identification, series: Sequence[Series], origin: str
) -> dict[str, Any]:
    """Return the parts of all pages of results: the worst record, all records, parameters.

    On the page of a fit the former appears only if no script runs.
    """
    identification = result if isinstance(result, Identification) else None
    figures = [residual_figures(s, s.curves[-1]) for s in series]
    order = sorted(range(len(series)), key=lambda k: -figures[k].range_share)
    worst = most_telling(series)
    stack = result if isinstance(result, StackIdentification) else None
    return {
        "badges": [f"{origin} data", phrases.counted(len(result.experiments), "record")],
        "origin": origin,
        "worst": worst,
        "limit": points_each(len(series)),
        "still": record_figure(worst, origin=origin),
        "parts": [
            (s, figures[k], identification is not None or s.name != worst.name)
            for k, s in enumerate(series)
            if k in order[:MOST_RECORDS]
        ],
        "count": len(series),
        "identification": identification,
        "known": grades.determined(result.model, stack),
        "used": tables.record_table(result.experiments, origin),
    }


def points_each(count: int) -> int:
    """Return how many samples of each record may be drawn, so that the page stays below 3 MB."""
    return _MOST_SAMPLES // min(MOST_RECORDS, max(1, count))


def _budget(d: Diagnosis) -> tuple[str | None, Picture | None] | None:
    """Return the excess of a stack, and what the unnamed correction adds; None without either."""
    b, excess, patch = d.budget, None, None
    if isinstance(b, StackBudget):
        if b.excess_rms_m <= 0.0:
            return None
        excess = phrases.scale_of(d.experiments, b.excess_rms_m).text(b.excess_rms_m)
    elif not added(d) and d.patch is None:
        return None
    if d.patch is not None:
        coordinate, plot = findings.correction_plot(d, d.patch)
        patch = Picture(f"Unnamed correction: {d.patch.name}, over {coordinate}", plot)
    return excess, patch


def drawn(misfits: Sequence[Misfit]) -> tuple[tuple[Misfit, str], ...]:
    """Return record and name of the views with the largest shares, one of every family.

    "spectrum" means the lines that are not the drive's.
    """
    rows: list[tuple[float, Misfit, str]] = []
    for m in misfits:
        views = (*m.views, m.holds) if m.holds else m.views
        rows += [(v.share, m, v.name) for v in views if v.significant]
        rows.append((m.spectrum.share, m, "spectrum"))
    best: dict[str, tuple[Misfit, str]] = {}
    for share, m, name in sorted(rows, key=lambda row: -row[0]):
        family = name.removesuffix("_gain").removesuffix("_lag")
        if share > WORTH_SAYING:
            best.setdefault(_FAMILIES.get(family, family), (m, name))
    return tuple(best.values())[:_VIEWS]


def _compared(d: StackDiagnosis, m: Misfit) -> tuple[Misfit | None, bool]:
    """Return what the extended model leaves of the same record, and whether it is in counts."""
    after = next((r for r in d.remainder if r.record == m.record), None) if added(d) else None
    units = {e.record.name: e.record.displacement_unit for e in d.experiments}
    return after, units.get(m.record) == "counts"


def _data_view(d: StackDiagnosis, m: Misfit, name: str) -> Picture | None:
    """Return the picture of one view of a record's residual, None where there is nothing in it."""
    extended, counts = _compared(d, m)
    if name == "spectrum":
        lines = extended.spectrum if extended else None
        plot = findings.spectrum_view_plot(m.spectrum, lines, counts=counts)
        return Picture(f"{m.record}: spectrum of the residual", plot)
    before = findings.view_named(m, name)
    if before is None:
        return None
    after = findings.view_named(extended, name) if extended else None
    plot = findings.view_plot(before, after, counts=counts)
    share = f", {phrases.percent(before.share)} of the excess" if before.significant else ""
    return Picture(f"{m.record}: {lowered(TITLES[before.name])}{share}", plot)


def split_table(before: Misfit, after: Misfit | None, counts: bool) -> tables.Table | None:
    """Return the parts of a residual under a periodic voltage: rms and share of the power."""
    s, t = before.split, after.split if after is not None else None
    if s is None or s.linear + s.even + s.odd <= 0:
        return None
    scale = phrases.length_scale(before.rms, counts=counts)
    total = s.linear + s.even + s.odd + s.noise
    head = ["part", f"base [{scale.unit} rms]", "share of the power"]
    head += [f"extended [{scale.unit} rms]"] if t is not None else []
    rows = []
    for key in ("linear", "even", "odd", "noise"):
        power, *after_it = (float(getattr(part, key)) for part in (s, t) if part is not None)
        base, *extended = (number(scale.factor * float(np.sqrt(p))) for p in (power, *after_it))
        name = "does not repeat" if key == "noise" else key
        rows.append((name, base, phrases.percent(power / total), *extended))
    return tables.Table(tuple(head), tuple(rows))


def _signature(d: StackDiagnosis, name: str) -> tuple[Component, Signature, Any] | None:
    """Return the signature of a cause with the same view of the record that shows most of it."""
    effect = next((c for c in d.model.components if c.name == name), None)
    if effect is None or effect.more_of:  # several modes look as their tones make them look
        return None
    expected = signature(effect)
    return effect, expected, _of_the_data(d, expected.telling.name)


def _of_the_data(d: StackDiagnosis, name: str) -> Picture | None:
    """Return the data's view along the signature's coordinate, or the one that shows most."""

    def share(m: Misfit) -> float:
        view = findings.view_named(m, name)
        return m.spectrum.share if view is None else view.share

    there = [m for m in d.misfit if name == "spectrum" or findings.view_named(m, name) is not None]
    if there:
        best = max(there, key=lambda m: (share(m), m.rms))
        data = _data_view(d, best, name)
        note = "" if share(best) > 0 else "This view alone does not show it for certain."
    else:
        strongest = drawn(d.misfit)
        data = _data_view(d, *strongest[0]) if strongest else None
        axis = TITLES[name].lower()
        note = f"No record has {axis} to compare; this is the view that shows most."
    return None if data is None else Picture(data.caption, data.panel, note)
