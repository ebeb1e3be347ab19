"""Pages of diagnoses and identifications: what their templates show, the story first."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from psa_casadi.any_model.identify import OdeIdentification
from psa_casadi.any_model.result import OdeDiagnosis, PortCause
from psa_casadi.component import Component
from psa_casadi.diagnosis.misfit import WORTH_SAYING, Misfit
from psa_casadi.diagnosis.result import Cause, Diagnosis
from psa_casadi.diagnosis.signature import Signature, signature
from psa_casadi.files import atomic_write
from psa_casadi.identification.identify import Identification
from psa_casadi.identification.profile import Profile
from psa_casadi.model.compose import Model
from psa_casadi.report.page.document import Picture, render
from psa_casadi.report.page.live import LiveModel, live_diagnosis, live_fit
from psa_casadi.report.plots.figures import record_figure, size_sentence
from psa_casadi.report.plots.findings import (
    correlation_plot,
    determinacy_plot,
    evidence_plot,
    free_plot,
    patch_plot,
    profile_plot,
    signature_plot,
    spectrum_view_plot,
    view_named,
    view_plot,
)
from psa_casadi.report.plots.records import (
    autocorrelation_plot,
    distribution_plot,
    error_loop_plot,
    loop_plot,
    samples,
    spectrum_plot,
    time_plot,
    zoom_plot,
)
from psa_casadi.report.words.advice_words import profile_sentences
from psa_casadi.report.words.fit_words import (
    Grade,
    determined,
    determined_sentence,
    error_bar_note,
    error_sentence,
    grades,
    named,
    pairs_sentence,
    residual_sentence,
    strong_pairs,
    whiteness_sentence,
)
from psa_casadi.report.words.misfit_words import AXES, weight
from psa_casadi.report.words.own_words import (
    own_budget_table,
    own_error_table,
    own_fit_sentence,
    own_fit_series,
    own_fit_table,
    own_record_table,
    own_series,
    own_verdict_sentence,
    with_its_unit,
)
from psa_casadi.report.words.phrases import (
    Scale,
    added,
    either,
    handy_scale,
    length_scale,
    listing,
    lowered,
    number,
    one_unit,
    percent,
    plain,
    rest_sentence,
    scale_of,
)
from psa_casadi.report.words.remedy_words import what_now
from psa_casadi.report.words.series import (
    ResidualFigures,
    Series,
    most_telling,
    residual_figures,
    series_of,
    series_of_fit,
)
from psa_casadi.report.words.tables import (
    Table,
    blind_table,
    candidate_table,
    column_table,
    error_table,
    fit_error_table,
    parameter_table,
    record_table,
    starts_table,
)
from psa_casadi.report.words.verdict_words import (
    OWN_VOLTAGES,
    VERDICTS,
    alternative_sentence,
    budget_table,
    cause_size,
    gain_sentence,
    patch_text,
    verdict_sentence,
)

#: Samples of all records that may be drawn together: with all their curves about 0.5 MB of text.
_MOST_SAMPLES = 13_000
#: Records that are drawn; of more, those that the model misses most.
MOST_RECORDS = 16
#: Causes whose signatures are drawn, views of residuals, records and sentences that are listed.
_SIGNATURES, _VIEWS, _TOLD_RECORDS, _TOLD = 3, 3, 4, 6
#: Of an own model: outputs whose errors are drawn, series that are told, effects with bars.
_OWN_OUTPUTS, _OWN_SERIES, _OWN_EFFECTS = 4, 4, 16
#: Views that say much the same: one of each family is drawn.
_FAMILIES = {
    "displacement": "voltage",
    "since_reversal": "reversal",
    "since_reversal_lag": "reversal",
    "from_reversal": "reversal",
    "amplitude_gain": "amplitude",
    "amplitude_lag": "amplitude",
    "frequency_gain": "frequency",
    "frequency_lag": "frequency",
}
_STATUSES = {
    "fit": "good",
    "read off": "good",
    "fit, weak": "weak",
    "fit, undetermined": "bad",
    "fit, on its bound": "bad",
    "not fitted": "quiet",
}


def write_report(
    diagnosis: Diagnosis | OdeDiagnosis,
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
    page is below 3 MB; where scripts are off it has one still picture. That of a model of one's
    own holds no model that runs.

    Raises InputError when `path` cannot be written to.
    """
    if isinstance(diagnosis, OdeDiagnosis):
        atomic_write(path, _own_page(diagnosis))
        return
    with one_unit(scale_of(diagnosis.experiments, diagnosis.base_errors.holdout_rms_m)):
        page = _diagnosis_page(diagnosis, origin, still, model_file)
    atomic_write(path, page)


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
        atomic_write(path, _own_fit_page(found))
        return
    series = series_of_fit(found)
    live = None if still else live_fit(found, series)
    page = fit_page(found, series, origin=origin, profiles=profiles, live=live)
    atomic_write(path, page)


