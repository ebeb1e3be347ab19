"""Can these records confirm named causes at all? Where they cannot, no cause is named."""

from collections.abc import Sequence

from psa_casadi.diagnosis.held_out.errors import Gain
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.identification.start.doubts import doubtful_voltage
from psa_casadi.identification.start.other_quantities import doubtful_quantity
from psa_casadi.notes import Note, note
from psa_casadi.records.checks import FEWEST_SAMPLES
from psa_casadi.records.split import Experiment

#: Gain [%] of an error that doubles.
_DOUBLED = -100.0
#: Share of the readings from which on a saturated sensor hides more than it shows.
_HIDDEN = 0.5


def too_few_held_out(experiments: Sequence[Experiment]) -> Note | None:
    """Return that too few readings are held out to judge a model by; None where enough are."""
    count = sum(int(e.held_out.sum()) for e in experiments)
    if count >= FEWEST_SAMPLES:
        return None
    return note("few_held_out", count=count, least=FEWEST_SAMPLES)


def unconfirmed(
    experiments: Sequence[Experiment],
    gain: Gain,
    *,
    whole: float,
    lost: float,
    partly: bool,
    hidden: float,
) -> Note | None:
    """Return why the records do not confirm the causes of an extended model; None where they do.

    `hidden` is the share of the readings that a saturated sensor has made. The interval of the
    held-out `gain` tells nothing where it reaches from an error that doubles to the `whole` gain
    [%], which leaves the noise alone; that of a saturation which shows in one of eight parts does
    too, so that all but the part that gains most must also have `lost` something [nats]. The
    voltage must be one that stacks bear and, where the causes explain the records `partly` and
    much remains, the displacement no other quantity.
    """
    few = too_few_held_out(experiments)
    if few is not None:
        return few
    if hidden > _HIDDEN:
        return note("saturated", share=hidden)
    low, high = gain.interval
    if low <= _DOUBLED and high >= whole and lost > thresholds().held_out:
        return note("gain_unknown", low=low, high=high)
    records = [e.record for e in experiments]
    if doubtful_voltage(records):
        return note("no_such_voltage")
    if partly and doubtful_quantity(records):
        return note("other_quantity")
    return None
