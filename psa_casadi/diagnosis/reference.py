"""What changed since? A device's records against those of the same device when it was healthy.

The base model is fitted to the healthy records and held: of the new ones only the starts and the
offsets are fitted. What the base leaves of the healthy records, the discrepancy of the sound
device, is learnt and taken off the new displacements,

    y' = y - d(v),   d = Phi(v) w,   or the mean of what is left wherever v was played before.

Phi holds the forms of the unnamed corrections that follow the voltage (`corrections.KINDS`), all at
once, with w_k ~ N(0, (s p_k)^2) and a separate size s for each form: the sizes that predict
held-out blocks of what is left best. Of y' the causes are named as ever, in fewer steps: there is
no base to be fitted again. By what healthy records are predicted from one another worse than their
noise a sound device may differ: less than that is nothing that changed.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.notes import note
from psa_casadi.common.units import BoolArray, FloatArray
from psa_casadi.diagnosis.corrections import KINDS, Signals, responses, time_constants
from psa_casadi.diagnosis.noise import noise_floor
from psa_casadi.diagnosis.result import StackDiagnosis
from psa_casadi.diagnosis.task import Method
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.refitting import noise_levels
from psa_casadi.records.drive import reversals
from psa_casadi.records.noise import high_frequency_noise
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, whole
from psa_casadi.simulation.timings import stage

#: Forms that follow the voltage, at their ports. Others go with the time of a record.
_FORMS = (
    ("curve", "drive voltage"), ("direction", "force"), ("memory", "force"),
    ("relaxation", "force"), ("modes", "force"),
)  # fmt: skip
#: Smallest ratio of the shortest record to the time constant of a relaxation that is used: slower
#: ones depend on what was before.
_SETTLES = 10.0
#: Number of blocks of all healthy samples, and of the folds that hold them out in turn.
_BLOCKS, _FOLDS = 12, 6
#: Sizes s that are tried, over the noise; rounds through all forms, while they gain this share.
_SIZES, _ROUNDS, _GAIN = (0.0, *np.geomspace(0.01, 100.0, 9).tolist()), 3, 1e-3
#: Share of their range, rms, to which voltages are the same; least share of the new record that
#: recurs, largest number of places; largest relative difference of sampling intervals.
_SAME, _FOUND, _PLACES, _STEP = 2e-3, 0.9, 64, 1e-3
#: Evaluations of a fit of the base to a part of the healthy records, or of one of its parameters.
_EVALUATIONS = 12
#: Steps of the method that fit the base anew, or sets of causes: one thing changes, seldom two.
_BASE_STEPS = frozenset({
    "fits afresh", "all afresh", "base again", "resonances", "between samples", "begun again",
    "several modes", "several at once", "exchange",
})  # fmt: skip
#: Causes at most, and share of what the other removes that a second one must: the form of a large
#: change is not known better.
_CAUSES, _FURTHER = 2, 0.1
#: A sample is like a healthy one within this share of the voltages' range; a reference shows this
#: share of the new samples at least; smaller turns are no reversals.
_NEAR, _LEAST, _TURNS = 0.1, 0.25, 0.01
#: Multiple of what healthy records differ by that is no change, where the new voltage was played
#: before and where not; and the share of the range by which any stack does.
_MORE, _REPEATS = (1.5, 2.0), 1e-3
#: A test's share of what is left may be larger than what is open.
_DEAF = 2.0
#: Verdicts with which no parameter is fitted; parameters that no healthy record may determine, but
#: a change of which shows.
_NOTHING, _SCALES = ("adequate", "not_driven"), ("k_P", "k")
#: A parameter has changed where it leaves no more than this share of what has; it replaces causes
#: where it leaves less than this share of what they do, from a share of the noise on.
_REST, _CLEARLY, _FORM = 0.1, 0.5, 0.3
#: Ratio of rms to that of the best parameter below which a parameter explains as much.
_ALIKE = 1.02


#: Diagnoses by a method, with parameters of the base free.
Diagnosed = Callable[[Method, tuple[str, ...]], StackDiagnosis]


@dataclass(frozen=True, eq=False)
class Healthy:
    """What is known of a device from its healthy records: the base `fit` of all their samples."""

    fit: Fit

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        """The healthy records."""
        return self.fit.experiments

    @cached_property
    def residuals(self) -> list[FloatArray]:
        """Measured minus predicted of every record (n,) [m], about its mean, nan where none."""
        pairs = zip(self.experiments, self.fit.predicted(), strict=True)
        left = [np.where(e.used, e.record.measured - y, np.nan) for e, y in pairs]
        return [r - np.nanmean(r) for r in left]

    def adds(self, records: Sequence[Record]) -> tuple[list[FloatArray], int]:
        """Return what the device adds to its base model on the voltages of records (n,) [m].

        And the number of places at which such a voltage was played before.
        """
        each = self._forms(records)
        columns = [np.hstack(parts) for parts in zip(*each, strict=True)]
        which = np.repeat(np.arange(len(each)), [parts[0].shape[1] for parts in each])
        valid = [np.isfinite(r) for r in self.residuals]
        rows = np.vstack([c[s] for c, s in zip(columns, valid, strict=False)])
        target = np.concatenate([r[s] for r, s in zip(self.residuals, valid, strict=True)])
        weights = _ridge(rows, target, which)
        smooth = [c @ weights for c in columns[len(self.experiments) :]]
        result = [self._again(r, parts) for r, parts in zip(records, smooth, strict=True)]
        return [parts for parts, _ in result], min(n for _, n in result)

    def _forms(self, records: Sequence[Record]) -> list[list[FloatArray]]:
        """Return the columns (n, k) of every form, along the healthy records and further ones."""
        plain = [*(e.record for e in self.experiments), *records]
        every = [_twice(r) for r in plain]
        signals = Signals(every, [e.record.voltage for e in every], responses(self.fit, every))
        shortest = min(r.duration for r in plain)
        settled = time_constants([e.record for e in every]) < shortest / _SETTLES
        forms = []
        for kind in (k for k in KINDS if (k.name, k.port) in _FORMS):
            parts = [kind.columns(signals, k)[r.n :] for k, r in enumerate(plain)]
            if kind.name == "relaxation":
                parts = [p[:, settled] for p in parts]
            largest = np.std(np.vstack(parts[: len(self.experiments)]), axis=0)
            scale = kind.shape(parts[0].shape[1]) / max(float(largest.max(initial=0.0)), 1e-300)
            forms.append([(p - p.mean(axis=0)) * scale for p in parts])
        return forms

    def shows(self, record: Record) -> BoolArray:
        """Return where a record's voltage is as it was in the healthy ones before (n,).

        In value, rate and the two last reversals: what a stack remembers of a voltage at least.
        """
        span = max(float(np.ptp(e.record.voltage)) for e in self.experiments)
        old = np.vstack([_place(e.record, span) for e in self.experiments])
        apart, _ = cKDTree(old).query(_place(record, span), p=np.inf, distance_upper_bound=_NEAR)
        return np.isfinite(apart)

    def _again(self, record: Record, values: FloatArray) -> tuple[FloatArray, int]:
        """Return the mean of what is left wherever the voltage of a record was played before (n,).

        What is `values` without, where it was not; and the number of places.
        """
        total, count, places = np.zeros(record.n), np.zeros(record.n), 0
        for e, residual in zip(self.experiments, self.residuals, strict=True):
            if abs(e.record.sample_time / record.sample_time - 1.0) > _STEP:
                continue
            for lag in _lags(record.voltage, e.record.voltage):
                first, last = max(0, -lag), min(record.n, e.record.n - lag)
                apart = residual[first + lag : last + lag] - values[first:last]
                there = np.isfinite(apart)
                total[first:last] += np.where(there, apart - np.nanmean(apart), 0.0)
                count[first:last] += there
                places += 1
        return values + total / np.maximum(count, 1.0), places

    @cached_property
    @stage("reference")
    def open(self) -> float:
        """What the device may differ by beyond the noise, rms [m].

        Each of the healthy records, or half of a single one, is predicted from the others.
        """
        parts = [e.record for e in self.experiments]
        if len(parts) == 1:
            half = parts[0].n // 2
            parts = [parts[0].slice(0, half), parts[0].slice(half, parts[0].n)]
        powers, counts = [0.0], [1]
        for k, part in enumerate(parts):
            others = tuple(whole(r) for j, r in enumerate(parts) if j != k)
            with suppress(PsaError):
                powers.append(max(self._unlike(part, others), 0.0))
                counts.append(part.n)
        return float(np.sqrt(np.average(powers, weights=counts)))

    def _unlike(self, part: Record, others: tuple[Experiment, ...]) -> float:
        """Return the power [m^2] beyond the noise of what others do not predict of a record."""
        other = fit(
            self.fit.model, others, self.fit.unknowns.names,
            sigma=noise_levels(others), evaluations=_EVALUATIONS,
        )  # fmt: skip
        (rest,), _ = Healthy(other).since([part]).taken_off(1)
        new = [whole(rest)]
        left = fit(other.model, new, (), sigma=noise_levels(new)).residuals
        (floor,) = noise_floor([rest], [left])
        return float(np.mean(left**2)) - floor.level**2

    def since(self, records: Sequence[Record]) -> "Since":
        """Predict what the base leaves on new records, were the device as it was.

        Raises InputError where hardly a new sample is like a healthy one.
        """
        added, places = self.adds(records)
        covered = tuple(self.shows(r) for r in records)
        for r, share in zip(records, covered, strict=True):
            if np.mean(share) < _LEAST:
                raise InputError(
                    f"{r.name}: the voltage is as in the reference, in value, rate and last"
                    f" reversals, for {np.mean(share):.0%} of the samples; what has changed"
                    " cannot be separated from the rest. Record the device with the voltage of the"
                    " reference."
                )
        return Since(self, tuple(records), tuple(added), covered, places)


@dataclass(frozen=True, eq=False)
class Since:
    """New records with what the sound device adds to the base on them, `added` (n,) [m].

    Only samples count whose voltage is `covered` (n,) by healthy records; all of it recurs at
    `places` among these.
    """

    healthy: Healthy
    records: tuple[Record, ...]
    added: tuple[FloatArray, ...]
    covered: tuple[BoolArray, ...]
    places: int

    def taken_off(self, first: int) -> tuple[tuple[Record, ...], tuple[Record, ...]]:
        """Return the new records without it, the first ones (as many as `first`) and the others."""
        rows = zip(self.records, self.added, self.covered, strict=True)
        result = tuple(
            replace(r, displacement=np.where(s, r.measured - a, np.nan)) for r, a, s in rows
        )
        return result[:first], result[first:]

    @property
    def open(self) -> float:
        """What is no change, rms [m]: a multiple of what healthy records differ by."""
        more = _MORE[0] if self.places else _MORE[1]
        widest = max(r.range_m for r in self.records)
        return max(more * self.healthy.open, _REPEATS * widest)

    def method(self, method: Method) -> Method:
        """Return the method for a base that is held, and a change that may be large."""
        limits = method.thresholds
        limits = replace(
            limits,
            further=max(limits.further, _FURTHER),
            most_causes=min(limits.most_causes, _CAUSES),
        )
        return replace(method, without=method.without | _BASE_STEPS, thresholds=limits)

    def deaf(self, method: Method, level: float) -> Method:
        """Return the method for which less than a level, rms [m], does not count."""
        widest = max(r.range_m for r in self.records)
        limits = replace(method.thresholds, form_of_range=_DEAF * level / widest)
        return replace(method, thresholds=limits)

    def concluded(self, method: Method, diagnosed: Diagnosed) -> StackDiagnosis:
        """Diagnose by a method, and report what was taken off and which parameter has changed.

        What is left of no more
        than is open is no change. A parameter takes the place of the causes where it leaves clearly
        less above the noise than they do, and a stiffness where it leaves as little; what it
        leaves is its form. Another that leaves as little is reported with them.
        """
        result, rms = diagnosed(method, ()), np.sqrt(np.mean(np.concatenate(self.added) ** 2))
        noise, base, least = result.noise_floor_rms_m, result.base_fit, self.open**2
        excess = base.rms**2 - noise**2
        if excess < least and result.verdict not in _NOTHING:
            result = diagnosed(self.deaf(method, self.open), ())
        notes = [
            note("since", removed=(float(rms), "m"), places=self.places, open=(self.open, "m"),
                 shown=float(np.mean(np.concatenate(self.covered))))
        ]  # fmt: skip
        best = None if result.verdict in _NOTHING else self._moved(result)
        if best is not None:
            (name,) = best.unknowns.names
            left, theirs = (f.rms**2 - noise**2 for f in (best, result.extended_fit))
            form = (_FORM * noise) ** 2
            as_good = left < max(theirs, 0.0) + form
            alone = left < _CLEARLY * theirs and theirs > least + form
            alone |= as_good and name in _SCALES  # no effect is a gain alone
            if left < max(_REST * excess, least + form) and (alone or as_good):
                if alone:
                    deaf = self.deaf(method, float(np.hypot(best.rms, self.open)))
                    result = diagnosed(deaf, (name,))
                unit = base.model.parameter(name).unit
                values = (base.model.values[name], best.model.values[name])
                notes.append(note("since_moved", name=name, values=values, unit=unit, alone=alone))
        return replace(result, remarks=(*notes, *result.remarks))

    def _moved(self, stack_diagnosis: StackDiagnosis) -> Fit | None:
        """Fit every parameter of the base alone; return the fit that leaves least.

        The stiffness, which is a gain of slow records, comes first of those that leave as little.
        """
        fits, base = [], stack_diagnosis.base_fit
        for name in dict.fromkeys((*self.healthy.fit.unknowns.names, *_SCALES)):
            if name in base.model.values:
                with suppress(PsaError):
                    fits.append(
                        fit(base.model, stack_diagnosis.experiments, (name,), sigma=base.sigma,
                            start_states=base.starts(), evaluations=_EVALUATIONS)
                    )  # fmt: skip
        best = min((f.rms for f in fits), default=0.0)
        similar = (f for f in fits if f.rms < _ALIKE * best)
        return min(similar, key=lambda f: (f.unknowns.names[0] not in _SCALES, f.rms), default=None)


def _place(record: Record, span: float) -> FloatArray:
    """Return value, two last reversals and rate of a voltage (n, 4), over the span `span` [V].

    A factor of four in the mean rate since the last reversal counts as `_NEAR`.
    """
    twice = _twice(record).record
    turns = np.r_[0, reversals(twice.voltage, _TURNS * span), 2 * record.n - 1]
    k = np.arange(record.n, 2 * record.n)
    after = np.clip(np.searchsorted(turns, k), 1, turns.size - 1)
    last, before, then = (twice.voltage[turns[np.maximum(after - j, 0)]] for j in (1, 2, 0))
    lasts = twice.time[turns[after]] - twice.time[turns[after - 1]]
    rate = np.abs(then - last) / np.maximum(lasts, record.sample_time)
    steepness = _NEAR * np.log(np.maximum(rate, 1e-9 * span)) / np.log(4.0)
    return np.column_stack([twice.voltage[k] / span, last / span, before / span, steepness])


def _twice(record: Record) -> Experiment:
    """Return a voltage played twice: the memory of the second time is that of the first."""
    later = record.time[-1] - record.time[0] + record.sample_time
    time, voltage = np.r_[record.time, record.time + later], np.tile(record.voltage, 2)
    return whole(Record(name=record.name, time=time, voltage=voltage))


def _ridge(columns: FloatArray, target: FloatArray, which: npt.NDArray[np.integer]) -> FloatArray:
    """Return the weights of columns (n, k), by the sizes that predict held-out blocks best.

    `which` (k,) is the form to which each column belongs; every form has a size.
    """
    noise, size = max(high_frequency_noise(target), 1e-300), columns.shape[1]
    squares = np.zeros((_FOLDS, size, size))
    along, power = np.zeros((_FOLDS, size)), np.zeros(_FOLDS)
    edges = np.linspace(0, target.size, _BLOCKS + 1).astype(int).tolist()
    for block, (a, b) in enumerate(pairwise(edges)):
        x, y, fold = columns[a:b], target[a:b], block % _FOLDS
        squares[fold] += x.T @ x
        along[fold] += x.T @ y
        power[fold] += y @ y
    total, whole_along = squares.sum(axis=0), along.sum(axis=0)

    def solved(sizes: FloatArray, g: FloatArray, c: FloatArray) -> FloatArray:
        on = np.flatnonzero(sizes[which])
        s, values = noise * sizes[which][on], np.zeros(size)
        matrix = s[:, None] * g[np.ix_(on, on)] * s + noise**2 * np.eye(s.size)
        values[on] = s * np.linalg.solve(matrix, s * c[on])
        return values

    def held_out_error(sizes: FloatArray) -> float:
        left = 0.0
        for g, c, p in zip(squares, along, power, strict=True):
            w = solved(sizes, total - g, whole_along - c)
            left += p - 2.0 * float(c @ w) + float(w @ g @ w)
        return left

    sizes = np.zeros(int(which.max(initial=0)) + 1)
    best = held_out_error(sizes)
    for _ in range(_ROUNDS):
        before = best
        for k in range(sizes.size):
            for s in _SIZES:
                trial = sizes.copy()
                trial[k] = s
                left = held_out_error(trial)
                if left < best:
                    best, sizes = left, trial
        if best > (1.0 - _GAIN) * before:
            break
    return solved(sizes, total, whole_along)


def _lags(new: FloatArray, old: FloatArray) -> list[int]:
    """Return the lags at which a voltage was played before, old[k + lag] = new[k].

    Mean squares of the difference over the samples that both have, by the fast Fourier transform.
    """
    span, least = float(np.ptp(new)), int(_FOUND * new.size)
    every = np.arange(-new.size + 1, old.size)
    first, last = np.maximum(0, -every), np.minimum(new.size, old.size - every)
    long = last - first >= least
    every, first, last = every[long], first[long], last[long]
    if span <= 0.0 or not every.size:
        return []
    size = 1 << (new.size + old.size).bit_length()
    product = np.fft.irfft(np.fft.rfft(old, size) * np.conj(np.fft.rfft(new, size)), size)[every]
    of_new, of_old = (np.r_[0.0, np.cumsum(v**2)] for v in (new, old))
    apart = of_new[last] - of_new[first] + of_old[last + every] - of_old[first + every]
    apart = (apart - 2.0 * product) / (last - first)
    kept: list[int] = []
    for k in sorted(np.flatnonzero(apart < (_SAME * span) ** 2).tolist(), key=lambda k: apart[k]):
        if len(kept) < _PLACES and all(abs(int(every[k]) - other) > 2 for other in kept):
            kept.append(int(every[k]))
    return kept