def _diagnosis_page(d: Diagnosis, origin: str, still: bool, model_file: str | None) -> str:
    series = series_of(d)
    live = None if still else live_diagnosis(d, series)  # compiles beside what follows
    scale = scale_of(d.experiments, d.base_errors.holdout_rms_m)
    span = max(e.record.range_m for e in d.experiments)
    answers = (("Remains", rest_sentence(d)), ("Next", d.next_experiment.why))
    gained = gain_sentence(d) if added(d) else "nothing was added to the base model"
    residuals = series[0].residual_scale
    return render(
        "diagnosis.html",
        f"Diagnosis: {VERDICTS[d.verdict]}",
        _badges(origin, len(series)),
        d=d,
        origin=origin,
        added=added(d),
        verdict=verdict_sentence(d),
        advice=what_now(d, model_file),
        range=handy_scale(span, counts=scale.unit == "counts").text(span),
        errors=_errors(d, scale),
        noise=d.noise_floor_rms_m,
        sources=listing(list(dict.fromkeys(n.source for n in d.noise))),
        answers=[f"{label}: {text}" for label, text in answers if text],
        worst=_worst(series, origin),
        **_budget(d),
        live=live,
        sentences=_sentences,
        most_records=_TOLD_RECORDS,
        views=[p for m, name in drawn(d.misfit) if (p := _data_view(d, m, name)) is not None],
        splits=_splits(d),
        evidence=evidence_plot(d),
        signatures=[s for cause in d.causes[:_SIGNATURES] if (s := _signature(d, cause))],
        causes=[_cause(d, cause) for cause in d.causes],
        decided=[c.sentence for c in d.columns],
        columns=column_table(d),
        gained=f"{gained[0].upper()}{gained[1:]}.",
        own_voltages=OWN_VOLTAGES if added(d) and not d.gain.held_out_records else "",
        gain=error_table(d, residuals.unit, residuals.factor),
        rest=rest_sentence(d),
        blind=blind_table(d),
        next=d.next_experiment.why,
        parts=_parts(
            series, [residual_figures(s, s.curves[-1]) for s in series], origin, once=True
        ),
        candidates=candidate_table(d),
        parameters=_parameters(d.model),
        noises=[n.sentence for n in d.noise],
        used=record_table(d.experiments, origin),
    )


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
    scale = max((s.residual_scale for s in series), key=lambda s: 1.0 / s.factor)
    with one_unit(scale):
        figures = [residual_figures(s, s.curves[0]) for s in series]
        graded = grades(found)
        noise = float(np.sqrt(np.mean([f.noise**2 for f in figures])))
        span = max(e.record.range_m for e in found.experiments)
        error = error_sentence(found.fit.rms, noise, span, scale, origin)
        shown = most_telling(series)
        return render(
            "fit.html",
            "Identification of a stack",
            _badges(origin, len(series)),
            found=found,
            origin=origin,
            verdict=f"{error} {determined_sentence(graded)}",
            tiles=_tiles(found.fit.rms, noise, span, scale, figures, graded),
            still={"figure": record_figure(shown, origin=origin), "name": shown.name},
            live=live,
            determined=_determined(found, graded),
            profiles=[
                Picture(f"Profile of {p.name}", profile_plot(p), " ".join(profile_sentences(p)))
                for p in profiles
            ],
            left_open=[c.sentence for c in found.combinations],
            advice=[a.sentence for a in found.advice],
            starts=starts_table(found.starts, scale),
            parameters=_parameters(found.model, found),
            statuses=_STATUSES,
            errors=fit_error_table(
                [(s.name, f) for s, f in zip(series, figures, strict=True)], scale
            ),
            parts=_parts(series, figures, origin),
            count=len(series),
            used=record_table(found.experiments, origin),
        )


