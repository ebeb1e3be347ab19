"""Which way every effect takes in `simulate`, and whether the error is what was asked for.

The truth is the stepper at 1e-11. Records with kinks and jumps are the hard ones: drivers turn and
rest there within a sample.
"""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import FIT_RTOL
from psa_casadi.identification.identify import identify
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import STACKS, stack_model
from psa_casadi.records import (
    Record,
    concatenate,
    decaying_triangle,
    read_record,
    steps,
    time_grid,
    triangle,
)
from psa_casadi.report.words.phrases import number, plain
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation import simulate as simulate_module
from psa_casadi.simulation.exact.run import NotExact
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.simulate import (
    EXACT,
    STEP_SHARE,
    STEPPER,
    Way,
    input_samples,
    simulate,
    trace,
)
from psa_casadi.simulation.start import start_on
from psa_casadi.simulation.stepper import run
from psa_casadi.simulation.timings import timed
from tests.model.stack_models import at_ordinary_size
from tests.studies.benchmarks.table import Progress, TitledTable, share
from tests.studies.plants.again import play_again
from tests.studies.plants.make import make_record

FloatArray = npt.NDArray[np.float64]

BASE_NAME = "base"
#: Corners (share of the record, share of the rated voltage) of the records with kinks.
KINKED: dict[str, tuple[tuple[float, float], ...]] = {
    "triangles": tuple((k / 8.0 + 0.0003 * (0 < k < 8), 0.8 * (k % 2)) for k in range(9)),
    "steps": (
        (0.0, 0.0), (0.1, 0.0), (0.1, 0.7), (0.4, 0.7), (0.4, 0.2), (0.7, 0.2), (0.7, 0.9), (1, 0.9)
    ),
    "ramps and holds": ((0, 0), (0.1, 0), (0.3, 0.8), (0.5, 0.8), (0.6, 0.3), (0.8, 0.3), (1, 0)),
}  # fmt: skip
MIXED = "sine, ramp, hold, step"
_SAMPLES, _OUTPUT = 1500, "measured_displacement"
_RTOLS = (1e-4, 1e-5, 1e-6)
_TRUTH, _CHECK = 1e-11, 1e-10
_LISTED = 20


@dataclass(frozen=True)
class Trial:
    """A stack with one effect or none, on a record of 1500 samples at one sample time [s]."""

    stack: str
    effect: str
    record: str
    sample_time: float


@dataclass(frozen=True)
class Reached:
    """What a trial reached at one tolerance: way, error over the range, processor time [s].

    `stepper_error` and `stepper_seconds` are those of the stepper at the share of the tolerance
    that `simulate` gives it; `doubt` is how far the truth at 1e-10 is from that at 1e-11.
    `fit_way` and `fit_error` are those of a run as a fit makes it, whose steps have a tolerance of
    1e-6 at all tolerances.
    """

    trial: Trial
    rtol: float
    way: str
    error: float
    seconds: float
    stepper_error: float
    stepper_seconds: float
    doubt: float
    fit_way: str
    fit_error: float

    @property
    def over(self) -> float:
        """Error over tolerance."""
        return self.error / self.rtol


def ways_tables(progress: Progress, quick: bool) -> list[TitledTable]:
    """Return the way of each effect, and the errors over stacks, effects and records."""
    names = (BASE_NAME, *EFFECTS)
    alone: list[Reached] = []
    for name in names:
        progress(f"ways: {plain(name)}")
        alone += tried(_RTOLS, 3, Trial("demo", name, MIXED, 1e-3))
    stacks = tuple(STACKS)[:3] if quick else tuple(STACKS)
    records = ("steps",) if quick else (*KINKED, MIXED)
    sample_times = (1e-3,) if quick else (2e-5, 1e-3)
    everywhere: list[Reached] = []
    for stack in stacks:
        progress(f"errors over tolerance: {stack}")
        trials = [Trial(stack, n, r, h) for n in names for r in records for h in sample_times]
        for found in side_by_side(partial(tried, _RTOLS, 1), trials):
            everywhere += found
    return [effects_table(alone), errors_table(everywhere), exceeding_table(everywhere)]


