"""Can held-out samples confirm named causes at all? Where they cannot, no cause is named."""

from collections.abc import Sequence

from psa_casadi.diagnosis.held_out.errors import Gain
from psa_casadi.records.record import FEWEST_SAMPLES
from psa_casadi.records.split import Experiment

#: Share of the readings from which on a saturated sensor hides more than it shows.
_HIDDEN = 0.5


def too_few_held_out(experiments: Sequence[Experiment]) -> str:
    """Say that too few readings are held out to judge a model by; "" where there are enough."""
    count = sum(int(e.held_out.sum()) for e in experiments)
    if count >= FEWEST_SAMPLES:
        return ""
    return (
        f"only {count} of the readings that count are held out, and no model can be judged by fewer"
        f" than {FEWEST_SAMPLES}"
    )


def unconfirmed(
    experiments: Sequence[Experiment], gain: Gain, *, partly: bool, hidden: float
) -> str:
    """Say why held-out samples do not confirm the causes of an extended model; "" where they do.

    `hidden` is the share of the readings that a saturated sensor has made. Where the causes explain
    the records `partly` and much remains, the interval of the held-out `gain` must leave no gain
    out.
    """
    few = too_few_held_out(experiments)
    if few:
        return few
    if hidden > _HIDDEN:
        return (
            f"the sensor is saturated in {100 * hidden:.0f} % of the readings, so that more of the"
            " motion is hidden than shown"
        )
    low, high = gain.interval
    if partly and low <= 0.0:
        return (
            f"much would remain, and the 95 % interval of the held-out gain, {low:.0f} to"
            f" {high:.0f} %, does not leave out that there is none"
        )
    return ""