def _own_page(d: OdeDiagnosis) -> str:
    series, origin = own_series(d), "measured"
    rows = [(s, residual_figures(s, s.curves[0])) for s in series]
    rows.sort(key=lambda row: -row[1].range_share)
    told = bool(added(d) or d.correction)
    return render(
        "own_diagnosis.html",
        f"Diagnosis of {plain(d.model.name)}: {VERDICTS[d.verdict]}",
        _badges(origin, len(d.runs)),
        d=d,
        origin=origin,
        added=added(d),
        verdict=own_verdict_sentence(d),
        advice=what_now(d),
        errors=_own_errors(d),
        worst=_worst(series, origin),
        budget=own_budget_table(d) if told else None,
        free=_free(d),
        missed=d.missed.where,
        wrong=[
            f"{s.name}: {whiteness_sentence(f, s.curves[0].label, s.time_scale)}"
            for s, f in rows[:_OWN_SERIES]
        ],
        evidence=evidence_plot(d, _OWN_EFFECTS),
        most=_OWN_EFFECTS,
        causes=_own_causes(d),
        moved=d.moved,
        gain=own_error_table(d),
        by_record=own_record_table(d, series),
        rest=rest_sentence(d),
        parts=_parts(
            series, [residual_figures(s, s.curves[-1]) for s in series], origin, once=True
        ),
        count=len(series),
        candidates=candidate_table(d),
        parameters=_parameters(d.model),
        used=record_table(d.runs, origin),
    )


def _own_fit_page(found: OdeIdentification) -> str:
    series, origin = own_fit_series(found), "measured"
    figures = [residual_figures(s, s.curves[0]) for s in series]
    return render(
        "own_fit.html",
        f"Identification of {plain(found.model.name)}",
        _badges(origin, len(found.runs)),
        found=found,
        origin=origin,
        verdict=own_fit_sentence(found),
        worst=_worst(series, origin),
        parameters=_parameters(found.model),
        errors=own_fit_table(found, series),
        parts=_parts(series, figures, origin, once=True),
        count=len(series),
        used=record_table(found.runs, origin),
    )


def _badges(origin: str, records: int) -> list[str]:
    return [f"{origin} data", f"{records} record{'s' if records > 1 else ''}"]


# Parameters and records, as all four pages show them


def _parameters(model: Model, found: Identification | None = None) -> dict[str, Table | None]:
    """Return the parameters that the records determine, and the others, as tables."""
    known = determined(model, found)
    others = [n for n in model.parameter_names if n not in known]
    return {
        "known": parameter_table(model, found, known) if known else None,
        "others": parameter_table(model, found, others) if others else None,
    }


@dataclass(frozen=True)
class _Worst:
    """The record that the first model misses most, for paper and for the screen."""

    name: str
    figure: Figure
    picture: Picture


def _worst(series: Sequence[Series], origin: str) -> _Worst:
    s = most_telling(series)
    curves = listing([origin, *(c.label for c in s.curves)])
    noise = "Below: the residual; dashed: two standard deviations of the noise."
    shaded = " Shaded: held out." if s.held_out.any() else ""
    plot = time_plot(s, origin, points_each(len(series)))
    picture = Picture(f"{s.name}: {curves}", plot, f"{noise}{shaded}")
    return _Worst(s.name, record_figure(s, origin=origin), picture)


@dataclass(frozen=True)
class _Part:
    """A record; `over_time` is None where the page shows that already."""

    name: str
    title: str
    sentence: str
    over_time: Picture | None
    views: list[Picture]


