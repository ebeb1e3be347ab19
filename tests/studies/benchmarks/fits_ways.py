"""Which way every effect takes in `simulate`, and whether the error is what was asked for.

The truth is the stepper at 1e-11. Records with kinks and jumps are the hard ones: drivers turn and
rest there within a sample.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import inf
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
    steps,
    time_grid,
    triangle,
)
from psa_casadi.report.words.phrases import number, plain
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
from tests.studies.benchmarks.records import hidden_record, played_again
from tests.studies.benchmarks.table import Progress, TitledTable, share, table_of

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
    stacks = tuple(STACKS)[: 3 if quick else None]
    records = ("steps",) if quick else (*KINKED, MIXED)
    sample_times = (1e-3,) if quick else (2e-5, 1e-3)
    everywhere: list[Reached] = []
    for stack in stacks:
        progress(f"errors over tolerance: {stack}")
        trials = [Trial(stack, n, r, h) for n in names for r in records for h in sample_times]
        for found in side_by_side(partial(tried, _RTOLS, 1), trials):
            everywhere += found
    return [effects_table(alone), errors_table(everywhere)]


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
    fit = trace(model, t, u, x0, way=Way(FIT_RTOL, FIT_RTOL), outputs=(_OUTPUT,))
    fitted = fit.way, _error(fit.y[:, 0], truth)
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
    ways = {(r.trial, r.rtol): r.way for r in found}

    def way(rtol: float) -> Callable[[Reached], str]:
        return lambda r: ways[r.trial, rtol]

    effects = [r for r in found if r.trial.effect != BASE_NAME]
    fits = sum(r.fit_way == EXACT for r in effects if r.rtol == rtols[-1])
    exact = Counter(r.rtol for r in effects if r.way == EXACT)
    return table_of(
        f"Ways of the effects, one at a time: {MIXED} ({_SAMPLES} samples)",
        [r for r in found if r.rtol == rtols[-1]],
        {
            "effect": lambda r: plain(r.trial.effect),
            "in a fit": lambda r: r.fit_way,
            "its error / range": lambda r: number(r.fit_error, 2),
            **{f"way at {rtol:.0e}": way(rtol) for rtol in rtols},
            "largest error / range": lambda r: number(r.error, 2),
            "error / tolerance": lambda r: number(r.over, 2),
            "time over the stepper's": lambda r: number(r.seconds / r.stepper_seconds, 2),
        },
        f"Of {len({r.trial for r in effects})} effects {fits} take the exact way in a fit"
        f" (tolerance of a step {FIT_RTOL:.0e}); in `simulate`"
        f" {', '.join(f'{exact[rtol]} at {rtol:.0e}' for rtol in rtols)}. The others fall back on"
        f" the stepper at {STEP_SHARE:g} of the tolerance, which is also the peer of the last"
        f" column. The last three columns are of `simulate` at {rtols[-1]:.0e}; its time includes"
        f" the runs that judge the error. Errors are against the stepper at {_TRUTH:.0e}.",
    )


def errors_table(found: Sequence[Reached]) -> TitledTable:
    """Return how the errors of `simulate` and of the stepper alone compare with the tolerance."""
    groups = {}
    for rtol in sorted({r.rtol for r in found}, reverse=True):
        own = [r for r in found if r.rtol == rtol]
        groups[rtol, "simulate"] = own
        groups[rtol, "its exact runs"] = [r for r in own if r.way == EXACT]
        groups[rtol, "stepper"] = [replace(r, way=STEPPER, error=r.stepper_error) for r in own]
    Key = tuple[float, str]

    def counted(holds: Callable[[Reached], bool]) -> Callable[[Key], str]:
        return lambda key: share(sum(map(holds, groups[key])), len(groups[key]))

    def worst_of(key: Key) -> Reached:
        return max(groups[key], key=lambda r: r.over)

    def where(key: Key) -> str:
        t = worst_of(key).trial
        return f"{t.stack}, {plain(t.effect)}, {t.record}, {1e3 * t.sample_time:g} ms"

    columns: dict[str, Callable[[Key], str]] = {
        "tolerance": lambda key: f"{key[0]:.0e}",
        "who": lambda key: key[1],
        "by exact steps": counted(lambda r: r.way == EXACT),
        "error / tolerance above 1": counted(lambda r: r.over > 1.0),
        "worst": lambda key: number(worst_of(key).over, 2),
        "where": where,
    }
    trials = {r.trial for r in found}
    counts = [len({getattr(t, of) for t in trials}) for of in ("stack", "effect", "record")]
    worst = max(found, key=lambda r: r.over)
    return table_of(
        "Error over tolerance, records with kinks and jumps",
        [key for key in groups if groups[key]],
        columns,
        f"{len(trials)} trials: {counts[0]} stacks, {counts[1]} models (the base, and each effect"
        f" alone beside it), {counts[2]} kinds of record. The worst error of `simulate` over its"
        f" tolerance is {number(worst.over, 3)}, where the truth at {_CHECK:.0e} and at"
        f" {_TRUTH:.0e} differ by {number(worst.doubt / worst.rtol, 2)} of it;"
        f" {share(sum(r.over > 1.0 for r in found), len(found))} exceed 1. The stepper alone takes"
        f" the tolerance that `simulate` gives it, {STEP_SHARE:g} of the one asked for.",
    )


#: Causes hidden in a device of the independent plants each, of which there are six records.
HIDDEN = ("hysteresis_memory", "structural_mode", "slow_creep")
_RECORDS = 6
_FIRST_SEED, _NOISE, _SAMPLE_TIME = 271828, 1e-3, 1e-4
_LONG, _QUICK_LONG = 180_000, 12_000
#: Samples of a step of the long record; samples of a record of the plants that are diagnosed.
_HELD, _CUT = 600, 2400


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
    """Diagnose the demonstration and hidden causes, identify a long record.

    What is diagnosed is so once before it counts: models get compiled.
    """
    work = "diagnose, demonstration"
    for name in (f"{work} (first use)", work):
        rows = [*_both_ways(name, str(demo.n), partial(_diagnosed, [demo]), progress)]
    for cause in HIDDEN[: 1 if quick else None]:
        records, work = six_records(cause), f"diagnose, {_RECORDS} records, hidden {plain(cause)}"
        for name in (f"{work} (first use)", work):
            progress(name)
            spent = _spent(name, f"{_RECORDS} x {_CUT}", partial(_diagnosed, records))
        rows.append(spent)
    long = long_record(_QUICK_LONG if quick else _LONG)

    def fit() -> str:
        rms = identify([long]).fit.rms
        return f"rms {number(100.0 * rms / long.range_m, 2)} % of range"

    rows += _both_ways("identify, loops and steps", str(long.n), fit, progress)
    return spent_table(rows)


def spent_table(rows: Sequence[Spent]) -> TitledTable:
    """Return the work with its times, and its share of the stepper's where that was tried."""
    said = [
        f"{r.work} takes 1/{number(r.peer / r.processor, 2)} of the stepper's processor time."
        for r in rows
        if r.peer is not None and r.peer != r.processor
    ]
    return table_of(
        "Whole fits and diagnoses",
        rows,
        {
            "work": lambda r: r.work,
            "samples": lambda r: r.samples,
            "wall [s]": lambda r: number(r.wall),
            "processor [s]": lambda r: number(r.processor),
            "processor, over the stepper's": lambda r: (
                "" if r.peer is None else number(r.processor / r.peer, 2)
            ),
            "simulations": lambda r: str(r.runs),
            "with derivatives": lambda r: str(r.differentiated),
            "found": lambda r: r.found,
        },
        " ".join(said) + " Models are compiled and cached before the diagnoses that count. Wall"
        " times are those of a machine that other work may share.",
    )


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


def six_records(cause: str) -> list[Record]:
    """Return records of one device of the independent plants, each with a voltage of its own."""
    truth, _ = hidden_record(cause, _FIRST_SEED, visible=(1.0, 3.0))
    return [played_again(truth, _FIRST_SEED + k).slice(0, _CUT) for k in range(_RECORDS)]


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