def voltage(record: str, top: float, sample_time: float) -> tuple[FloatArray, FloatArray]:
    """Return times and voltages of a record up to 0.8 or 0.9 of the rated voltage."""
    s = np.linspace(0.0, 1.0, _SAMPLES, dtype=np.float64)
    t = np.asarray(np.arange(_SAMPLES) * sample_time, dtype=np.float64)
    if record == MIXED:
        v = 0.4 * (1.0 - np.cos(2.0 * np.pi * 10.0 * s))
        v = np.where(s < 0.4, v, np.interp(s, (0.4, 0.6, 0.8), (0.0, 0.7, 0.7)))
        return t, np.asarray(top * np.where(s < 0.8, v, 0.3), dtype=np.float64)
    corners = np.array(KINKED[record])
    return t, np.asarray(top * np.interp(s, corners[:, 0], corners[:, 1]), dtype=np.float64)


def with_one_effect(stack: str, effect: str) -> Model:
    """Return a stack with an effect at its ordinary size."""
    model = stack_model(stack)
    return model if effect == BASE_NAME else at_ordinary_size(model, EFFECTS[effect])


def tried(rtols: Sequence[float], repeats: int, trial: Trial) -> list[Reached]:
    """Return what a trial reaches at each tolerance; nothing where the truth cannot be had."""
    model = with_one_effect(trial.stack, trial.effect)
    t, v = voltage(trial.record, model.values["u_rated"], trial.sample_time)
    given = {"voltage": v}
    if "temperature" in model.input_names:
        given["temperature"] = 293.15 + 2.0 * np.sin(3.0 * t / t[-1])
    u = input_samples(model, len(t), given)
    x0 = start_on(model, t, u).x
    shown = model.output_names.index(_OUTPUT)

    def stepped(rtol: float) -> FloatArray:
        return run(model, t, u, x0, rtol=rtol).y[:, shown]

    try:
        truth = stepped(_TRUTH)
        doubt = _error(stepped(_CHECK), truth)
    except PsaError:
        return []
    fit = trace(model, t, u, x0, way=Way(FIT_RTOL, FIT_RTOL), output=_OUTPUT)
    fitted = fit.way, _error(fit.output, truth)
    found = []
    for rtol in rtols:
        ours = theirs = inf
        for _ in range(repeats):
            begin = time.thread_time()
            result = simulate(model, t, v, temperature=given.get("temperature"), rtol=rtol)
            middle = time.thread_time()
            peer = stepped(STEP_SHARE * rtol)
            end = time.thread_time()
            ours, theirs = min(ours, middle - begin), min(theirs, end - middle)
        reached, peers = (_error(x, truth) for x in (result.displacement, peer))
        found.append(Reached(trial, rtol, result.way, reached, ours, peers, theirs, doubt, *fitted))
    return found


def _error(x: FloatArray, truth: FloatArray) -> float:
    return float(np.max(np.abs(x - truth)) / np.ptp(truth))


def effects_table(found: Sequence[Reached]) -> TitledTable:
    """Return the ways and errors of the base and of each effect beside it."""
    rtols = sorted({r.rtol for r in found}, reverse=True)
    rows, tight = [], [r for r in found if r.rtol == rtols[-1]]
    for r in tight:
        ways = [o.way for o in found if o.trial == r.trial]
        figures = (r.error, r.over, r.seconds / r.stepper_seconds)
        cells = (plain(r.trial.effect), r.fit_way, number(r.fit_error, 2), *ways)
        rows.append((*cells, *(number(f, 2) for f in figures)))
    head = (
        "effect", "in a fit", "its error / range", *(f"way at {rtol:.0e}" for rtol in rtols),
        "largest error / range", "error / tolerance", "time over the stepper's",
    )  # fmt: skip
    effects = [r for r in found if r.trial.effect != BASE_NAME]
    names = {r.trial for r in effects}
    fits = sum(r.fit_way == EXACT for r in effects if r.rtol == rtols[-1])
    counts = [
        f"{sum(r.way == EXACT for r in effects if r.rtol == rtol)} at {rtol:.0e}" for rtol in rtols
    ]
    return TitledTable(
        f"Ways of the effects, one at a time: {MIXED} ({_SAMPLES} samples)",
        Table(head, tuple(rows)),
        f"Of {len(names)} effects {fits} take the exact way in a fit (tolerance of a step"
        f" {FIT_RTOL:.0e}); in `simulate` {', '.join(counts)}. The others fall back on the"
        f" stepper at {STEP_SHARE:g} of the tolerance, which is also the peer of the last column."
        f" The last three columns are of `simulate` at {rtols[-1]:.0e}; its time includes the runs"
        f" that judge the error. Errors are against the stepper at {_TRUTH:.0e}.",
    )


