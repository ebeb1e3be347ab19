"""Whether held-out samples confirm a cause; their errors, and the error budget.

    share = sum_j (P_before,j - P_after,j) / s_j^2  /  sum_j (P_base,j - s_j^2) / s_j^2

P_j are mean squares of the models' held-out errors in output j, s_j is the rms of its noise. A
stack has one output, its displacement, of which s_j cancels. The interval is the jackknife's over
the held-out records where there are four or more, else over eight blocks of each record's held-out
samples (Efron and Tibshirani 1993, chapter 11).

All powers are mean squares over the held-out samples, above that of the noise:

    share of a cause = (P_without - P_all) / (P_base - noise^2)

P_without is that of the model fitted again without the cause.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from psa_casadi.common.notes import Note, note
from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.diagnosis.colour import Colour, OwnColour, rms
from psa_casadi.diagnosis.noise import NoiseFloor, detection_limit_of
from psa_casadi.diagnosis.task import Thresholds
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.start.doubts import doubtful_quantity, doubtful_voltage
from psa_casadi.records.record import FEWEST_SAMPLES
from psa_casadi.records.split import Experiment, Kind, counted, counts

#: Fewest held-out records that serve as the parts; number of blocks of each that do otherwise.
FEWEST_RECORDS, _BLOCKS = 4, 8


def parts_of(*errors: Sequence[FloatArray]) -> tuple[FloatArray, IndexArray]:
    """Return sums of squares (parts, models, outputs) and sample counts (parts, outputs).

    `errors` holds of every model the held-out errors (n, outputs) of every record, nan where an
    output is not judged. The parts are the records that have any, where there are at least four,
    else eight blocks of each.
    """
    rows = [row for row in zip(*errors, strict=True) if len(row[0])]
    if len(rows) < FEWEST_RECORDS:
        blocks = [zip(*(np.array_split(e, _BLOCKS) for e in r), strict=True) for r in rows]
        rows = [block for of_one in blocks for block in of_one if len(block[0])]
    outputs = errors[0][0].shape[1]
    judged = [~np.isnan(np.array(row)).all(axis=0) for row in rows]
    pairs = zip(rows, judged, strict=True)
    sums = [[np.sum(e**2, axis=0, where=there) for e in row] for row, there in pairs]
    counts = np.array([there.sum(axis=0) for there in judged], dtype=np.int64)
    return np.reshape(sums, (-1, len(errors), outputs)), counts.reshape(-1, outputs)


def jackknife(of: Callable[[BoolArray], float], k: int) -> tuple[float, float]:
    """Return a figure over all parts, and the half width of its 95 % interval.

    With L the figure over all of k parts and L_i that without part i it is
    L +- t_(k-1) sqrt((k-1)/k sum (L_i - mean)^2) (Efron and Tibshirani 1993, chapter 11).
    """
    every = np.ones(k, dtype=bool)
    if k < 2:
        return of(every), 0.0
    without = [of(every & (np.arange(k) != i)) for i in range(k)]
    spread = float(np.sqrt((k - 1) * np.var(without)))
    return of(every), float(scipy.special.stdtrit(k - 1, 0.975)) * spread


@dataclass(frozen=True)
class Errors:
    """Errors of one model [m], in training and held-out samples; percent of the measured range."""

    train_rms_m: float
    holdout_rms_m: float
    holdout_max_m: float
    holdout_nrmse_percent: float


@dataclass(frozen=True)
class Gain:
    """Reduction of the held-out rms by the extended model [%], with a 95 % interval.

    `held_out_records` is the number of records that the interval is taken over, 0 where it is
    blocks of fewer ones: then it speaks for their voltages only.
    """

    holdout_rms_reduction_percent: float
    interval: tuple[float, float]
    held_out_records: int = 0


def held_out_residuals(
    experiments: Sequence[Experiment], predicted: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return measured minus predicted over the held-out samples of every experiment [m]."""
    left = whole_residuals(experiments, predicted)
    return [part[e.held_out] for e, part in zip(experiments, left, strict=True)]