def points_each(records: int) -> int:
    """Return how many samples of each record may be drawn, so that the page stays below 3 MB."""
    return _MOST_SAMPLES // min(MOST_RECORDS, max(1, records))


def _parts(
    series: Sequence[Series], figures: Sequence[ResidualFigures], origin: str, *, once: bool = False
) -> list[_Part]:
    """Return what is shown of the records; `figures` are those of the last curve's residuals.

    `once` says that the page shows the record that is missed most over time already.
    """
    order = sorted(range(len(figures)), key=lambda k: -figures[k].range_share)
    shown = sorted(order[:MOST_RECORDS])
    limit, above = points_each(len(shown)), most_telling(series).name if once else ""
    return [_part(series[k], figures[k], origin, limit, series[k].name != above) for k in shown]


def _part(s: Series, figures: ResidualFigures, origin: str, limit: int, time: bool) -> _Part:
    shaded = " Shaded: held out." if s.held_out.any() else ""
    noise = "Dashed: two standard deviations of the noise."
    driver = s.against.partition(" [")[0]
    over_it = [
        Picture(f"Loop: {s.quantity} over {driver}", loop_plot(s, origin, samples(s, limit))),
        Picture(f"Residual over {driver}", error_loop_plot(s, limit), noise),
    ]
    views = [
        Picture("Where the difference is easiest to see", zoom_plot(s, origin, limit)),
        Picture("Spectrum of the residual", spectrum_plot(s, limit),
                "Dashed: white noise of the record's noise level."),
        Picture("Autocorrelation of the residual", autocorrelation_plot(s),
                "Dashed: 95 % of the lags of white noise lie between these lines."),
        Picture("Distribution of the residual", distribution_plot(s),
                "Dashed: normal distribution of the same mean and standard deviation."),
    ]  # fmt: skip
    over_time = None
    if time:
        caption = f"{s.title}, and residual: {origin} minus model"
        over_time = Picture(caption, time_plot(s, origin, limit), f"{noise}{shaded}")
    sentence = residual_sentence(figures, s.curves[-1].label, s.time_scale)
    return _Part(s.name, s.title, sentence, over_time, [*(over_it if driver else []), *views])


# A diagnosis of a stack


def _errors(d: Diagnosis, scale: Scale) -> list[tuple[str, float, str, str]]:
    """Return the held-out errors as bars over the noise, which no model can go below."""
    rows = [("base model", d.base_errors.holdout_rms_m, "--base")]
    if added(d):
        rows.append(("extended model", d.extended_errors.holdout_rms_m, "--extended"))
    rows.append(("noise", d.noise_floor_rms_m, "--noise"))
    return [(*row, scale.text(row[1])) for row in rows]


def _budget(d: Diagnosis) -> dict[str, Any]:
    """Return the error budget, and what the unnamed correction adds."""
    b = d.budget
    if b is None or b.excess_rms_m <= 0.0:
        return {"budget": None}
    scale = scale_of(d.experiments, b.excess_rms_m)
    found = {"budget": budget_table(d, scale), "excess": scale.text(b.excess_rms_m), "patch": None}
    if d.patch is not None:
        coordinate, plot = patch_plot(d, d.patch)
        caption = f"Unnamed correction: {d.patch.name}, over the {coordinate}"
        found["patch"] = {"text": patch_text(d.patch), "picture": Picture(caption, plot)}
    return found


def _sentences(misfits: Sequence[Misfit]) -> list[list[str]]:
    """Return the sentences on the records with the largest errors over their noise."""
    order = sorted(misfits, key=lambda m: -weight(m))[:_TOLD_RECORDS]
    return [list(m.sentences[:_TOLD]) for m in order]


