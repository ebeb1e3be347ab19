"""Can these records confirm named causes at all? Where they cannot, no cause is named."""

from collections.abc import Sequence

from psa_casadi.diagnosis.held_out.errors import Gain
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.identification.start.doubts import doubtful_quantity, doubtful_voltage
from psa_casadi.records.checks import FEWEST_SAMPLES
from psa_casadi.records.split import Experiment

#: Gain [%] of an error that doubles.
_DOUBLED = -100.0
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
    experiments: Sequence[Experiment],
    gain: Gain,
    *,
    whole: float,
    lost: float,
    partly: bool,
    hidden: float,
) -> str:
    """Say why the records do not confirm the causes of an extended model; "" where they do.

    `hidden` is the share of the readings that a saturated sensor has made. The interval of the
    held-out `gain` tells nothing where it reaches from an error that doubles to the `whole` gain
    [%], which leaves the noise alone; that of a saturation which shows in one of eight parts does
    too, so that all but the part that gains most must also have `lost` something [nats]. The
    voltage must be one that stacks bear and, where the causes explain the records `partly` and
    much remains, the displacement no other quantity.
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
    if low <= _DOUBLED and high >= whole and lost > thresholds().held_out:
        return (
            f"the 95 % interval of the held-out gain, {low:.0f} to {high:.0f} %, reaches from an"
            " error that doubles to noise alone, and most held-out samples lose by it"
        )
    return _columns(experiments, partly=partly)


def _columns(experiments: Sequence[Experiment], *, partly: bool) -> str:
    records = [e.record for e in experiments]
    if doubtful_voltage(records):
        return "no stack bears such a voltage, and what depends on its level cannot be told"
    if partly and doubtful_quantity(records):
        return "much would remain, and the displacement may be another quantity"
    return ""