def errors_table(found: Sequence[Reached]) -> TitledTable:
    """Return how the errors of `simulate` and of the stepper alone compare with the tolerance."""
    rows = []
    for rtol in sorted({r.rtol for r in found}, reverse=True):
        own = [r for r in found if r.rtol == rtol]
        exact = [r for r in own if r.way == EXACT]
        peers = [replace(r, way=STEPPER, error=r.stepper_error) for r in own]
        for name, group in (("simulate", own), ("its exact runs", exact), ("stepper", peers)):
            if group:
                rows.append(_errors_row(f"{rtol:.0e}", name, group))
    trials = {r.trial for r in found}
    counts = [len({getattr(t, of) for t in trials}) for of in ("stack", "effect", "record")]
    worst = max(found, key=lambda r: r.over)
    above = [r for r in found if r.over > 1.0]
    note = (
        f"{len(trials)} trials: {counts[0]} stacks, {counts[1]} models (the base, and each effect"
        f" alone beside it), {counts[2]} kinds of record. The worst error of `simulate` over its"
        f" tolerance is {number(worst.over, 3)}; {share(len(above), len(found))} exceed 1. The"
        f" stepper alone takes the tolerance that `simulate` gives it, {STEP_SHARE:g} of the one"
        " asked for."
    )
    head = ("tolerance", "who", "by exact steps", "error / tolerance above 1", "worst", "where")
    return TitledTable(
        "Error over tolerance, records with kinks and jumps", Table(head, tuple(rows)), note
    )


def _errors_row(rtol: str, name: str, group: Sequence[Reached]) -> tuple[str, ...]:
    worst = max(group, key=lambda r: r.over)
    exact, above = (sum(r.way == EXACT for r in group), sum(r.over > 1.0 for r in group))
    of = len(group)
    return (rtol, name, share(exact, of), share(above, of), number(worst.over, 2), _where(worst))


def _where(r: Reached) -> str:
    t = r.trial
    return f"{t.stack}, {plain(t.effect)}, {t.record}, {1e3 * t.sample_time:g} ms"


def exceeding_table(found: Sequence[Reached]) -> TitledTable:
    """Return the runs whose error is above the tolerance, the worst first."""
    above = sorted((r for r in found if r.over > 1.0), key=lambda r: -r.over)
    rows = tuple(
        (
            f"{r.rtol:.0e}", _where(r), r.way, number(r.over, 3),
            number(r.stepper_error / r.rtol, 2), number(r.doubt / r.rtol, 2),
        )
        for r in above[:_LISTED]
    )  # fmt: skip
    head = (
        "tolerance", "where", "way", "error / tolerance", "the stepper's", "doubt of the truth"
    )  # fmt: skip
    return TitledTable(
        "Runs whose error exceeds the tolerance",
        Table(head, rows),
        f"The worst {len(rows)} of {len(above)}. The doubt is the difference of the stepper at"
        f" {_CHECK:.0e} and at {_TRUTH:.0e}, over the tolerance.",
    )


#: Causes hidden in a device of the independent plants each, of which there are six records.
HIDDEN = ("hysteresis_memory", "structural_mode", "slow_creep")
_RECORDS = 6
_FIRST_SEED, _NOISE, _SAMPLE_TIME = 271828, 1e-3, 1e-4
_LONG, _QUICK_LONG = 180_000, 12_000
#: Samples of a step of the long record; samples of a record of the plants that are diagnosed.
_HELD, _CUT = 600, 2400
_HEAD = (
    "work", "samples", "wall [s]", "processor [s]", "processor, over the stepper's",
    "simulations", "with derivatives", "found",
)  # fmt: skip
_NOTE = (
    "Models are compiled and cached before the diagnoses that count. Wall times are those of a"
    " machine that other work may share."
)


@dataclass(frozen=True)
class Spent:
    """A piece of work: times [s], simulations, those with derivatives, and what it found.

    `peer` is the processor time by the stepper alone, None where it was not tried.
    """

    work: str
    samples: str
    wall: float
    processor: float
    runs: int
    differentiated: int
    found: str
    peer: float | None = None


def diagnosis_table(demo: Record, progress: Progress, quick: bool) -> TitledTable:
    """Diagnose the demonstration and hidden causes, identify a long record."""
    rows = [*_demonstration(demo, progress)]
    rows += [_hidden(cause, progress) for cause in (HIDDEN[:1] if quick else HIDDEN)]
    rows += _long(_QUICK_LONG if quick else _LONG, progress)
    return spent_table(rows)