def held_out_rms(experiments: Sequence[Experiment], predicted: Sequence[FloatArray]) -> float:
    """Return the root mean square over all held-out samples [m]."""
    return rms(np.concatenate(held_out_residuals(experiments, predicted)))


def held_out_gain(
    samples: Sequence[int],
    colour: Colour,
    straight: Sequence[float],
    before: Sequence[float],
    after: Sequence[float],
) -> float:
    """Return sum_j m_j ln(E0_j / E_j): what held-out samples give a model over another one [nats].

    m_j are the `samples` of an output over the inflation by its noise's `colour`; E0 and E the rms
    errors `before` and `after`, each with what is unknown of the output, `straight`, in its
    unit.
    """
    gained = 0.0
    for n, c, *rest in zip(samples, colour.each, straight, before, after, strict=True):
        old, new = (max(float(np.hypot(e, rest[0])), 1e-300) for e in rest[1:])
        gained += n / c.inflation * float(np.log(old / new))
    return gained


def whole_residuals(
    experiments: Sequence[Experiment], predicted: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return measured minus predicted [m] of every record, nan where nothing was measured."""
    return [e.record.measured - y for e, y in zip(experiments, predicted, strict=True)]


def errors_of(experiments: Sequence[Experiment], predicted: Sequence[FloatArray]) -> Errors:
    """Return the errors of a model's predictions of whole records.

    A record whose displacement rests counts over the largest range of all.
    """
    largest = max(e.record.range_m for e in experiments)
    pairs = list(zip(experiments, whole_residuals(experiments, predicted), strict=True))
    train = np.concatenate([left[e.used] for e, left in pairs])
    held = np.concatenate([left[e.held_out] for e, left in pairs])
    squares = sum(
        float(np.sum((left[e.held_out] / (e.record.range_m or largest)) ** 2)) for e, left in pairs
    )
    shares = float(len(held))
    if not len(held):
        held = train
        squares, shares = float(np.mean(train**2)) / largest**2, 1.0
    worst, percent = float(np.max(np.abs(held))), 100.0 * float(np.sqrt(squares / shares))
    return Errors(rms(train), rms(held), worst, percent)


def held_out_parts(
    experiments: Sequence[Experiment], *predicted: Sequence[FloatArray]
) -> tuple[FloatArray, IndexArray]:
    """Return sums of squares (parts, models) [m^2] and sample counts (parts,) of held-out parts.

    The parts are those of `psa_casadi.diagnosis.held_out`.
    """
    each = [held_out_residuals(experiments, p) for p in predicted]
    sums, counts = parts_of(*([r[:, None] for r in residuals] for residuals in each))
    return sums[:, :, 0], counts[:, 0]


def _log_ratio(sums: FloatArray) -> float:
    """Logarithm of the errors' ratio [-], from their sums of squares before and after [m^2]."""
    before, after = (max(float(s), 1e-300) for s in sums)
    return 0.5 * float(np.log(after / before))


#: The least noise that weighs an output, and the least excess, over the base's error (in power).
_LEAST_NOISE, _LEAST_EXCESS = 1e-30, 1e-9


@dataclass(frozen=True)
class Share:
    """What one cause, or an unnamed correction, removes of the error [-], and 95 % interval.

    0 to 1 as a rule; below 0 where it adds error.
    """

    what: str
    share: float
    interval: tuple[float, float]

    @property
    def clipped(self) -> tuple[float, float, float]:
        """The share and the ends of its interval as they are reported, cut to 0 to 1."""
        share, low, high = (min(max(v, 0.0), 1.0) for v in (self.share, *self.interval))
        return share, low, high

    @property
    def percents(self) -> tuple[str, str, str]:
        """The same as percentages without their sign, with decimals where all are near 0 or 1.

        A share that is not 0 is never printed as 0, one below 1 as 100 only from 99.995 on.
        """
        share, low, high = self.clipped
        off = min(1.0 - self.interval[0], self.interval[1])
        off = 1.0 if off < 0.0 else off  # beyond what is reported
        digits = 0 if off > 0.01 else 1 if off > 0.001 else 2
        while digits < 2 and share < 1.0 and float(f"{100 * share:.{digits}f}") >= 100.0:
            digits += 1
        least = 10.0**-digits
        text = f"{100 * share:.{digits}f}"
        if 0.0 < 100 * share < 0.5 * least:
            text = f"under {least:.{digits}f}"
        return text, f"{100 * low:.{digits}f}", f"{100 * high:.{digits}f}"

    @property
    def text(self) -> str:
        """The share with its interval, such as "62 % (58 to 66 %)"."""
        share, low, high = self.percents
        return f"{share} % ({low} to {high} %)"


@dataclass(frozen=True, eq=False)
class Removed:
    """What models remove of a base's held-out error above the noise, in its first channels.

    `base` are its predictions (n, channels), or (n,) of one, of all records; `noise` (outputs,) is
    the rms of each channel's noise in its unit.
    """

    experiments: Sequence[Experiment]
    base: Sequence[FloatArray]
    noise: Sequence[float]

    def budget(
        self,
        extended: Sequence[FloatArray],
        without: Sequence[tuple[str, Sequence[FloatArray]]],
        correction: tuple[str, Sequence[FloatArray]] | None,
    ) -> "Budget":
        """Return the budget of an extended model.

        `without` holds the predictions of the model fitted again without each cause, `correction`
        those with the best unnamed correction.
        """
        return Budget(
            together=self.share("together", self.base, extended),
            causes=tuple(self.share(name, less, extended) for name, less in without),
            unnamed=self.share(correction[0], extended, correction[1]) if correction else None,
        )

    def share(self, what: str, before: Sequence[FloatArray], after: Sequence[FloatArray]) -> Share:
        """Return the share of the base's excess that `after` removes of what `before` leaves."""
        centre, half = jackknife(*self._of(before, after))
        return Share(what, centre, (centre - half, centre + half))

    def from_base(self, after: Sequence[FloatArray]) -> float:
        """Return the share that `after` removes of the base's excess, without its interval."""
        of, count = self._of(self.base, after)
        return of(np.ones(count, dtype=bool))

    @cached_property
    def _base_errors(self) -> list[FloatArray]:
        return self._errors(self.base)

    def _errors(self, predicted: Sequence[FloatArray]) -> list[FloatArray]:
        """Return the errors (n, channels) where any channel is judged, else nan."""
        judged = [counted(self.experiments, j) for j in range(len(self.noise))]
        parts = []
        for e, y, *rows in zip(self.experiments, predicted, *judged, strict=True):
            which, each = np.column_stack(rows), y.reshape(len(y), -1).T
            left = np.column_stack([e.errors(j, each[j]) for j in range(len(rows))])
            parts.append(np.where(which, left, np.nan)[which.any(axis=1)])
        return parts

    def _of(
        self, before: Sequence[FloatArray], after: Sequence[FloatArray]
    ) -> tuple[Callable[[BoolArray], float], int]:
        """Return the share over chosen parts, and their number, 0 where there is no excess."""
        old = self._base_errors if before is self.base else self._errors(before)
        sums, counts = parts_of(self._base_errors, old, self._errors(after))
        floor = np.asarray(self.noise, dtype=np.float64) ** 2
        whole = _powers(sums, counts)[0]
        weights = 1.0 / np.maximum(floor, max(_LEAST_NOISE * float(np.max(whole)), 1e-300))
        if not np.sum(weights * (whole - floor * (whole > 0))) > 0:
            return lambda _: 0.0, 0

        def of(kept: BoolArray) -> float:
            base, left, rest = _powers(sums[kept], counts[kept])
            error = float(weights @ base)
            excess = error - float(weights @ (floor * (counts[kept].sum(axis=0) > 0)))
            return float(weights @ (left - rest)) / max(excess, _LEAST_EXCESS * error, 1e-300)

        return of, len(counts)


def _powers(sums: FloatArray, counts: IndexArray) -> FloatArray:
    """Return the mean squares (models, outputs) over parts, 0 for an output without a sample."""
    values: FloatArray = np.sum(sums, axis=0) / np.maximum(np.sum(counts, axis=0), 1)
    return values


@dataclass(frozen=True)
class Budget:
    """Where the held-out error of the base model above the noise goes.

    `together` is what all causes remove, `causes` what each does with the others in the model
    (a fit without it leaves so much more), `unnamed` what the best unnamed correction would
    remove of the base's error (nothing named) or beyond the causes.
    """

    together: Share
    causes: tuple[Share, ...]
    unnamed: Share | None


@dataclass(frozen=True)
class StackBudget(Budget):
    """The same of a stack, in lengths [m].

    `excess_rms_m` is the base's error above the noise `noise_rms_m`; `remains_rms_m` and
    `remains_percent` of the range (each record's over that record's, as of all errors) are what the
    named causes leave above the noise.
    """

    excess_rms_m: float
    noise_rms_m: float
    remains_rms_m: float
    remains_percent: float


@dataclass(frozen=True, eq=False)
class Compared:
    """Predictions of a stack by a `base` and an `extended` model [m], of all records."""

    experiments: Sequence[Experiment]
    base: Sequence[FloatArray]
    extended: Sequence[FloatArray]

    @cached_property
    def parts(self) -> tuple[FloatArray, IndexArray]:
        """The parts of `held_out_parts` for both models."""
        return held_out_parts(self.experiments, self.base, self.extended)

    @property
    def gain(self) -> Gain:
        """The reduction of the held-out rms, with a jackknife interval of the errors' ratio.

        The interval is that of the ratio's logarithm over the parts.
        """
        sums, counts = self.parts
        records = sum(bool(e.held_out.any()) for e in self.experiments)
        centre, half = jackknife(lambda kept: _log_ratio(np.sum(sums[kept], axis=0)), len(counts))
        moves = (0.0, half, -half)
        gain, low, high = (100.0 * (1.0 - float(np.exp(centre + move))) for move in moves)
        return Gain(gain, (low, high), len(counts) if records >= FEWEST_RECORDS else 0)

    def lost_elsewhere(self, inflation: float) -> float:
        """Return what held-out samples lose, but for the part that gains most [nats].

        That is m ln(E/E_0) over the other parts: m their samples over the noise's `inflation`, E_0
        and E the errors' rms. Infinite where there is only one part.
        """
        sums, counts = self.parts
        if len(sums) < 2:
            return np.inf
        others = np.arange(len(sums)) != int(np.argmax(sums[:, 0] - sums[:, 1]))
        return float(counts[others].sum()) / inflation * _log_ratio(np.sum(sums[others], axis=0))

    def in_lengths(self, budget: Budget, noise: float) -> StackBudget:
        """Return the budget of the two models with its lengths, by the rms of the noise [m]."""
        powers = _powers(*self.parts)
        excess, remains = (float(np.sqrt(max(p - noise**2, 0.0))) for p in powers.tolist())
        whole = errors_of(self.experiments, self.extended)
        percent = whole.holdout_nrmse_percent * remains / max(whole.holdout_rms_m, 1e-300)
        return StackBudget(
            **vars(budget), excess_rms_m=excess, noise_rms_m=noise, remains_rms_m=remains,
            remains_percent=percent,
        )  # fmt: skip


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
    fitted = [not e.held_out_whole for e in fit.experiments]
    parts = held_out_residuals(fit.experiments, predicted)
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
    return excess if size > detection_limit_of(fit, limits) else Excess()


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
