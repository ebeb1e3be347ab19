"""Tables of benchmark `design`: experiments that separate causes, and the time a design takes."""

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

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
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.pack import STACK, Task
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.diagnosis.screening import levelled
from psa_casadi.diagnosis.search.hypothesis import examine, hypothesis
from psa_casadi.diagnosis.search.steps import one_of_each
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import PsaError
from psa_casadi.identification.search import CORE, fit_base
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.stacks import stack_model
from psa_casadi.records.record import Record
from psa_casadi.records.split import split
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.records import hidden_record, played_again
from tests.studies.benchmarks.table import Progress, TitledTable, table_of
from tests.studies.plants.excitations import PoorKind
from tests.studies.plants.table import KNOWN

#: Ambiguous pairs that are resolved, and the seeds from which they are drawn.
PAIRS, QUICK_PAIRS, FIRST = 20, 2, 8400
#: Samples of a first record, of a class of voltage that users have, and the size of its effect.
SAMPLES, RHO = 2000, (0.3, 2.0)
CLASSES: tuple[PoorKind, ...] = ("sine", "triangle")
_FURTHER = ("designed", "sine", "triangle")
_SIZES = (250, 500, 1000, 2000, 4000)
_TIMED = (("slow_creep", "offset_drift"), ("field_dependent_gain", "rate_independent_asymmetry"))


@dataclass(frozen=True)
class Resolved:
    """One ambiguous pair: what is hidden, its rival, and what was named after each further record.

    `named` holds for each voltage "right", "wrong", "open" or "not played"; `growth` the predicted
    least ln of the Bayes factor; `plays` how often the record must be played to name the hidden
    effect with 90 %, None if that is never reached.
    """

    effect: str
    rival: str
    voltage: str
    named: dict[str, str]
    growth: dict[str, float]
    plays: int | None

    def __str__(self) -> str:
        """Return pair and answers in a line."""
        said = ", ".join(f"{n} {v} ({self.growth[n]:.3g})" for n, v in self.named.items())
        return f"{self.effect} or {self.rival} after a {self.voltage}; {said}"


def tables(progress: Progress, quick: bool) -> tuple[TitledTable, ...]:
    """Measure both tables; the seeds are the same in every run."""
    found = resolve_pairs(QUICK_PAIRS if quick else PAIRS, FIRST, progress)
    return (_summary(found), _times(progress, quick))


def resolve_pairs(count: int, first: int, progress: Progress) -> list[Resolved]:
    """Draw records until so many ambiguous pairs are found that a voltage may tell apart.

    They come in the order of their seeds, with those among them that no voltage tells.
    """
    found: list[Resolved] = []
    workers, seed = os.cpu_count() or 1, first
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        while len(_played(found)) < count:
            batch = range(seed, seed + 2 * workers)
            for number, one in zip(batch, pool.map(resolve, batch), strict=True):
                if one is not None and len(_played(found)) < count:
                    found.append(one)
                    progress(f"{len(_played(found))} of {count} (seed {number}): {one}")
            seed = batch.stop
    return found


def _played(found: Sequence[Resolved]) -> list[Resolved]:
    return [r for r in found if r.named["designed"] != "not played"]


def resolve(seed: int) -> Resolved | None:
    """Draw a device and a first record; if it is ambiguous, play what would tell.

    A random effect of the table is hidden and diagnosed against the other effect that is most
    probable after screening the whole table; None where the verdict is not ambiguous.
    """
    rng = np.random.default_rng(seed)
    effect = str(rng.choice([n for n in KNOWN if n != "temperature"]))
    voltage = CLASSES[rng.integers(len(CLASSES))]
    truth, first = hidden_record(effect, seed, excitation=voltage, visible=RHO)
    first = first.slice(0, SAMPLES)
    try:
        rival = likely_rival(first, effect)
        pair = [EFFECTS[effect], EFFECTS[rival]]
        d = diagnose([first], effects=pair)
        if d.verdict != "ambiguous" or len(d.contenders) < 2:
            return None
        if len(one_of_each(d.contenders, d.experiments)[0]) < 2:
            left = dict.fromkeys(_FURTHER, "not played")
            return Resolved(effect, rival, voltage, left, dict.fromkeys(_FURTHER, 0.0), None)
        designed = resolving_experiment(d)
    except PsaError:
        return None
    usual = usual_records(designed.limits, designed.limits.steepest(None))
    named = {
        name: judged(diagnose([first, again], effects=pair), effect)
        for name, record in {"designed": designed.record, **usual}.items()
        for again in (played_again(truth, seed, (record.time, record.voltage)),)
    }
    growth = {"designed": min(p.designed for p in designed.pairs)}
    growth |= {n: min(p.usual[n] for p in designed.pairs) for n in _FURTHER[1:]}
    return Resolved(effect, rival, voltage, named, growth, designed.plays)


