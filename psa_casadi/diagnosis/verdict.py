"""From the rounds of the search to verdict, confidence, blind spots and what to do next."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.component import Component
from psa_casadi.diagnosis.held_out.errors import (
    errors_of,
    explained_share,
    gain_of,
    whole_residuals,
)
from psa_casadi.diagnosis.held_out.generalisation import Excess, held_out_excess
from psa_casadi.diagnosis.noise.floor import NoiseFloor, noise_floor, pooled_level
from psa_casadi.diagnosis.residual.misfit import FEWEST, Misfit, misfit
from psa_casadi.diagnosis.result import (
    BlindSpot,
    Candidate,
    Cause,
    Diagnosis,
    Estimate,
    NextExperiment,
    Remaining,
    Verdict,
)
from psa_casadi.diagnosis.screening.evidence import CREDIBLE, credible_set
from psa_casadi.diagnosis.search.contenders import contenders, same_curve_note
from psa_casadi.diagnosis.search.extension import Extension
from psa_casadi.diagnosis.search.rounds import Round
from psa_casadi.diagnosis.task import same_curves
from psa_casadi.identification.certainty.determinacy import Determinacy, determinacy
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.identify import FORCE_NOTE, with_provenance
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.timings import stage

FloatArray = npt.NDArray[np.float64]

#: Share of the held-out excess error that a closest known cause must remove.
PARTLY = 0.8
_HELD_OUT = (
    "The held-out samples' error is {:.2f} times what the fitted ones let expect: something matters"
    " there that these do not show."
)


@stage("judging")
def conclude(
    rounds: Sequence[Round],
    experiments: Sequence[Experiment],
    table: Sequence[Component],
    stiffness_given: bool,
) -> Diagnosis:
    """Judge the rounds of a search and return the diagnosis."""
    first, last = rounds[0], rounds[-1]
    chosen = [r for r in rounds if r.chosen is not None]
    errors = whole_residuals(experiments, last.predicted)
    base_errors = whole_residuals(experiments, first.predicted)
    noise = noise_floor([e.record for e in experiments], errors)
    floor = pooled_level(noise, errors, last.screening.colour)
    share = explained_share(experiments, first.predicted, last.predicted, floor)
    colour = first.screening.colour
    beyond = held_out_excess(first.fit, experiments, first.predicted, colour, noise)
    missing = first.test.alarm or first.chosen is not None or bool(beyond)
    verdict: Verdict
    if not missing:
        verdict = "adequate"
    elif not chosen:
        verdict = "unexplained"
    elif not last.test.alarm:
        verdict = "cause_named"
    else:
        verdict = "partly_explained" if share >= PARTLY else "unexplained"
    if verdict in ("cause_named", "partly_explained") and _told_from(chosen[0]):
        verdict = "ambiguous"
    named = chosen if verdict in ("cause_named", "partly_explained", "ambiguous") else []
    final = last if named else first
    found = determinacy(final.fit, experiments)
    missed = _misfits(experiments, base_errors, noise)
    causes = tuple(
        _cause(
            r,
            r.chosen,
            last.fit,
            found,
            explained_share(experiments, r.predicted, after.predicted, floor),
            partly=verdict == "partly_explained",
        )
        for r, after in zip(named, rounds[1:], strict=False)
        if r.chosen is not None
    )
    return Diagnosis(
        verdict=verdict,
        causes=causes,
        candidates=_candidates(first, floor, named=bool(named)),
        noise_floor_rms_m=floor,
        base_errors=errors_of(experiments, first.predicted),
        extended_errors=errors_of(experiments, final.predicted),
        gain=gain_of(experiments, first.predicted, final.predicted),
        blind_to=_blind_spots(final, table),
        remaining=_remaining(final, Excess() if named else beyond),
        next_experiment=_next_experiment(
            causes, verdict, same_curves(experiments, table, first.fit)
        ),
        notes=() if stiffness_given else (FORCE_NOTE,),
        experiments=tuple(experiments),
        base_fit=first.fit,
        extended_fit=final.fit,
        base=first.predicted,
        extended=final.predicted,
        model=with_provenance(
            final.fit.model,
            found,
            [e.record for e in experiments],
            stiffness_given,
        ),
        noise=noise,
        misfit=missed,
        remainder=_misfits(experiments, errors, noise) if named else missed,
        contenders=contenders(chosen[0], experiments) if verdict == "ambiguous" else (),
    )


def _misfits(
    experiments: Sequence[Experiment],
    errors: Sequence[FloatArray],
    noise: Sequence[NoiseFloor],
) -> tuple[Misfit, ...]:
    return tuple(
        misfit(e.record, error, floor)
        for e, error, floor in zip(experiments, errors, noise, strict=True)
        if np.count_nonzero(np.isfinite(error)) >= FEWEST
    )


def _told_from(r: Round) -> tuple[str, ...]:
    """Effects that may as well be the cause: with the chosen one, the credible set."""
    if r.chosen is None:
        return ()
    within = credible_set(r.probability, CREDIBLE)
    return tuple(name for name in within if name != r.chosen.effect.name)


def _cause(
    r: Round, chosen: Extension, final: Fit, found: Determinacy, own: float, *, partly: bool
) -> Cause:
    """State a cause; `own` is the share that it explains of what was left before it.

    The confidence is the probability of the effect, times that share where structure remains.
    """
    estimates = {
        p.name: Estimate(
            final.model.values[p.name],
            p.unit,
            (found.intervals[p.name].low, found.intervals[p.name].high),
        )
        for p in chosen.effect.parameters
        if p.name in found.intervals
    }
    probability = r.probability[chosen.effect.name] * (own if partly else 1.0)
    return Cause(
        effect=chosen.effect.name,
        belongs_to=chosen.effect.belongs_to,
        confidence=float(min(0.99, probability)),
        parameters=estimates,
        cannot_be_told_from=_told_from(r),
        explained_share=own,
    )


def _candidates(first: Round, floor: float, *, named: bool) -> tuple[Candidate, ...]:
    """Every effect tried, with its share of the training excess; estimated if not fitted.

    Where nothing is named no effect of the table has a probability.
    """
    base = float(np.mean(first.fit.residuals**2))
    excess = max(base - floor**2, 1e-300)
    fitted = {e.effect.name: e for e in first.extensions}
    rows = []
    for name, score in first.screening.best_by_effect().items():
        known = fitted.get(name)
        gone = score.decrease * first.screening.colour.level**2 / len(first.fit.residuals)
        gone = gone if known is None else known.removed
        rows.append(
            Candidate(
                effect=name,
                explained_share=float(np.clip(gone / excess, 0.0, 1.0)),
                evidence=first.evidence[name],
                fitted=known is not None,
                probability=first.probability.get(name, 0.0) if named else 0.0,
            )
        )
    return tuple(sorted(rows, key=lambda c: (-c.fitted, -c.evidence)))


def _blind_spots(final: Round, table: Sequence[Component]) -> tuple[BlindSpot, ...]:
    """Effects whose smallest detectable gain on these records exceeds their ordinary size."""
    spots = []
    present = {c.name for c in final.fit.model.components}
    for effect in table:
        if effect.name in present:
            continue
        scores = [s for s in final.screening.scores if s.direction.effect is effect]
        gain = next(p for p in effect.parameters if p.name == effect.gain)
        extended = final.fit.model.with_effect(effect, {gain.name: 0.0})
        practical = gain.typical(extended.values)
        factor = np.sqrt(final.screening.threshold)
        smallest = min((factor * s.detectable_gain for s in scores), default=np.inf)
        if smallest > practical:
            unit = "" if gain.unit == "1" else f" {gain.unit}"
            seen = f"only from {smallest:.3g}{unit} on" if np.isfinite(smallest) else "at no size"
            spots.append(
                BlindSpot(
                    effect.name,
                    float(min(smallest, 1e300)),
                    gain.unit,
                    f"These records show {effect.name} {seen} ({gain.name}), while"
                    f" {practical:.3g}{unit} is an ordinary size.",
                )
            )
    return tuple(spots)


def _remaining(r: Round, beyond: Excess) -> Remaining:
    """Describe what is left; `beyond` the fit where that leaves nothing to be seen."""
    where = "What remains cannot be told from noise."
    if r.test.alarm:
        where = f"{r.test.where} {100 * r.test.excess:.0f} % of its power is above the noise."
    elif beyond:
        where = _HELD_OUT.format(beyond.factor)
    p_value = min(r.test.p_value, beyond.p_value)
    return Remaining(not (r.test.alarm or beyond), p_value, where)


_ADVICE = (
    "Play a hold of several seconds, the same loop at three rates and at three amplitudes, and a"
    " repeated step: rates separate delay, lag and creep; amplitudes separate asymmetry and memory;"
    " holds separate creep and drift; the repeat shows the noise."
)


def _next_experiment(
    causes: Sequence[Cause], verdict: Verdict, alike: Sequence[Sequence[str]]
) -> NextExperiment:
    rivals = tuple(dict.fromkeys(n for c in causes for n in (c.effect, *c.cannot_be_told_from)))
    if verdict == "ambiguous":
        own = (causes[0].effect, *causes[0].cannot_be_told_from)
        if len(own) > 1 and any(set(own) <= set(group) for group in alike):
            return NextExperiment(None, rivals, same_curve_note(own))
        return NextExperiment(None, rivals, _ADVICE)
    if verdict in ("unexplained", "partly_explained"):
        return NextExperiment(None, (), _ADVICE)
    return NextExperiment(None, (), "None is needed for this verdict.")
