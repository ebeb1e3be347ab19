"""Where a search stands: what its rounds leave, and whether to go on."""

from collections.abc import Sequence

from psa_casadi.diagnosis.noise.colour import excess_power, noise_rms
from psa_casadi.diagnosis.search.rounds import Round
from psa_casadi.diagnosis.search.selection import OF_FIRST
from psa_casadi.diagnosis.verdict import PARTLY

#: A further cause must promise this share of what it has to remove, linearly estimated, unless
#: this share of the residual's power is still above the noise.
PROMISE, REMAINDER = 0.5, 0.35
#: What leaves structure must leave less by this factor.
STRUCTURE = 1.015


def left(rounds: Sequence[Round]) -> float:
    """What the last of the rounds leaves, rms [m]."""
    return rounds[-1].fit.rms


def missed(rounds: Sequence[Round]) -> float:
    """What the last of the rounds leaves, rms [m]; structure in it counts as a little more."""
    return left(rounds) * (STRUCTURE if rounds[-1].test.alarm else 1.0)


def is_open(rounds: Sequence[Round]) -> bool:
    """Whether structure remains and the causes found explain less than a partly one must."""
    first, last = rounds[0], rounds[-1]
    floor = noise_rms(last.fit.residuals, last.screening.colour)
    excess = excess_power(first.fit.residuals, last.screening.colour, floor)
    return last.test.alarm and first.fit.rms**2 - last.fit.rms**2 < PARTLY * excess


def worth_searching(rounds: Sequence[Round]) -> bool:
    """Whether a direction is above the threshold and removes what can be told of a stack.

    For a further cause the test must alarm too, and much of the residual's power be above the noise
    or the direction promise a share of what the first one removed.
    """
    current, first = rounds[-1], rounds[0].chosen
    best = max((s.decrease for s in current.screening.scores), default=0.0)
    promised = best * current.screening.colour.level**2 / len(current.fit.residuals)
    if promised <= current.test.knowable**2:
        return False
    if best < current.screening.threshold or first is None:
        return best >= current.screening.threshold
    enough = current.test.excess > REMAINDER or promised > PROMISE * OF_FIRST * first.removed
    return current.test.alarm and enough