def likely_rival(record: Record, effect: str) -> str:
    """Return the effect, other than the hidden one, that is most probable after the screening."""
    experiments = (split(record),)
    base = fit_base(starting_model([record], None), experiments)
    there = {c.name for c in base.model.components}
    table = [e for e in EFFECTS.values() if not e.inputs and set(e.needs) <= there]
    plain = hypothesis((), base, experiments)
    assert plain is not None
    task = Task(experiments, tuple(table), STACK)
    evidence = levelled(examine(plain, task).estimated(), task.alike(base))
    others = {n: p for n, p in evidence.items() if n != effect}
    return max(others, key=lambda n: others[n])


def judged(d: Diagnosis, effect: str) -> str:
    """Return "right" or "wrong" where one of the two was named alone, else "open"."""
    if not d.causes or d.verdict == "ambiguous" or d.causes[0].cannot_be_told_from:
        return "open"
    return "right" if d.causes[0].effect == effect else "wrong"


def _summary(found: Sequence[Resolved]) -> TitledTable:
    played = _played(found)

    def named(value: str) -> Callable[[str], str]:
        return lambda name: str(sum(r.named[name] == value for r in played))

    def growth(name: str) -> str:
        return f"{np.median([r.growth[name] for r in played]):.3g}" if played else "nan"

    def asked(name: str) -> str:
        return f"{round(0.9 * len(played))} of {len(played)} right" if name == "designed" else ""

    alike = [r for r in played if r.plays is None]
    return table_of(
        "Ambiguous pairs on independent plants, after one further record",
        _FURTHER,
        {
            "further record": str, "asked": asked, "right name": named("right"),
            "wrong name": named("wrong"), "open": named("open"), "predicted ln B, median": growth,
        },
        f"{len(found)} pairs were ambiguous; {len(found) - len(played)} of them are effects that"
        " bend the same curve, which no voltage of such a record tells apart: nothing was played."
        " All further records have the length, the sampling and the voltage range of the first. The"
        " predicted ln B is the growth of the logarithm of the Bayes factor for the less favourable"
        f" of the two truths. Of {len(alike)} pairs it was said beforehand that no record found,"
        f" nor {PLAYS[-1]} of them, would tell with {100.0 * ASKED:.0f} %;"
        f" {sum(r.named['designed'] == 'open' for r in alike)} of them stayed open with the"
        " designed one.",
    )  # fmt: skip


def _times(progress: Progress, quick: bool) -> TitledTable:
    """Measure the time of designs against their number of samples."""
    model = stack_model("P-885.51")
    free = [n for n in CORE if n in model.parameter_names]
    pairs = [[rival_of_effect(model, EFFECTS[n], free) for n in pair] for pair in _TIMED]
    base, noise = rival_of_model("base", model, free), SensorNoise(20e-9)
    rows = []
    for samples in _SIZES[:3:2] if quick else _SIZES:
        progress(f"designs of {samples} samples")
        limits = Limits(0.0, 100.0, 2.0, samples)
        clock = [time.perf_counter()]
        for rivals in pairs:
            separating_experiment(rivals, noise, limits, base=base)
            clock.append(time.perf_counter())
        informative_experiment(base, noise, limits)
        clock.append(time.perf_counter())
        taken = np.diff(clock).tolist()
        rows.append((f"{samples}", *(f"{t:.1f} s" for t in taken)))
    names = tuple(" against ".join(pair) for pair in _TIMED)
    return TitledTable(
        "Time to design an experiment (asked: 1,000 samples in under a minute on two cores)",
        Table(("samples", *names, "D-optimal, all parameters"), tuple(rows)),
        f"Voltages are compared on a grid of at most {GRID} samples; the record itself is judged in"
        " full.",
    )
