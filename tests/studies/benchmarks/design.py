"""Benchmark `design`: experiments that separate causes, inputs that follow paths, linearisation."""

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

import psa_casadi as psa
from psa_casadi.design.experiment.criteria import SensorNoise, rival_of_model
from psa_casadi.design.experiment.experiment import (
    ASKED,
    PLAYS,
    informative_experiment,
    resolving_experiment,
    rival_of_effect,
    separating_experiment,
    usual_records,
)
from psa_casadi.design.experiment.limits import Limits
from psa_casadi.design.experiment.search import GRID
from psa_casadi.diagnosis.pack import STACK, Task
from psa_casadi.diagnosis.screening import levelled
from psa_casadi.diagnosis.search.hypothesis import examine, hypothesis
from psa_casadi.diagnosis.search.steps import one_of_each
from psa_casadi.examples.linearisation_trial import ageing, driven, off_values, wanted_voltage
from psa_casadi.identification.search import CORE, fit_base
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.records.split import split
from psa_casadi.report.words.phrases import number
from tests.studies.benchmarks import design_tracking
from tests.studies.benchmarks.records import hidden_record, played_again
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, least_times, on_all_cores
from tests.studies.plants.excitations import PoorKind
from tests.studies.plants.table import KNOWN, called

#: Ambiguous pairs that are resolved, and the seeds from which they are drawn.
PAIRS, QUICK_PAIRS, FIRST = 20, 2, 8400
#: Samples of a first record, of a class of voltage that users have, and the size of its effect.
SAMPLES, RHO = 2000, (0.3, 2.0)
CLASSES: tuple[PoorKind, ...] = ("sine", "triangle")
_FURTHER = ("designed", "sine", "triangle")
_SIZES = (250, 500, 1000, 2000, 4000)
_TIMED = (("slow_creep", "offset_drift"), ("field_dependent_gain", "rate_independent_asymmetry"))


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure every part; with `quick` on fewer and smaller cases."""
    pairs = resolve_pairs(QUICK_PAIRS if quick else PAIRS, FIRST, progress)
    return Outcome((
        _summary(pairs),
        _times(progress, quick),
        *design_tracking.tables(progress, quick),
        _nonlinearity(progress, quick),
        _time_table(progress, quick),
    ))  # fmt: skip


class Resolved(NamedTuple):
    """One ambiguous pair: what is hidden, its rival, and what was named after each further record.

    `named` holds for each voltage "right", "wrong" or "open", nothing where none was played;
    `growth` the predicted least ln of the Bayes factor; `plays` how often the record must be played
    to name the hidden effect with 90 %, None if that is never reached.
    """

    effect: str
    rival: str
    voltage: str
    named: dict[str, str]
    growth: dict[str, float]
    plays: int | None

    def __str__(self) -> str:
        """Return pair and answers in a line."""
        text = ", ".join(f"{n} {v} ({self.growth[n]:.3g})" for n, v in self.named.items())
        return f"{self.effect} or {self.rival} after a {self.voltage}; {text}"


def resolve_pairs(count: int, first: int, progress: Progress) -> list[Resolved]:
    """Draw records until so many ambiguous pairs are found that a voltage may tell apart.

    They come in the order of their seeds, with those among them that no voltage tells.
    """
    resolveds: list[Resolved] = []
    batch = 4 * (os.cpu_count() or 1)
    while sum(bool(r.named) for r in resolveds) < count:
        seeds = [(seed,) for seed in range(first, first + batch)]
        for one in on_all_cores(resolve, seeds, progress):
            if one is not None and sum(bool(r.named) for r in resolveds) < count:
                resolveds.append(one)
        first += batch
    return resolveds


def resolve(seed: int) -> Resolved | None:
    """Draw a device and a first record; if it is ambiguous, play what would tell.

    A random effect of the table is hidden and diagnosed against the other effect that is most
    probable after screening the whole table; None where the verdict is not ambiguous.
    """
    rng = np.random.default_rng(seed)
    effect = str(rng.choice([n for n in KNOWN if n != "temperature"]))
    voltage = CLASSES[rng.integers(len(CLASSES))]
    truth, first = hidden_record(effect, seed, excitation=voltage, visible=RHO)
    first, effect = first.slice(0, SAMPLES), called(effect)
    try:
        rival = likely_rival(first, effect)
        pair = [psa.EFFECTS[effect], psa.EFFECTS[rival]]
        d = psa.diagnose([first], effects=pair)
        if d.verdict != "ambiguous" or len(d.contenders) < 2:
            return None
        if len(one_of_each(d.contenders, d.experiments)[0]) < 2:
            return Resolved(effect, rival, voltage, {}, {}, None)
        designed = resolving_experiment(d)
    except psa.PsaError:
        return None
    limits = designed.limits["voltage"]
    usual = usual_records(limits, limits.rate)
    named = {}
    for name, record in {"designed": designed.record, **usual}.items():
        again = played_again(truth, seed, (record.time, record.columns["voltage"]))
        named[name] = judged(psa.diagnose([first, again], effects=pair), effect)
    growth = {"designed": min(p.designed for p in designed.pairs)}
    growth |= {n: min(p.usual[n] for p in designed.pairs) for n in _FURTHER[1:]}
    return Resolved(effect, rival, voltage, named, growth, designed.plays)


def likely_rival(record: psa.Record, effect: str) -> str:
    """Return the effect, other than the hidden one, that is most probable after the screening."""
    experiments = (split(record),)
    base = fit_base(starting_model([record], None), experiments)
    there = {c.name for c in base.model.components}
    table = [e for e in psa.EFFECTS.values() if not e.inputs and set(e.needs) <= there]
    plain = hypothesis((), base, experiments)
    assert plain is not None
    task = Task(experiments, tuple(table), STACK)
    evidence = levelled(examine(plain, task).estimated(), task.indistinguishable(base))
    return max((n for n in evidence if n != effect), key=lambda n: evidence[n])


def judged(d: psa.StackDiagnosis, effect: str) -> str:
    """Return "right" or "wrong" where one of the two was named alone, else "open"."""
    if not d.causes or d.verdict == "ambiguous" or d.causes[0].cannot_be_told_from:
        return "open"
    return "right" if d.causes[0].effect == effect else "wrong"


def _summary(found: Sequence[Resolved]) -> TitledTable:
    played = [r for r in found if r.named]
    items = [r for r in played if r.plays is None]
    rows = []
    for name in _FURTHER:
        text = f"{round(0.9 * len(played))} of {len(played)} right" if name == "designed" else ""
        counts = {
            f"{value} name" if value != "open" else value: sum(
                r.named[name] == value for r in played
            )
            for value in ("right", "wrong", "open")
        }
        growth = f"{np.median([r.growth[name] for r in played]):.3g}"
        rows.append({"further record": name, "asked": text, **counts,
                     "predicted ln B, median": growth})  # fmt: skip
    return TitledTable(
        "Ambiguous pairs on independent plants, after one further record",
        rows,
        f"{len(found)} pairs were ambiguous; {len(found) - len(played)} of them are effects that"
        " bend the same curve, which no voltage of such a record tells apart: nothing was played."
        " All further records have the length, the sampling and the voltage range of the first. The"
        " predicted ln B is the growth of the logarithm of the Bayes factor for the less favourable"
        f" of the two truths. Of {len(items)} pairs it was said beforehand that no record found,"
        f" nor {PLAYS[-1]} of them, would tell with {100.0 * ASKED:.0f} %;"
        f" {sum(r.named['designed'] == 'open' for r in items)} of them stayed open with the"
        " designed one.",
    )


def _times(progress: Progress, quick: bool) -> TitledTable:
    """Measure the time of designs against their number of samples."""
    model = psa.stack_model("P-885.51")
    free = [n for n in CORE if n in model.parameter_names]
    base, noise = rival_of_model("base", model, free), SensorNoise(20e-9)
    rivals = {
        " against ".join(pair): [rival_of_effect(model, psa.EFFECTS[n], free) for n in pair]
        for pair in _TIMED
    }
    rows = []
    for samples in _SIZES[:3:2] if quick else _SIZES:
        progress(f"designs of {samples} samples")
        limits = Limits(0.0, 100.0, 2.0, samples)
        row = {"samples": str(samples)}
        for name, pair in {**rivals, "D-optimal, all parameters": None}.items():
            began = time.perf_counter()
            if pair is None:
                informative_experiment(base, noise, limits)
            else:
                separating_experiment(pair, noise, limits, base=base)
            row[name] = f"{time.perf_counter() - began:.1f} s"
        rows.append(row)
    return TitledTable(
        "Time to design an experiment (asked: 1,000 samples in under a minute on two cores)",
        rows,
        f"Voltages are compared on a grid of at most {GRID} samples; the record itself is judged in"
        " full.",
    )


STACKS, FREQUENCY, PERIOD = ("P-885.51", "demo"), 5.0, 5e-4


def _nonlinearity(progress: Progress, quick: bool) -> TitledTable:
    rows = []
    for name in STACKS[: 1 if quick else None]:
        plant = psa.stack_model(name)
        progress(f"linearisation of {name}")
        cases: list[tuple[str, psa.Model, float | None]] = [("values exact", plant, None)]
        for seed in range(1 if quick else 3):
            known = off_values(plant, 0.1, seed)
            cases.append((f"all values off by 10 %, draw {seed + 1}", known, None))
        ends = (12.0,) if quick or name != STACKS[0] else (12.0, 60.0)
        cases += [(f"ages: k_L -10 %, loop +30 % in {end:g} s", plant, end) for end in ends]
        rows += [{"stack": name, "plant": t, **_run(plant, k, end)} for t, k, end in cases]
    return TitledTable(
        "Nonlinearity of a stack in an open loop [% of the range]",
        rows,
        "Largest distance from the best straight line against the plant's own linear answer, over"
        " the last two fifths (ageing: the last 2 s), at 5 Hz with nested loops and a sensor noise"
        " of 0.01 % of the stroke. The plant is stepped in plain NumPy and shares no code with the"
        " observer. Feed-forward: paper eqs. 37, 39-41; tracked: eq. 38.",
    )


def _run(plant: psa.Model, known: psa.Model, ages: float | None) -> dict[str, str]:
    end = ages or 3.0
    drift = ageing(plant, end) if ages else None
    part = slice(-round((2.0 if ages else 1.2) / PERIOD), None)
    row = {}
    for control, head in {"none": "plain", "feed-forward": "feed-forward",
                          "tracked": "tracked online"}.items():  # fmt: skip
        times = np.arange(0.0, end, PERIOD)
        run = driven(plant, control, known, times, drift=drift, frequency=FREQUENCY)
        row[head] = number(100.0 * run.nonlinearity(part), 3)
    return row


def _times_over(step: Callable[[int], object], count: int) -> None:
    for k in range(count):
        step(k)


def _time_table(progress: Progress, quick: bool) -> TitledTable:
    progress("time per sample")
    model, count = psa.stack_model("P-885.51"), 4000 if quick else 40000
    values = psa.stack_values(model, PERIOD)
    tuned = psa.identifier_for(model, PERIOD, noise=1e-9).values
    u = wanted_voltage(np.linspace(0.0, PERIOD * count, count), model.values["u_rated"]).tolist()
    x = [1e-7 * v for v in u]
    observer, forward = psa.HysteresisObserver(values), psa.FeedForward(values)
    online, adaptive = psa.OnlineIdentification(tuned), psa.AdaptiveFeedForward(tuned)
    steps: dict[str, Callable[[int], object]] = {
        "observer (37)": lambda k: observer.step(u[k]),
        "feed-forward (39-41)": lambda k: forward.step_voltage(u[k]),
        "recursive least squares (38)": lambda k: online.step(u[k], x[k]),
        "tracked feed-forward": lambda k: adaptive.step_voltage(u[k], x[k]),
    }
    rows = []
    for name, step in steps.items():
        ((_, spent),) = least_times([partial(_times_over, step, count)], 3)
        rows.append({"object": name, "time": number(1e6 * spent / count, 3)})
    title = "Time per sample of the streaming objects, CPU [us]"
    return TitledTable(title, rows, "One call from Python, with the loop around it.")
