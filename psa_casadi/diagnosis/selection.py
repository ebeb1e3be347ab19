"""Which effects are fitted, and the choice among them."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.extension import Extension
from psa_casadi.diagnosis.screening import Score, Screening
from psa_casadi.experiment.drive import among_harmonics
from psa_casadi.experiment.split import Experiment
from psa_casadi.identification.fit import Fit
from psa_casadi.identification.search import FIXED

FloatArray = npt.NDArray[np.float64]

#: How many effects are fitted fully in each round; how many where the screening's scores are this
#: close to the best one's; and how many starts each gets.
FULL_FITS, _MOST_FITS, _AS_NEAR = 4, 7, 0.4
_STARTS = 2
#: An effect whose screening score is below this share of the best one is not worth a full fit.
_WORTH = 0.1
#: Evidence (in units of the log-likelihood) within which the better held-out prediction leads.
MARGIN = 3.0
#: Share of the excess power that an effect must remove to be added.
WORTHWHILE = 0.25
#: Gain in log-likelihood of the held-out samples that a first and a further effect must bring.
HELD_OUT, HELD_OUT_FURTHER = 1.0, 4.0
#: A further effect must remove this share of what the first one did: less may be the first one's
#: form, which is not the true one.
OF_FIRST = 0.05


def leading(screening: Screening) -> list[tuple[str, list[Score]]]:
    """Return the effects worth a full fit with their best starts, best first."""
    best = screening.best_by_effect()
    if not best:
        return []
    top = next(iter(best.values())).decrease
    limit = max(screening.threshold, _WORTH * top)
    near = [name for name, score in best.items() if score.decrease >= max(limit, _AS_NEAR * top)]
    count = max(FULL_FITS, min(len(near), _MOST_FITS))
    chosen = [name for name, score in best.items() if score.decrease >= limit][:count]
    return [(name, starts_of(screening, name)) for name in chosen]


def starts_of(screening: Screening, name: str) -> list[Score]:
    """Return the best directions of one effect, from which its fits start."""
    own = [s for s in screening.scores if s.direction.effect.name == name]
    starts: list[Score] = []
    for score in own:
        known = [s.direction.values for s in starts]
        new = score.direction.values not in known or score.direction.finite
        if new and len(starts) < _STARTS and score.decrease >= 0.3 * own[0].decrease:
            starts.append(score)
    return starts


def choose(
    extensions: Sequence[Extension],
    experiments: Sequence[Experiment],
    before: Fit,
    before_holdout: float,
    floor: float,
    colour: Colour,
    first: Extension | None,
) -> list[Extension]:
    """Return the extensions that are worth having, best first.

    Worth having: evidence; the effect in character; a share of the training residual's power above
    the noise `floor` removed; and held-out data predicted better. A further cause, beside the
    `first`, must also remove a share of what that one did. The order is that of the evidence;
    within the margin the better prediction leads.
    """
    excess = before.rms**2 - floor**2
    needed = HELD_OUT if first is None else HELD_OUT_FURTHER
    held = sum(int(e.held_out.sum()) for e in experiments) / colour.inflation
    good = [
        e
        for e in extensions
        if e.evidence > 0
        and not out_of_character(e, experiments)
        and e.removed > WORTHWHILE * excess
        and (first is None or e.removed > OF_FIRST * first.removed)
        and held * np.log(before_holdout / max(e.holdout_rms, 1e-300)) > needed
    ]
    good.sort(key=lambda e: -e.evidence)
    close = [e for e in good if good[0].evidence - e.evidence < MARGIN]
    close.sort(key=lambda e: e.holdout_rms)
    return close + [e for e in good if e not in close]


def out_of_character(extension: Extension, experiments: Sequence[Experiment]) -> bool:
    """Whether the data ask for something that is not this effect.

    A parameter pushed to the end of its range, or a tone among the harmonics of a periodic drive.
    """
    values = extension.fit.model.values
    tone = extension.effect.tone
    if tone is not None and any(among_harmonics(values[tone], e.record) for e in experiments):
        return True
    for p in extension.effect.parameters:
        if p.name in FIXED or p.name == extension.effect.gain:
            continue
        low, high = p.bounds
        margin = 1e-3 * (high - low) if not p.log else 0.0
        value = values[p.name]
        if p.log and (value < 1.01 * low or value > high / 1.01):
            return True
        if not p.log and (value <= low + margin or value >= high - margin):
            return True
    return False
