"""Whether held-out samples confirm a cause, what they cover, and whether a model holds there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import rms
from psa_casadi.diagnosis.held_out import Gain, held_out_residuals
from psa_casadi.diagnosis.noise import NoiseFloor, detection_limit_of
from psa_casadi.diagnosis.own_colour import OwnColour
from psa_casadi.diagnosis.task import Thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.start.doubts import doubtful_quantity, doubtful_voltage
from psa_casadi.records.record import FEWEST_SAMPLES
from psa_casadi.records.split import Experiment, Kind, counts

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
    limits: Thresholds,
) -> Note | None:
    """Return why the records do not confirm the causes of an extended model; None where they do.

    `hidden` is the share of the readings that a saturated sensor has made. The interval of the
    held-out `gain` is uninformative where it reaches from an error that doubles to the `whole` gain
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
    if low <= _DOUBLED and high >= whole and lost > limits.held_out:
        return note("gain_unknown", low=low, high=high)
    records = [e.record for e in experiments]
    if doubtful_voltage(records):
        return note("no_such_voltage")
    if partly and doubtful_quantity(records):
        return note("other_quantity")
    return None


#: Largest held-out errors that do not count (stray readings), the fewest that are tested, and those
#: of a whole record: fewer do not determine the colour of its noise.
_STRAY, _FEWEST, _FEWEST_OF_RECORDS = 2, 50, 512


@dataclass(frozen=True)
class Excess:
    """By which factor held-out errors exceed what they should be [-], and its p-value."""

    factor: float = 1.0
    p_value: float = 1.0

    def __bool__(self) -> bool:
        return self.factor > 1.0


def held_out_excess(
    fit: Fit,
    experiments: Sequence[Experiment],
    predicted: Sequence[FloatArray],
    colour: OwnColour,
    noise: Sequence[NoiseFloor],
    limits: Thresholds,
) -> Excess:
    """Return by which factor held-out errors exceed those of the fit; 1 where noise would do so.

    Samples of records that are fitted for the most part are compared with the fitted ones: the
    innovations by the `colour` of the residual. The ratio F of their mean squares is
    about normal under noise of kurtosis K, with mean (n + k)/(n - k) for k fitted parameters and n
    samples of the fit, and variance (K - 1)(1/m + 1/n) for m held-out samples. Whole records that
    are held out are compared with their `noise`: parameters that the fitted ones leave open
    make an error there too, so that only a clear excess counts. One below the detection limit of a
    stack does not.
    """
    fitted = [not e.held_out_whole for e in experiments]
    parts = held_out_residuals(experiments, predicted)
    beyond = [
        rms(part) / floor.level
        for part, floor, mine in zip(parts, noise, fitted, strict=True)
        if not mine and len(part) >= _FEWEST_OF_RECORDS and floor.level > 0
    ]
    excess = held_out_within(colour, len(fit.theta), limits) if all(fitted) else Excess()
    worst = max(beyond, default=0.0)
    if worst > max(limits.unseen_ratio_of_records, excess.factor):
        excess = Excess(worst, limits.unseen_alarm)
    size = rms(np.concatenate(parts)) * float(np.sqrt(1.0 - 1.0 / excess.factor**2))
    return excess if size > detection_limit_of(fit, experiments, limits) else Excess()


def held_out_within(colour: OwnColour, k: int, limits: Thresholds) -> Excess:
    """Return by which factor innovations exceed those of the fitted samples, k of them spent."""
    squares = np.sort(colour.ahead**2)[:-_STRAY]
    learnt = colour.learnt**2
    n, m, power = len(learnt), len(squares), rms(colour.learnt) ** 2
    if m < _FEWEST or n <= 2 * k or power <= 0:
        return Excess()
    ratio = float(np.mean(squares)) / power
    kurtosis = max(3.0, float(np.mean(learnt**2)) / power**2)
    spread = np.sqrt((kurtosis - 1.0) * (1.0 / m + 1.0 / n))
    chance = float(scipy.special.ndtr(-(ratio * (n - k) / (n + k) - 1.0) / spread))
    reports = chance < limits.unseen_alarm and ratio > limits.unseen_ratio**2
    return Excess(float(np.sqrt(ratio)), chance) if reports else Excess()


#: Shares of the samples, and of the voltage's span, that are mentioned.
_SAMPLES, _SPAN = 0.02, 0.01


def coverage_notes(experiments: Sequence[Experiment]) -> tuple[Note, ...]:
    """Return what the held-out figure does not rest on; none where all is covered.

    There may be too few of them. It extrapolates where held-out samples have kinds of stretch that
    no fitted sample shows, and where their voltage goes beyond the fitted one. It ignores
    kinds that are not held out.
    """
    records = [e.record for e in experiments]
    voltage = np.concatenate([r.voltage for r in records])
    span = float(np.ptp(voltage))
    fitted = counts(records, [e.used for e in experiments], span)
    held = counts(records, [e.held_out for e in experiments], span)
    few = too_few_held_out(experiments)
    if not fitted or few is not None:
        return () if few is None else (note("held_out_says_little", why=few),)
    notes = []
    for code, judged_kinds, known in (
        ("extrapolates", held, fitted), ("not_held_out", fitted, held),
    ):  # fmt: skip
        share, kinds = _without_like(judged_kinds, known)
        if share > _SAMPLES:
            notes.append(note(code, share=share, kinds=kinds))
    used = np.concatenate([e.record.voltage[e.used] for e in experiments])
    judged = np.concatenate([e.record.voltage[e.held_out] for e in experiments])
    low, high, least, most = (float(f(v)) for v in (used, judged) for f in (np.min, np.max))
    if max(low - least, most - high) > _SPAN * span:
        notes.append(note("voltages_beyond", least=least, most=most, low=low, high=high))
    return tuple(notes)


def _without_like(table: dict[Kind, int], known: dict[Kind, int]) -> tuple[float, tuple[str, ...]]:
    """Return the share of samples whose kind is not near any `known` one, and the largest kinds."""
    alone = {k: n for k, n in table.items() if not any(k.near(other) for other in known)}
    first = sorted(alone, key=lambda k: -alone[k])[:2]
    return sum(alone.values()) / sum(table.values()), tuple(k.words for k in first)