def spent_table(rows: Sequence[Spent]) -> TitledTable:
    """Return the work with its times, and its share of the stepper's where that was tried."""
    cells = tuple(
        (
            r.work, r.samples, number(r.wall), number(r.processor),
            "" if r.peer is None else number(r.processor / r.peer, 2),
            str(r.runs), str(r.differentiated), r.found,
        )
        for r in rows
    )  # fmt: skip
    said = [
        f"{r.work} takes 1/{number(r.peer / r.processor, 2)} of the stepper's processor time."
        for r in rows
        if r.peer is not None and r.peer != r.processor
    ]
    note = " ".join((*said, _NOTE))
    return TitledTable("Whole fits and diagnoses", Table(_HEAD, cells), note)


@contextmanager
def stepper_alone() -> Iterator[None]:
    """Leave exact steps out: every model counts as one that they do not fit."""

    def refuse(*_: Any, **__: Any) -> Any:
        raise NotExact("left out for a benchmark")

    name = "run_exact"  # where `trace` and `accurate` look it up
    kept = getattr(simulate_module, name)
    setattr(simulate_module, name, refuse)
    try:
        yield
    finally:
        setattr(simulate_module, name, kept)


def _spent(work: str, samples: str, do: Callable[[], str]) -> Spent:
    wall, processor = time.perf_counter(), time.process_time()
    with timed() as timings:
        found = do()
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    runs, differentiated = (
        sum(getattr(s, of) for s in timings.stages) for of in ("runs", "differentiated")
    )
    return Spent(work, samples, wall, processor, runs, differentiated, found)


def _diagnosed(records: Sequence[Record]) -> str:
    found = diagnose(records)
    return ", ".join(plain(c.effect) for c in found.causes) or str(found.verdict)


def _both_ways(
    work: str, samples: str, do: Callable[[], str], progress: Progress
) -> tuple[Spent, Spent]:
    """Return the work with exact steps and by the stepper alone."""
    progress(work)
    ours = _spent(work, samples, do)
    progress(f"{work}, by the stepper alone")
    with stepper_alone():
        theirs = _spent(f"{work}, by the stepper alone", samples, do)
    return replace(ours, peer=theirs.processor), replace(theirs, peer=theirs.processor)


def _demonstration(record: Record, progress: Progress) -> tuple[Spent, Spent]:
    """Diagnose the demonstration both ways, once before it counts: models get compiled."""

    def diagnosed() -> str:
        return _diagnosed([record])

    _both_ways("diagnose, demonstration (first use)", "", diagnosed, progress)
    return _both_ways("diagnose, demonstration", str(record.n), diagnosed, progress)


def _hidden(cause: str, progress: Progress) -> Spent:
    """Diagnose six records of one device that hides a cause, once before it counts."""
    records = six_records(cause)

    def diagnosed() -> str:
        return _diagnosed(records)

    work = f"diagnose, {_RECORDS} records, hidden {plain(cause)}"
    progress(f"{work} (first use)")
    diagnosed()
    progress(work)
    return _spent(work, f"{_RECORDS} x {_CUT}", diagnosed)


def six_records(cause: str) -> list[Record]:
    """Return records of one device of the independent plants, each with a voltage of its own."""
    records = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        truth = make_record(cause, _FIRST_SEED, path, visible=(1.0, 3.0))
        for k in range(_RECORDS):
            path = Path(folder) / f"record_{k}.csv"
            play_again(truth, _FIRST_SEED + k, path)
            records.append(read_record(path).slice(0, _CUT))
    return records


def long_record(samples: int) -> Record:
    """Return loops and steps with noise, of this package's own simulation."""
    model = stack_model("WYDS0808020")
    top, part = model.values["u_rated"], samples // 3
    t = time_grid(part * _SAMPLE_TIME, _SAMPLE_TIME)
    rng = np.random.default_rng(1)
    levels = top * rng.uniform(0.0, 1.0, max(6, part // _HELD))
    parts = [
        triangle(t, 0.0, top, 4.0 / (part * _SAMPLE_TIME)),
        decaying_triangle(t, 0.0, top, 6, centre=0.0),
        steps(t, levels),
    ]
    wave = concatenate(parts, _SAMPLE_TIME)
    x = simulate(model, wave.time, wave.voltage).displacement
    noise = _NOISE * np.ptp(x) * rng.standard_normal(x.size)
    return Record(
        name=f"{x.size} samples", time=wave.time, voltage=wave.voltage, displacement=x + noise
    )


def _long(samples: int, progress: Progress) -> tuple[Spent, Spent]:
    record = long_record(samples)

    def fit() -> str:
        found = identify([record]).fit
        return f"rms {number(100.0 * found.rms / record.range_m, 2)} % of range"

    return _both_ways("identify, loops and steps", str(record.n), fit, progress)
