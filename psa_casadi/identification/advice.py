"""Which further record would determine what the records at hand leave open."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, floor, log10
from typing import Literal

import numpy as np

from psa_casadi.common.display import Worded
from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.determinacy import (
    DETERMINED_WIDTH,
    Determinacy,
    prior_information,
    record_information,
    sizes_of,
    standard_errors,
)
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.compose import Model
from psa_casadi.records.drive import reversals
from psa_casadi.records.excitation import decaying_triangle, multisine, sine, time_grid
from psa_casadi.records.record import Record
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.start import settling_time

#: Samples of a planned step, multisine, loop (per period) and hold.
STEP_SAMPLES, MULTISINE_SAMPLES, LOOP_SAMPLES, HOLD_SAMPLES = 2000, 3000, 400, 2000
#: Highest tone of a multisine over the sampling rate.
_BAND = 0.2
#: Sampling intervals that are tried, at most.
_RUNGS = 6
#: Samples within the shortest lag at the fastest rate that is tried.
_FINEST = 5.0
#: A loop this much slower than the stack's settling is quasi-static.
_QUASI_STATIC = 0.05
_CYCLES = 6
#: Parameters that stand for a lag.
_LAGS = ("tau", "R_s", "c_P", "c_B", "c")
#: Longest loops that are advised have this frequency [Hz].
_SLOWEST = 1e-3
_LONGEST_HOLD = 7200.0


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned record (no displacement) of a kind, and the sampling rate [Hz] it needs.

    From `low` to `high` [V]; `frequency` [Hz] is the highest tone of a multisine or that of loops,
    of which there are `cycles`; `length` [s] is that of the plan.
    """

    kind: Literal["step", "multisine", "loop", "minor loops", "hold"]
    record: Record
    rate: float
    low: float
    high: float
    length: float
    frequency: float = 0.0
    cycles: int = 0

    @property
    def duration(self) -> float:
        """Length from the first sample to the last [s]."""
        return self.record.duration


def plans(models: Sequence[Model], records: Sequence[Record]) -> list[Plan]:
    """Return steps and multisines at several sampling rates, loops, and holds where effects ask.

    All use the voltages of the records and begin at rest at the lowest; rates and frequencies suit
    every one of the models.
    """
    settling = max(settling_time(m) for m in models)
    low = min(float(np.min(r.voltage)) for r in records)
    high = max(float(np.max(r.voltage)) for r in records)
    now = 1.0 / min(r.sample_time for r in records)
    finest = _round(
        _FINEST / min(_lag(m.values, n) for m in models for n in _LAGS if n in m.values)
    )
    lowest = _round(min(now, 20.0 / settling, finest))
    count = min(_RUNGS, ceil(2.0 * log10(finest / lowest)) + 1)
    rates = sorted({_round(float(r)) for r in np.geomspace(lowest, finest, count)})
    result = [p for rate in rates for p in _fast(rate, low, high)]
    # loops of a frequency at which records cycle slowly, else of a quasi-static one
    limit = _QUASI_STATIC / settling
    turns = [(len(reversals(r.voltage)), r.duration) for r in records]
    cycling = [count / (2.0 * length) for count, length in turns if count >= 2]
    slow = [f for f in cycling if f <= limit]
    result += _loops(_round(float(np.median(slow)) if slow else 0.1 * limit), settling, low, high)
    if models[0].effects:
        longest = max(r.duration for r in records)
        lengths = [longest * k for k in (10.0, 100.0) if longest * k <= _LONGEST_HOLD]
        result += [
            _stepped("hold", HOLD_SAMPLES / n, HOLD_SAMPLES, low, high, HOLD_SAMPLES)
            for n in lengths
        ]
    return result


def _round(value: float) -> float:
    """Return the next number of the series 1, 2, 5 upwards."""
    power = 10.0 ** floor(log10(value))
    return next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= 0.999 * value)