def drawn(misfits: Sequence[Misfit]) -> tuple[tuple[Misfit, str], ...]:
    """Return record and name of the views with the largest shares, one of every family.

    "spectrum" stands for the lines that are not the drive's.
    """
    best: dict[str, tuple[float, Misfit, str]] = {}
    for m in misfits:
        rows = [(v.name, v.share) for v in m.views if v.significant]
        rows += [("holds", m.holds.share)] if m.holds and m.holds.significant else []
        rows.append(("spectrum", m.spectrum.share))
        for name, share in rows:
            family = _FAMILIES.get(name, name)
            if share > WORTH_SAYING and (family not in best or share > best[family][0]):
                best[family] = (share, m, name)
    order = sorted(best.values(), key=lambda row: -row[0])
    return tuple((m, name) for _, m, name in order[:_VIEWS])


def _data_view(d: Diagnosis, m: Misfit, name: str) -> Picture | None:
    """Return the picture of one view of a record's residual, None where there is nothing in it."""
    counts, after = _in_counts(d, m), _after(d, m)
    if name == "spectrum":
        plot = spectrum_view_plot(m.spectrum, after.spectrum if after else None, counts=counts)
        return Picture(f"{m.record}: spectrum of the residual", plot)
    before = view_named(m, name)
    if before is None:
        return None
    plot = view_plot(before, view_named(after, name) if after else None, counts=counts)
    share = f", {percent(before.share)} of the excess" if before.significant else ""
    return Picture(f"{m.record}: {lowered(AXES[before.name].title)}{share}", plot)


def _in_counts(d: Diagnosis, m: Misfit) -> bool:
    units = {e.record.name: e.record.displacement_unit for e in d.experiments}
    return units.get(m.record) == "counts"


def _after(d: Diagnosis, m: Misfit) -> Misfit | None:
    """Return what the extended model leaves of the same record."""
    return next((r for r in d.remainder if r.record == m.record), None) if added(d) else None


def _splits(d: Diagnosis) -> list[tuple[str, Table]]:
    """Return the parts of residuals under periodic voltages, by record."""
    return [
        (m.record, split_table(m, _after(d, m), counts=_in_counts(d, m)))
        for m in d.misfit[:_TOLD_RECORDS]
        if m.split is not None and m.split.linear + m.split.even + m.split.odd > 0
    ]


def split_table(before: Misfit, after: Misfit | None, *, counts: bool) -> Table:
    """Return the parts of a residual under a periodic voltage: rms and share of the power."""
    s, t = before.split, after.split if after is not None else None
    if s is None:
        return Table((), ())
    scale = length_scale(before.rms, counts=counts)
    total = s.linear + s.even + s.odd + s.noise or 1.0
    names = {"linear": "linear", "even": "even", "odd": "odd", "noise": "does not repeat"}
    head = ["part", f"base [{scale.unit} rms]", "share of the power"]
    head += [f"extended [{scale.unit} rms]"] if t is not None else []
    rows = []
    for key, words in names.items():
        power = float(getattr(s, key))
        row = [words, number(scale.factor * float(np.sqrt(power))), percent(power / total)]
        if t is not None:
            row.append(number(scale.factor * float(np.sqrt(getattr(t, key)))))
        rows.append(tuple(row))
    return Table(tuple(head), tuple(rows))


def _cause(d: Diagnosis, cause: Cause) -> dict[str, Any]:
    """Return a named cause with confidence, size, and what it cannot be told from."""
    said = [alternative_sentence(d, a) for a in d.alternatives if a.cause == cause.effect]
    return {
        **_named(cause),
        "size": cause_size(d, cause),
        "alternatives": [f"{s[0].upper()}{s[1:]}." for s in said],
    }


def _named(cause: Cause | PortCause) -> dict[str, Any]:
    return {
        "title": f"{plain(cause.effect)} ({cause.belongs_to})",
        "confidence": percent(cause.confidence),
        "rivals": either(cause.cannot_be_told_from) if cause.cannot_be_told_from else "",
    }


def _signature(d: Diagnosis, cause: Cause) -> dict[str, Any] | None:
    """Return the signature of a cause beside the same view of the record that shows most of it."""
    effect = next((c for c in d.model.components if c.name == cause.effect), None)
    if effect is None or effect.more_of:  # several modes look as their tones make them look
        return None
    seen = signature(effect)
    note = size_sentence(seen)
    if seen.telling.name == "holds":
        note += " Counted from the beginning of the hold, in the direction of the last change."
    title = lowered(AXES[seen.telling.name].title)
    caption = f"{plain(effect.name).capitalize()}, simulated: {title}"
    pictures = [Picture(caption, signature_plot(seen), note), _of_the_data(d, seen)]
    return {
        "name": plain(effect.name),
        "looks_like": effect.looks_like,
        "pictures": [p for p in pictures if p is not None],
    }


