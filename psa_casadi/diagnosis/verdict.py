"""From the rounds of the search to verdict, confidence, blind spots and what to do next."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from psa_casadi.component import Component
from psa_casadi.diagnosis.errors_of import errors_of, gain_of, held_out_rms
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
from psa_casadi.diagnosis.selection import MARGIN, Extension
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.determinacy import Determinacy, determinacy
from psa_casadi.identification.fit import Fit
from psa_casadi.identification.identify import FORCE_NOTE, with_provenance
from psa_casadi.identification.noise import correlation_inflation, high_frequency_noise
from psa_casadi.variables import nominal_value

if TYPE_CHECKING:
    from psa_casadi.diagnosis.diagnose import Round

#: Share of the held-out excess error that a closest known cause must remove.
PARTLY = 0.8
#: A second effect within this factor of the winner's held-out rms is as good on held-out data.
_AS_GOOD = 1.02
#: A cause that removes less than this share of what was left is named with less confidence.
_CLEAR = 0.5


def conclude(
    rounds: Sequence["Round"],
    experiments: Sequence[Experiment],
    table: Sequence[Component],
    stiffness_given: bool,
) -> Diagnosis:
    """Judge the rounds of a search and return the diagnosis."""
    first, last = rounds[0], rounds[-1]
    chosen = [r for r in rounds if r.chosen is not None]
    floor = high_frequency_noise(last.fit.residuals)
    share = _explained_share(experiments, first, last, floor)
    missing = first.test.alarm or first.chosen is not None
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
    causes = tuple(
        _cause(r, last.fit, found, share, _explained_share(experiments, r, after, floor))
        for r, after in zip(named, rounds[1:], strict=False)
    )
    return Diagnosis(
        verdict=verdict,
        causes=causes,
        candidates=_candidates(first, floor),
        noise_floor_rms_m=floor,
        base_errors=errors_of(experiments, first.predicted),
        extended_errors=errors_of(experiments, final.predicted),
        gain=gain_of(experiments, first.predicted, final.predicted),
        blind_to=_blind_spots(final, table),
        remaining=Remaining(not final.test.alarm, final.test.p_value, _where(final)),
        next_experiment=_next_experiment(causes, verdict),
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
    )


def _explained_share(
    experiments: Sequence[Experiment], first: "Round", last: "Round", floor: float
) -> float:
    """Share of the held-out excess power that the extension removes, between 0 and 1."""
    before = held_out_rms(experiments, first.predicted)
    after = held_out_rms(experiments, last.predicted)
    excess = before**2 - floor**2
    return float(np.clip((before**2 - after**2) / excess, 0.0, 1.0)) if excess > 0 else 0.0


def _told_from(r: "Round") -> tuple[str, ...]:
    """Rivals whose evidence and held-out prediction are as good as the chosen effect's."""
    if r.chosen is None:
        return ()
    chosen = r.chosen
    return tuple(
        rival.effect.name
        for rival in r.rivals
        if abs(chosen.evidence - rival.evidence) < MARGIN
        and rival.holdout_rms < _AS_GOOD * chosen.holdout_rms
    )


def _cause(r: "Round", final: Fit, found: Determinacy, share: float, own: float) -> Cause:
    """State a cause: `share` is what all causes explain, `own` what this one did of its round's."""
    chosen: Extension = r.chosen  # type: ignore[assignment]
    estimates = {
        p.name: Estimate(
            final.model.values[p.name],
            p.unit,
            (found.intervals[p.name].low, found.intervals[p.name].high),
        )
        for p in chosen.effect.parameters
        if p.name in found.intervals
    }
    inflation = correlation_inflation(chosen.fit.residuals)
    weights = [np.exp(min(0.0, (e.evidence - chosen.evidence) / inflation)) for e in r.rivals]
    return Cause(
        effect=chosen.effect.name,
        belongs_to=chosen.effect.belongs_to,
        confidence=float(min(0.99, share) * min(1.0, own / _CLEAR) / (1.0 + sum(weights))),
        parameters=estimates,
        cannot_be_told_from=_told_from(r),
        explained_share=own,
    )


def _candidates(first: "Round", floor: float) -> tuple[Candidate, ...]:
    """Every effect tried, with its share of the training excess; estimated if not fitted."""
    base = float(np.sum(first.fit.residuals**2))
    excess = max(base - len(first.fit.residuals) * floor**2, 1e-300)
    fitted = {e.effect.name: e for e in first.extensions}
    rows = []
    for name, score in first.screening.best_by_effect().items():
        if name in fitted:
            gone = base - float(np.sum(fitted[name].fit.residuals ** 2))
            rows.append(Candidate(name, min(1.0, gone / excess), fitted[name].evidence, True))
        else:
            gone = score.decrease * first.screening.colour.level**2
            rows.append(Candidate(name, min(1.0, gone / excess), 0.5 * score.decrease, False))
    return tuple(sorted(rows, key=lambda c: (-c.fitted, -c.evidence)))


def _blind_spots(final: "Round", table: Sequence[Component]) -> tuple[BlindSpot, ...]:
    """Effects whose smallest detectable gain on these records exceeds their ordinary size."""
    spots = []
    present = {c.name for c in final.fit.model.components}
    for effect in table:
        if effect.name in present:
            continue
        scores = [s for s in final.screening.scores if s.direction.effect is effect]
        gain = next(p for p in effect.parameters if p.name == effect.gain)
        practical = nominal_value(gain.scale or 1.0, final.fit.model.values)
        factor = np.sqrt(final.screening.threshold)
        smallest = min((factor * s.detectable_gain for s in scores), default=np.inf)
        if smallest > practical:
            shown = f"{smallest:.3g} {gain.unit}" if np.isfinite(smallest) else "nothing finite"
            spots.append(
                BlindSpot(
                    effect.name,
                    float(min(smallest, 1e300)),
                    gain.unit,
                    f"These records show {effect.name} only from {shown} on, while {practical:.3g}"
                    f" {gain.unit} is an ordinary size.",
                )
            )
    return tuple(spots)


def _where(r: "Round") -> str:
    if r.test.alarm:
        return f"{r.test.where} {100 * r.test.excess:.0f} % of its power is above the noise."
    return "What remains cannot be told from noise."


_ADVICE = (
    "Play a hold of several seconds, the same loop at three rates and at three amplitudes, and a"
    " repeated step: rates separate delay, lag and creep; amplitudes separate asymmetry and memory;"
    " holds separate creep and drift; the repeat shows the noise."
)


def _next_experiment(causes: Sequence[Cause], verdict: Verdict) -> NextExperiment:
    rivals = tuple(dict.fromkeys(n for c in causes for n in (c.effect, *c.cannot_be_told_from)))
    if verdict == "ambiguous":
        return NextExperiment(None, rivals, _ADVICE)
    if verdict in ("unexplained", "partly_explained"):
        return NextExperiment(None, (), _ADVICE)
    return NextExperiment(None, (), "None is needed for this verdict.")
