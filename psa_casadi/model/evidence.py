"""What a model is good for: records, errors, ranges and covariance, kept with the model."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from psa_casadi.common.strict_json import brief
from psa_casadi.model.variables import Interval


@dataclass(frozen=True)
class HeldOut:
    """Error over held-out samples [m], with the 95 % interval of its rms.

    `nrmse_percent` is in percent of each record's range. `records` is the number of held-out
    records that the interval is taken over, 0 where it is blocks of fewer ones.
    """

    rms_m: float
    interval_m: Interval
    max_m: float
    nrmse_percent: float
    records: int = 0


@dataclass(frozen=True)
class ErrorShare:
    """What a cause or an unnamed correction removes of the base model's error, 0 to 1."""

    what: str
    share: float
    interval: Interval


@dataclass(frozen=True)
class ErrorBudget:
    """Where the base model's held-out error above the noise goes [m].

    `unnamed` is the correction without a name that the model does not hold, and what it would
    remove; `remains_m` is what the model leaves above the noise.
    """

    base_m: float
    noise_m: float
    remains_m: float
    remains_percent: float
    causes: tuple[ErrorShare, ...] = ()
    unnamed: ErrorShare | None = None


@dataclass(frozen=True)
class SeenRange:
    """Ranges of the records: voltage [V], its largest rate [V/s], longest duration [s].

    `temperature` [K] is None where no record has one.
    """

    voltage: Interval
    rate: float
    duration: float
    temperature: Interval | None = None


@dataclass(frozen=True)
class Covariance:
    """Covariance (k, k) of the free parameters in SI units, in the order of `names`."""

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def of(self, wanted: Collection[str]) -> "Covariance":
        """Return that of some parameters, whatever the others are."""
        kept = [k for k, n in enumerate(self.names) if n in wanted]
        names = tuple(self.names[k] for k in kept)
        return Covariance(names, tuple(tuple(self.matrix[i][k] for k in kept) for i in kept))


@dataclass(frozen=True)
class RecordRun:
    """How a record is played again: from these states, its time counted from its first sample.

    What the sensor shows is the model's displacement plus `offset_m`. `samples` counts those after
    blocks of `averaged` samples were averaged (1: none were). `held_out` lists stretches [first,
    stop) of held-out samples, which have the error `held_out_m` (rms, None without them);
    `fitted_m` is that of the others.
    """

    record: str
    sha256: str
    start: Mapping[str, float]
    offset_m: float
    samples: int
    averaged: int
    fitted_m: float
    held_out_m: float | None = None
    held_out: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class ReferenceRun:
    """The first part of a record in few samples: inputs, and the displacement that was measured.

    `time` (n,) [s] counts from its first sample, where `start` and `offset_m` are those of the
    record's `RecordRun`; `inputs` has columns (n,) that are linear in between. A displacement [m]
    that was not measured is None.
    """

    record: str
    time: tuple[float, ...]
    inputs: Mapping[str, tuple[float, ...]]
    displacement: tuple[float | None, ...]


@dataclass(frozen=True)
class Evidence:
    """The data behind the values of an identified or diagnosed model.

    `by` is the work that determined them. `fitted_m` is the error over the samples of the fit [m].
    `outside` names components of sensor and environment that the errors count with, and that an
    exported plant leaves out. `unnamed` names a correction without a cause that the model holds.
    """

    by: str
    fitted_m: float
    seen: SeenRange
    covariance: Covariance
    runs: tuple[RecordRun, ...] = ()
    reference: ReferenceRun | None = None
    held_out: HeldOut | None = None
    budget: ErrorBudget | None = None
    outside: tuple[str, ...] = ()
    unnamed: tuple[str, ...] = ()

    def of_parameters(self, wanted: Collection[str]) -> "Evidence":
        """Return the evidence with the covariance of some parameters only."""
        return replace(self, covariance=self.covariance.of(wanted))

    def run_of(self, record: str) -> RecordRun | None:
        """Return how the record of that name is played again."""
        return next((r for r in self.runs if r.record == record), None)


def contradictions(e: Evidence, parameters: Mapping[str, Any]) -> Iterator[str]:
    """Yield what cannot be in the evidence of a file, although each part alone could."""
    intervals = {"seen.voltage": e.seen.voltage, "seen.temperature": e.seen.temperature}
    sizes = [e.fitted_m, e.seen.rate, e.seen.duration]
    if e.held_out is not None:
        held = e.held_out
        intervals["held_out.interval_m"] = held.interval_m
        sizes += [held.rms_m, held.interval_m.low, held.max_m, held.nrmse_percent, held.records]
    for run in e.runs:
        sizes += [run.fitted_m, run.held_out_m or 0.0]
    if min(sizes) < 0.0:
        yield "'evidence' has an error, a rate or a duration below 0."
    for name, interval in intervals.items():
        if interval is not None and interval.low > interval.high:
            yield f"'evidence.{name}' is {brief(list(interval))}; give [low, high]."
    c, rows = e.covariance, e.covariance.matrix
    unknown = [n for n in c.names if n not in parameters]
    if unknown or len(set(c.names)) < len(c.names):
        yield f"'evidence.covariance.names' must name parameters, none twice; not {brief(unknown)}."
    if [len(c.names)] * len(c.names) != [len(row) for row in rows]:
        yield "'evidence.covariance.matrix' must have a row and a column for each name."
    elif any(row[i] < 0.0 for i, row in enumerate(rows)) or rows != tuple(zip(*rows, strict=True)):
        yield "'evidence.covariance.matrix' must be symmetric, with no variance below 0."
    yield from _bad_runs(e.runs, e.reference)


def _bad_runs(runs: Sequence[RecordRun], r: ReferenceRun | None) -> Iterator[str]:
    for run in runs:
        of, ends = f"'evidence.runs' of {brief(run.record)}", [k for s in run.held_out for k in s]
        if run.averaged < 1 or run.samples < 2:
            yield f"{of} must have samples, each of at least one."
        if any(a >= b for a, b in pairwise([-1, *ends, run.samples + 1])):
            yield f"{of} must have held-out stretches that follow each other within its samples."
        if (run.held_out_m is None) != (not run.held_out):
            yield f"{of} must have a held-out error and held-out samples, or neither."
    if r is None:
        return
    if r.record not in [run.record for run in runs]:
        yield f"'evidence.reference' is of {brief(r.record)}, which is not among the runs."
    if len(r.time) < 2 or any(a >= b for a, b in pairwise(r.time)):
        yield "'evidence.reference.time' must have two or more increasing times."
    columns = [r.displacement, *r.inputs.values()]
    if "voltage" not in r.inputs or any(len(c) != len(r.time) for c in columns):
        yield "'evidence.reference' must have a voltage, and a value of each column for each time."
