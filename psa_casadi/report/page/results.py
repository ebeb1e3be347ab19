"""Pages of diagnoses and identifications: what their templates show, the story first."""

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from psa_casadi.common.files import atomic_write
from psa_casadi.diagnosis.held_out import StackBudget
from psa_casadi.diagnosis.misfit import WORTH_SAYING, Misfit
from psa_casadi.diagnosis.remedy import signature
from psa_casadi.diagnosis.result import Diagnosis, StackDiagnosis
from psa_casadi.identification import grades
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.profile import Profile
from psa_casadi.identification.result import Identification
from psa_casadi.posterior.sample import Posterior
from psa_casadi.report.page.document import Picture, render
from psa_casadi.report.page.live import LiveModel, live_diagnosis, live_fit
from psa_casadi.report.plots import findings, records
from psa_casadi.report.plots.figures import posterior_figure, record_figure, size_sentence
from psa_casadi.report.words import fit_words, phrases, tables, text, verdict_words
from psa_casadi.report.words.advice_words import profile_sentences
from psa_casadi.report.words.misfit_words import AXES, weight
from psa_casadi.report.words.phrases import added, lowered, number, plain
from psa_casadi.report.words.remedy_words import what_now
from psa_casadi.report.words.series import (
    ResidualFigures,
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
#: What a page shows of a stack, or of some diagnoses alone.
_OF_STACK = (
    "stack", "answers", "views", "splits", "signatures", "columns", "gained", "blind", "noise",
    "moved", "most", "excess", "patch",
)  # fmt: skip
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
        atomic_write(path, _page(diagnosis, stack, origin, still, model_file))


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


def _page(
    d: Diagnosis, stack: StackDiagnosis | None, origin: str, still: bool, model_file: str | None
) -> str:
    series, effects = series_of(d), {c.name: c for c in d.model.components}
    live = None if still else live_diagnosis(d, series)  # compiles meanwhile
    gain = tables.error_table(d, series[0].residual_scale)
    by_record = len(d.experiments) > 1 and not stack
    parts = _budget(d) | (_of_stack(stack) if stack else _of_any(d, series))
    about = f" of {plain(d.model.name)}" if not stack else ""
    return render(
        "diagnosis.html",
        f"Diagnosis{about}: {verdict_words.VERDICTS[d.verdict]}",
        **_shared(d, series, origin),
        **{**dict.fromkeys(_OF_STACK, ()), **parts},
        d=d,
        added=added(d),
        verdict=verdict_words.verdict_sentence(d),
        advice=what_now(d, model_file),
        live=live,
        most_records=_TOLD_RECORDS,
        evidence=findings.evidence_plot(d, None if stack else _EFFECTS),
        causes=[
            {
                "cause": c,
                "effect": effects[c.effect],
                "size": verdict_words.cause_size(d, c),
                "parameters": tables.parameter_table(d.model, only=c.parameters),
                "alternatives": [
                    f"{phrases.raised(verdict_words.alternative_sentence(d, a))}."
                    for a in (stack.alternatives if stack else ())
                    if a.cause == c.effect
                ],
            }
            for c in d.causes
        ],
        gain=[gain, tables.record_error_table(series)] if by_record else [gain],
        rest=phrases.rest_sentence(d),
        candidates=tables.candidate_table(d),
    )


def _of_any(d: Diagnosis, series: Sequence[Series]) -> dict[str, Any]:
    """Return what the page shows of a model that is no stack."""
    rows = [(s, residual_figures(s, s.curves[0])) for s in series]
    rows.sort(key=lambda row: -row[1].range_share)
    wrong = [
        f"{s.name}: {fit_words.whiteness_sentence(f, s.curves[0].label, s.time_scale)}"
        for s, f in rows[:_SERIES]
    ]
    errors = []
    for e in d.errors[:_OUTPUTS]:
        caption = f"{e.output}: error on held-out samples, rms"
        in_unit = partial(phrases.with_its_unit, unit=e.unit)
        errors.append(_bars(d, caption, (e.base, e.extended, e.noise), in_unit))
    wrong = [d.missed.where, *wrong]
    return {"errors": errors, "wrong": [[wrong], []], "most": _EFFECTS, "moved": d.moved}


def _of_stack(d: StackDiagnosis) -> dict[str, Any]:
    """Return what the page shows of a stack alone."""
    span = max(e.record.range_m for e in d.experiments)
    e, x = d.base_errors, d.extended_errors
    scale = phrases.scale_of(d.experiments, e.holdout_rms_m)
    reach = phrases.handy_scale(span, counts=scale.unit == "counts").text(span)
    sources = phrases.listing(list(dict.fromkeys(n.source for n in d.noise)))
    estimated = f" It is estimated from: {sources}." if sources else ""
    caption = f"Error on held-out samples, rms; the displacement's range is {reach}"
    rms = e.holdout_rms_m, x.holdout_rms_m, d.noise_floor_rms_m
    answers = (("Remains", phrases.rest_sentence(d)), ("Next", d.next_experiment.why))
    gained = verdict_words.gain_sentence(d) if added(d) else "nothing was added to the base model"
    own_voltages = added(d) and not d.gain.held_out_records
    return {
        "stack": True,
        "errors": [_bars(d, caption, rms, scale.text, estimated)],
        "answers": [f"{label}: {text}" for label, text in answers if text],
        "wrong": [
            [m.sentences[:_TOLD] for m in sorted(misfits, key=lambda m: -weight(m))]
            for misfits in (d.misfit, d.remainder)
        ],
        "views": [p for m, name in drawn(d.misfit) if (p := _data_view(d, m, name)) is not None],
        "splits": [
            (m.record, table)
            for m in d.misfit[:_TOLD_RECORDS]
            if (table := split_table(m, *_compared(d, m))) is not None
        ],
        "signatures": [s for c in d.causes[:_SIGNATURES] if (s := _signature(d, c.effect))],
        "columns": tables.column_table(d) if d.columns else None,
        "gained": [f"{phrases.raised(gained)}.", *([verdict_words.OWN_VOLTAGES] * own_voltages)],
        "blind": tables.blind_table(d),
        "noise": [n.sentence for n in d.noise],
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
        graded, tiles = grades.grades(identification), []
        error = text.fit_sentence(identification) if stack is None else ""
        if stack:
            noise = float(np.sqrt(np.mean([f.noise**2 for f in figures])))
            span = max(e.record.range_m for e in identification.experiments)
            error = fit_words.error_sentence(identification.fit.rms, noise, span, scale, origin)
            largest = max(f.largest for f in figures)
            tiles = [
                (f"error, {what}", scale.text(v), f"{number(100.0 * v / span, 2)} % of the range")
                for what, v in (("rms", identification.fit.rms), ("largest", largest))
            ]
            tiles.append(("noise, rms", scale.text(noise), "from fast differences"))
        if fitted := sum(g.degree != "fixed" for g in graded):
            count = f"{len(grades.named(graded, 'determined'))} of {fitted}"
            tiles.append(("parameters determined", count, "to 10 % or better"))
        return render(
            "fit.html",
            f"Identification of {'a stack' if stack else plain(identification.model.name)}",
            **_shared(identification, series, origin),
            identification=identification,
            combinations=stack.combinations if stack else (),
            further=stack.advice if stack else (),
            verdict=f"{error} {fit_words.determined_sentence(graded)}",
            tiles=tiles,
            live=live,
            determined=_determined(identification, graded),
            profiles=[
                Picture(
                    f"Profile of {p.name}", findings.profile_plot(p), " ".join(profile_sentences(p))
                )
                for p in profiles
            ],
            starts=tables.starts_table(identification.starts, series[0].residual_scale),
            errors=tables.fit_error_table(series, figures),
        )


def write_posterior(posterior: Posterior, path: str | os.PathLike[str]) -> None:
    """Write the page of a posterior, whole or not at all: picture, parameters, what is left.

    Raises InputError when `path` cannot be written to.
    """
    experiments, name = posterior.task.experiments, plain(posterior.model.name)
    records = phrases.counted(len(experiments), "record")
    page = render(
        "posterior.html",
        f"Posterior of {name}",
        [records],
        posterior=posterior,
        verdict=f"The posterior of {name}, given {records}: {text.drawn(posterior)}.",
        figure=posterior_figure(posterior),
        parameters=text.posterior_table(posterior),
        left=text.left_table(posterior),
        used=tables.record_table(experiments, "measured"),
    )
    atomic_write(path, page)


def _shared(
    result: Diagnosis | Identification, series: Sequence[Series], origin: str
) -> dict[str, Any]:
    """Return the parts of all pages of results: the worst record, all records, parameters.

    On the page of a fit the former appears only if no script runs.
    """
    model = result.model
    identification = result if isinstance(result, Identification) else None
    figures = [residual_figures(s, s.curves[-1]) for s in series]
    order = sorted(range(len(series)), key=lambda k: -figures[k].range_share)
    worst = most_telling(series)
    limit = points_each(len(series))
    curves = phrases.listing([origin, *(c.label for c in worst.curves)])
    below = Picture(
        f"{worst.name}: {curves}",
        records.time_plot(worst, origin, limit),
        f"Below: the residual; dashed: two standard deviations of the noise.{_shaded(worst)}",
    )
    stack = result if isinstance(result, StackIdentification) else None
    known = grades.determined(model, stack)
    others = [n for n in model.parameter_names if n not in known]
    return {
        "badges": [f"{origin} data", phrases.counted(len(result.experiments), "record")],
        "origin": origin,
        "worst": worst,
        "still": record_figure(worst, origin=origin),
        "below": below,
        "parts": [
            _part(s, figures[k], origin, limit, identification or s.name != worst.name)
            for k, s in enumerate(series)
            if k in order[:MOST_RECORDS]
        ],
        "count": len(series),
        "parameters": {
            name: tables.parameter_table(model, identification, only) if only else None
            for name, only in (("known", known), ("others", others))
        },
        "used": tables.record_table(result.experiments, origin),
    }


def points_each(count: int) -> int:
    """Return how many samples of each record may be drawn, so that the page stays below 3 MB."""
    return _MOST_SAMPLES // min(MOST_RECORDS, max(1, count))


def _shaded(s: Series) -> str:
    return " Shaded: held out." if s.held_out.any() else ""


def _part(
    s: Series, figures: ResidualFigures, origin: str, limit: int, timed: Any
) -> dict[str, Any]:
    """Return the views of a record and its residual; over time only if it is `timed`."""
    noise = "Dashed: two standard deviations of the noise."
    driver = s.against.partition(" [")[0]
    indices = records.samples(s, limit)
    over_it = [
        Picture(f"Loop: {s.quantity} over {driver}", records.loop_plot(s, origin, indices)),
        Picture(f"Residual over {driver}", records.error_loop_plot(s, limit), noise),
    ]
    views = [
        Picture("Where the difference is easiest to see", records.zoom_plot(s, origin, limit)),
        Picture("Spectrum of the residual", records.spectrum_plot(s, limit),
                "Dashed: white noise of the record's noise level."),
        Picture("Autocorrelation of the residual", records.autocorrelation_plot(s),
                "Dashed: 95 % of the lags of white noise lie between these lines."),
        Picture("Distribution of the residual", records.distribution_plot(s),
                "Dashed: normal distribution of the same mean and standard deviation."),
    ]  # fmt: skip
    caption = f"{s.title}, and residual: {origin} minus model"
    over_time = Picture(caption, records.time_plot(s, origin, limit), f"{noise}{_shaded(s)}")
    return {
        "name": s.name,
        "title": s.title,
        "sentence": fit_words.residual_sentence(figures, s.curves[-1].label, s.time_scale),
        "over_time": over_time if timed else None,
        "views": [*(over_it if driver else []), *views],
    }


def _bars(
    d: Diagnosis, caption: str, errors: tuple[float, float, float],
    text: Callable[[float], str], note: str = "",
) -> dict[str, Any]:  # fmt: skip
    """Return held-out errors as bars over the noise, which no model can go below."""
    names = (("base model", "--base"), ("extended model", "--extended"), ("noise", "--noise"))
    rows = [(name, e, colour, text(e)) for (name, colour), e in zip(names, errors, strict=True)]
    rows = rows if added(d) else [rows[0], rows[2]]
    return {"caption": caption, "rows": rows, "noise": errors[-1], "note": note}


def _budget(d: Diagnosis) -> dict[str, Any]:
    """Return the error budget, and what the unnamed correction adds."""
    b, excess, patch = d.budget, None, None
    if isinstance(b, StackBudget):
        if b.excess_rms_m <= 0.0:
            return {"budget": None}
        excess = phrases.scale_of(d.experiments, b.excess_rms_m).text(b.excess_rms_m)
    elif not added(d) and d.patch is None:
        return {"budget": None}
    if d.patch is not None:
        coordinate, plot = findings.correction_plot(d, d.patch)
        caption = f"Unnamed correction: {d.patch.name}, over {coordinate}"
        patch = {"text": verdict_words.patch_text(d.patch), "picture": Picture(caption, plot)}
    rest = {"patch": patch, "families": d.families}
    return {"budget": verdict_words.budget_table(d), "excess": excess, **rest}


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
    return Picture(f"{m.record}: {lowered(AXES[before.name].title)}{share}", plot)


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


def _signature(d: StackDiagnosis, name: str) -> dict[str, Any] | None:
    """Return the signature of a cause with the same view of the record that shows most of it."""
    effect = next((c for c in d.model.components if c.name == name), None)
    if effect is None or effect.more_of:  # several modes look as their tones make them look
        return None
    expected = signature(effect)
    view, note = expected.telling.name, size_sentence(expected)
    if view == "holds":
        note += " Counted from the beginning of the hold, in the direction of the last change."
    caption = f"{plain(name).capitalize()}, simulated: {lowered(AXES[view].title)}"
    pictures = [Picture(caption, findings.signature_plot(expected), note), _of_the_data(d, view)]
    there = [p for p in pictures if p is not None]
    return {"name": plain(name), "looks_like": effect.looks_like, "pictures": there}


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
        axis = AXES[name].title.lower()
        note = f"No record has {axis} to compare; this is the view that shows most."
    return None if data is None else Picture(data.caption, data.panel, note)


def _determined(identification: Identification, graded: tuple[grades.Grade, ...]) -> list[Picture]:
    if not identification.determinacy.names:
        return []
    errors, note = findings.determinacy_plot(graded), fit_words.error_bar_note(graded)
    pictures = [Picture("Relative standard error of each parameter", errors, note)]
    if len(identification.determinacy.names) > 1:
        words = fit_words.pairs_sentence(grades.strong_pairs(identification))
        plot = findings.correlation_plot(identification)
        pictures.append(Picture("Correlation of the estimates", plot, words))
    return pictures