def _of_the_data(d: Diagnosis, seen: Signature) -> Picture | None:
    """Return the data's view along the signature's coordinate, or the one that shows most."""
    name = seen.telling.name
    shown = [m for m in d.misfit if name == "spectrum" or view_named(m, name) is not None]
    if shown:
        best = max(shown, key=lambda m: (_share(m, name), m.rms))
        data = _data_view(d, best, name)
        if data is None or _share(best, name) > 0:
            return data
        return Picture(data.caption, data.panel, "This view alone does not show it for certain.")
    strongest = drawn(d.misfit)
    other = _data_view(d, *strongest[0]) if strongest else None
    if other is None:
        return None
    title = AXES[name].title.lower()
    note = f"No record has {title} to compare; this is the view that shows most."
    return Picture(other.caption, other.panel, note)


def _share(m: Misfit, name: str) -> float:
    view = view_named(m, name)
    return m.spectrum.share if name == "spectrum" or view is None else view.share


# An identification of a stack


def _tiles(
    rms: float, noise: float, span: float, scale: Scale, figures: Sequence[ResidualFigures],
    graded: tuple[Grade, ...],
) -> list[tuple[str, str, str]]:  # fmt: skip
    largest = max(f.largest for f in figures)
    errors = (("error, rms", rms), ("error, largest", largest))
    tiles = [
        (name, scale.text(size), f"{number(100.0 * size / span, 2)} % of the range")
        for name, size in errors
    ]
    tiles.append(("noise, rms", scale.text(noise), "from fast differences"))
    fitted = [g for g in graded if g.degree != "fixed"]
    if fitted:
        count = f"{len(named(graded, 'determined'))} of {len(fitted)}"
        tiles.append(("parameters determined", count, "to 10 % or better"))
    return tiles


def _determined(found: Identification, graded: tuple[Grade, ...]) -> list[Picture]:
    if not found.determinacy.names:
        return []
    errors, note = determinacy_plot(graded), error_bar_note(graded)
    pictures = [Picture("Relative standard error of each parameter", errors, note)]
    if len(found.determinacy.names) > 1:
        words = pairs_sentence(strong_pairs(found))
        pictures.append(Picture("Correlation of the estimates", correlation_plot(found), words))
    return pictures


# A diagnosis of a model of one's own


def _own_errors(d: OdeDiagnosis) -> list[tuple[str, list[tuple[str, float, str, str]], float]]:
    """Return the held-out errors of every output as bars over its noise."""
    found = []
    for e in d.errors[:_OWN_OUTPUTS]:
        rows = [("base model", e.base, "--base")]
        rows += [("extended model", e.extended, "--extended")] if added(d) else []
        rows.append(("noise", e.noise, "--noise"))
        bars = [(*row, with_its_unit(row[1], e.unit)) for row in rows]
        found.append((e.output, bars, e.noise))
    return found


def _free(d: OdeDiagnosis) -> Picture | None:
    free = d.correction
    if free is None:
        return None
    caption = f"Unnamed correction: what it adds to {free.port}, over {free.variable}"
    return Picture(caption, free_plot(free))


def _own_causes(d: OdeDiagnosis) -> list[dict[str, Any]]:
    """Return the named causes with place, confidence, size, and what each cannot be told from."""
    found = []
    for cause, share in zip(d.causes, d.budget.causes, strict=True):
        effect: Component = next(c for c in d.model.components if c.name == cause.effect)
        found.append(
            {
                **_named(cause),
                "description": cause.description,
                "removes": share.text,
                "law": effect.equation_text,
                "looks_like": effect.looks_like,
                "parameters": parameter_table(d.model, only=cause.parameters),
            }
        )
    return found