def _fast(rate: float, low: float, high: float) -> Iterator[Plan]:
    yield _stepped("step", rate, STEP_SAMPLES, low, high, STEP_SAMPLES // 2)
    length = MULTISINE_SAMPLES / rate
    time = time_grid(length, 1.0 / rate)
    tones = multisine(time, low, high, (2.0 / length, _BAND * rate), seed=1)
    voltage = low + (tones - low) * np.minimum(10.0 * time / length, 1.0)
    record = Record(name="multisine", time=time, voltage=voltage)
    yield Plan("multisine", record, rate, low, high, length, _BAND * rate)


def _stepped(
    kind: Literal["step", "hold"], rate: float, samples: int, low: float, high: float, stop: int
) -> Plan:
    """Return a step up after a hundredth of the samples, and down again at sample `stop`."""
    time = time_grid(samples / rate, 1.0 / rate)
    voltage = np.full(time.shape, low)
    voltage[samples // 100 : stop] = high
    record = Record(name=kind, time=time, voltage=voltage)
    return Plan(kind, record, rate, low, high, samples / rate)


def _loops(frequency: float, settling: float, low: float, high: float) -> Iterator[Plan]:
    cases = [(k * frequency, high) for k in (0.01, 0.1, 1.0) if k * frequency > _SLOWEST]
    cases.append((frequency, 0.5 * (low + high)))
    if 10.0 * frequency * settling <= _QUASI_STATIC:
        cases.append((10.0 * frequency, high))
    for f, top in cases:
        time = time_grid(2.0 / f, 1.0 / (LOOP_SAMPLES * f))
        record = Record(name="loop", time=time, voltage=sine(time, low, top, f))
        yield Plan("loop", record, LOOP_SAMPLES * f, low, top, 2.0 / f, f, 2)
    rate, length = LOOP_SAMPLES * frequency, _CYCLES / frequency
    time = time_grid(length, 1.0 / rate)
    voltage = decaying_triangle(time, low, high, _CYCLES)
    record = Record(name="loops", time=time, voltage=voltage)
    yield Plan("minor loops", record, rate, low, high, length, frequency, _CYCLES)


#: Parameters that only fast records determine; a fit leaves them at their start where it must.
SEARCHABLE = ("tau", "R_s", "c_P", "c_B", "c", "m_P", "m_B", "m")
#: Weights by which the open lags share their sum, and the damping ratio of open masses. No two
#: lags are equal: no record separates two equal poles.
_CASES: tuple[tuple[Mapping[str, float], float], ...] = (
    ({"tau": 10.0, "R_s": 2.0, "c_P": 1.0, "c_B": 4.0, "c": 4.0}, 2.0),
    ({"tau": 2.0, "R_s": 4.0, "c_P": 1.0, "c_B": 10.0, "c": 10.0}, 0.3),
)


def scenarios(model: Model, open_names: Collection[str]) -> list[Model]:
    """Return models that agree with the records and fill in what these leave open.

    The sum of the open lags (tau, R_s C_p, c/k) stays what was identified; once tau has most of it
    and open masses are overdamped (damping ratio zeta = 2), once the mechanics have most of it and
    open masses ring (zeta = 0.3): m = (c/2 zeta)^2 / k. An estimate of an open parameter may be
    anything, a bound included, so a forecast must not rest on it. Values stay within their bounds.
    """
    names = [n for n in SEARCHABLE if n in model.values and n in open_names]
    lags = [n for n in names if n in _LAGS]
    total, models = sum(_lag(model.values, n) for n in lags), []
    for weights, damping in _CASES:
        values = dict(model.values)
        for name in lags:
            share = weights[name] / sum(weights[n] for n in lags)
            values[name] *= share * total / _lag(model.values, name)
        for name in names:
            if name not in weights:
                c, k = (values[q + name[1:]] for q in "ck")
                values[name] = (0.5 * c / damping) ** 2 / k
            values[name] = float(np.clip(values[name], *model.parameter(name).bounds))
        models.append(model.with_values(values))
    return models


def _lag(values: Mapping[str, float], name: str) -> float:
    """Return the lag [s] of a parameter."""
    if name == "tau":
        return values["tau"]
    if name == "R_s":
        return values["R_s"] * values["C_p"]
    return values[name] / values["k" + name[1:]]


#: A plan with its information in every scenario (s, k, k), and with what it determines.
_Option = tuple[Plan, FloatArray]
_Gain = tuple[Plan, FloatArray, tuple[str, ...]]

#: A record is advised where it brings a standard error below this: half of what still counts.
_SURE = 0.5 * DETERMINED_WIDTH
#: How often a record is repeated where once is not enough.
_REPEATS = (1, 2, 5, 10)


@dataclass(frozen=True, eq=False)
class Advice(Worded):
    """A record to measure next, `repeats` times, and the parameters that it determines.

    `single` does so by itself, as well as those `instead` of it, `together` with what is advised
    before it. `plan` is None where the advice is none to measure a record: masses that show if the
    mechanics ring (`ringing`), parameters that none of the plans `tried` determines (`nothing`),
    and the scale of `force`, which no record determines.
    """

    kind: Literal["single", "together", "ringing", "nothing", "force"]
    parameters: tuple[str, ...] = ()
    plan: Plan | None = None
    repeats: int = 1
    instead: tuple[Plan, ...] = ()
    tried: int = 0

    @property
    def record(self) -> Record | None:
        """The record's voltage, without a displacement; None where none is to be measured."""
        return None if self.plan is None else self.plan.record


def advice(
    fit: Fit, determinacy: Determinacy, *, force_scale_given: bool = False
) -> tuple[Advice, ...]:
    """Return further records that would determine what is open, the shortest first.

    Open are the undetermined parameters of the fit and the lags and masses (`SEARCHABLE`) that it
    did not search because the records say too little. Each of `plans` is predicted in the two
    `scenarios` that fill these in; its information is added to that of the records at hand (the
    residuals' colour lowers the latter, the residuals' level is the noise of the former). A record
    is advised if in both it brings the standard error of an open parameter to half of what counts
    as determined; masses that only show where the mechanics ring are named apart. Records that
    determine much come before others, those that need no faster sampling than the records at hand
    before others. What no single one determines may need several, or repeats.
    """
    return _Adviser(fit, determinacy).all(force_scale_given)


class _Adviser:
    """The information at hand and in every plan, for the fit's parameters and the fixed lags."""

    def __init__(self, fit: Fit, of: Determinacy) -> None:
        self._fit, self._determinacy, self._experiments = fit, of, fit.experiments
        extra = [n for n in SEARCHABLE if n in fit.model.values and n not in of.names]
        self._names = (*of.names, *extra)
        self._noise = max(fit.rms, min(fit.sigma))
        known, count = self._at_hand(fit.model), len(of.names)
        # by how much the residuals' level and colour widen the intervals, squared
        white = standard_errors(known[:count, :count] + prior_information(fit.model, of.names))
        sizes = np.abs(sizes_of(fit.model, of.names))
        relative = np.array([of.standard_errors[n] for n in of.names]) / sizes
        sure = relative < DETERMINED_WIDTH
        ratio = max(float(np.median((relative / white)[sure] ** 2)), 1.0) if sure.any() else 1.0
        errors = standard_errors(known / ratio + prior_information(fit.model, self._names))
        wide = {n for n, e in zip(self._names, errors, strict=True) if e > DETERMINED_WIDTH}
        self._open = {*of.undetermined, *(wide & set(extra))}
        self._scenarios = scenarios(fit.model, self._open) if self._open else []
        self._known = np.array(
            [self._at_hand(m) / ratio + prior_information(m, self._names) for m in self._scenarios]
        )

    def _at_hand(self, model: Model) -> FloatArray:
        """Return the information (k, k) of the records at hand, without priors."""
        fit = self._fit
        parts = [
            record_information(
                model,
                e.record,
                self._names,
                fit.sigma[r],
                start=fit.start(r),
                sizes=dict(zip(fit.start(r), fit.unknowns.start_scale[r].tolist(), strict=True)),
                used=e.used,
            )
            for r, e in enumerate(self._experiments)
        ]
        information: FloatArray = np.sum(parts, axis=0)
        return information

    def all(self, force_scale_given: bool) -> tuple[Advice, ...]:
        """Return the whole advice in its order."""
        results: list[Advice] = []
        left, known, counts = set(self._open), self._known, dict[Plan, int]()
        options = self._options() if left else []
        for plan, information, gain in self._cover(options, left):
            known, counts[plan] = known + information, 1
            instead = tuple(  # plans of the other fast kind that do as well at the same rate
                other
                for other, its_information in options
                if other.rate == plan.rate
                and {other.kind, plan.kind} == {"step", "multisine"}
                and set(gain) <= set(self._gain(self._known + its_information, self._open))
            )
            results.append(Advice("single", gain, plan, instead=instead))
        wanted = left & set(self._determinacy.names)
        while wanted and (more := self._more(options, known, wanted)) is not None:
            plan, information, repeats = more
            known = known + repeats * information
            gain = self._gain(known, left)
            counts[plan] = counts.get(plan, 0) + repeats
            kind: Literal["together", "single"] = "together" if results else "single"
            results.append(Advice(kind, gain, plan, counts[plan]))
            left, wanted = left - set(gain), wanted - set(gain)
        # masses that are sure where the mechanics ring, the last scenario
        sure = self._gain(known[-1:], left) if results else ()
        ringing = tuple(n for n in sure if n[0] == "m")
        left -= set(ringing)
        rest = tuple(n for n in self._names if n in left)
        results += [Advice("ringing", ringing)] if ringing else []
        results += [Advice("nothing", rest, tried=len(options))] if rest else []
        results += [] if force_scale_given else [Advice("force")]
        return tuple(results)

    def _options(self) -> list[_Option]:
        """Return every plan that can be simulated, with its information in every scenario."""

        def one(plan: Plan) -> _Option | None:
            try:
                results = [
                    record_information(m, plan.record, self._names, self._noise)
                    for m in self._scenarios
                ]
            except PsaError:
                return None
            return plan, np.array(results)

        records = [e.record for e in self._experiments]
        results = side_by_side(one, plans(self._scenarios, records))
        return [option for option in results if option is not None]

    def _gain(self, information: FloatArray, left: set[str]) -> tuple[str, ...]:
        """Return the parameters of `left` that are sure with this information in every scenario."""
        errors = np.max([standard_errors(i) for i in information], axis=0)
        return tuple(n for k, n in enumerate(self._names) if n in left and errors[k] < _SURE)

    def _cover(self, options: Sequence[_Option], left: set[str]) -> list[_Gain]:
        """Choose plans that each determine something alone, and take it out of `left`."""
        gains = [(plan, i, self._gain(self._known + i, left)) for plan, i in options]
        chosen: list[_Gain] = []
        while useful := [g for g in gains if left & set(g[2])]:
            best = min(useful, key=lambda g: (-len(left & set(g[2])), *self._effort(g[0], 1)))
            chosen.append(best)
            left -= set(best[2])
        return sorted(chosen, key=lambda g: g[0].duration)

    def _effort(self, plan: Plan, repeats: int) -> tuple[float, float]:
        """Return how much faster a plan samples than the records do, and how long it takes."""
        now = 1.0 / min(e.record.sample_time for e in self._experiments)
        return max(plan.rate / now, 1.0), repeats * plan.duration

    def _more(
        self, options: Sequence[_Option], known: FloatArray, left: set[str]
    ) -> tuple[Plan, FloatArray, int] | None:
        """Return the plan that determines most of what is left, with the fewest repeats."""
        for repeats in _REPEATS:
            gains = [(p, i, self._gain(known + repeats * i, left), repeats) for p, i in options]
            useful = [g for g in gains if g[2]]
            if useful:
                best = min(useful, key=lambda g: (-len(g[2]), *self._effort(g[0], g[3])))
                return best[0], best[1], repeats
        return None
