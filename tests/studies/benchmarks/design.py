"""Benchmark `design`: experiments that separate causes, inputs that follow paths, linearisation."""

import time
from collections.abc import Callable
from importlib import import_module

import numpy as np

from psa_casadi.design.mechanism.mechanism import design_mechanism
from psa_casadi.design.mechanism.search import Limits
from psa_casadi.examples.linearisation_trial import (
    Drive,
    ageing,
    driven,
    off_values,
    wanted_voltage,
)
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import stack_model
from psa_casadi.online import (
    AdaptiveFeedForward,
    FeedForward,
    HysteresisObserver,
    OnlineIdentification,
    identifier_for,
    stack_values,
)
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

#: Each part measures its own tables: `tables(progress, quick)`.
_PARTS = ("design_separation", "design_tracking", "design_linearisation")


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure every part; with `quick` on fewer and smaller cases."""
    found = []
    for part in _PARTS:
        found += import_module(f"tests.studies.benchmarks.{part}").tables(progress, quick)
    return Outcome(tuple(found))


STACKS = ("P-885.51", "demo")
FREQUENCY, PERIOD = 5.0, 5e-4
_CONTROLS = ("none", "feed-forward", "tracked")


def tables(progress: Progress, quick: bool) -> tuple[TitledTable, ...]:
    """Measure nonlinearity, time per sample and mechanisms again."""
    return (
        _nonlinearity(progress, quick),
        _time_table(progress, quick),
        _mechanisms(progress, quick),
    )


def _nonlinearity(progress: Progress, quick: bool) -> TitledTable:
    rows = []
    names = STACKS[:1] if quick else STACKS
    for name in names:
        plant = stack_model(name)
        progress(f"linearisation of {name}")
        rows.append((name, "values exact", *_run(plant, plant)))
        for seed in range(1 if quick else 3):
            known = off_values(plant, 0.1, seed)
            rows.append((name, f"all values off by 10 %, draw {seed + 1}", *_run(plant, known)))
        slow = () if quick or name != STACKS[0] else (1.0,)
        for minutes in (0.2, *slow):
            text = f"ages: k_L -10 %, loop +30 % in {60 * minutes:g} s"
            rows.append((name, text, *_run(plant, plant, 60.0 * minutes)))
    return TitledTable(
        "Nonlinearity of a stack in an open loop [% of the range]",
        Table(("stack", "plant", "plain", "feed-forward", "tracked online"), tuple(rows)),
        "Largest distance from the best straight line against the plant's own linear answer, over"
        " the last two fifths (ageing: the last 2 s), at 5 Hz with nested loops and a sensor noise"
        " of 0.01 % of the stroke. The plant is stepped in plain NumPy and shares no code with the"
        " observer. Feed-forward: paper eqs. 37, 39-41; tracked: eq. 38.",
    )


def _run(plant: Model, known: Model, ages: float | None = None) -> tuple[str, ...]:
    end = ages or 3.0
    time_ = np.arange(0.0, end, PERIOD)
    drift = ageing(plant, end) if ages else None
    part = slice(-round((2.0 if ages else 1.2) / PERIOD), None)

    def figure(control: str) -> str:
        run: Drive = driven(plant, control, known, time_, drift=drift, frequency=FREQUENCY)
        return number(100.0 * run.nonlinearity(part), 3)

    return tuple(figure(control) for control in _CONTROLS)


def _time_table(progress: Progress, quick: bool) -> TitledTable:
    progress("time per sample")
    model, count = stack_model("P-885.51"), 4000 if quick else 40000
    values = stack_values(model, PERIOD)
    tuned = identifier_for(model, PERIOD, noise=1e-9).values
    u = wanted_voltage(np.linspace(0.0, PERIOD * count, count), model.values["u_rated"]).tolist()
    x = [1e-7 * v for v in u]
    observer, forward = HysteresisObserver(values), FeedForward(values)
    online, adaptive = OnlineIdentification(tuned), AdaptiveFeedForward(tuned)
    rows = [
        ("observer (37)", _microseconds(lambda k: observer.step(u[k]), count)),
        ("feed-forward (39-41)", _microseconds(lambda k: forward.step_voltage(u[k]), count)),
        ("recursive least squares (38)", _microseconds(lambda k: online.step(u[k], x[k]), count)),
        ("tracked feed-forward", _microseconds(lambda k: adaptive.step_voltage(u[k], x[k]), count)),
    ]
    return TitledTable(
        "Time per sample of the streaming objects, CPU [us]",
        Table(("object", "time"), tuple((name, number(value, 3)) for name, value in rows)),
        "One call from Python, with the loop around it.",
    )


def _microseconds(step: Callable[[int], float], count: int) -> float:
    """Return the least CPU time of three passes per sample [us]."""
    found = []
    for _ in range(3):
        start = time.process_time()
        for k in range(count):
            step(k)
        found.append((time.process_time() - start) / count)
    return 1e6 * min(found)


def _mechanisms(progress: Progress, quick: bool) -> TitledTable:
    rows = []
    for text, limits in (
        ("stroke loss 10 %", Limits()),
        ("and a mass of 50 g", Limits(mass=(0.0, 0.05))),
        ("and a force of 500 N", Limits(force=500.0)),
    ):
        progress(f"mechanism within {text}")
        start = time.perf_counter()
        d = design_mechanism(
            stack_model("PTBS200"), damping=0.7, limits=limits, starts=2 if quick else 8
        )
        r, m = d.reached, d.mounting
        figures = (1e3 * m.mass, m.damping, 1e-6 * m.stiffness, r.damping, r.bandwidth)
        rest = (100.0 * r.stroke_loss, r.peak_force, time.perf_counter() - start)
        agree = f"{d.agreeing} of {d.starts}"
        rows.append((text, *(number(v, 3) for v in (*figures, *rest)), agree))
    head = (
        "within", "mass [g]", "damping [N.s/m]", "stiffness [N/um]", "damping ratio",
        "bandwidth [Hz]", "stroke loss [%]", "peak force [N]", "time [s]", "same design",
    )  # fmt: skip
    return TitledTable(
        "Mechanism for a damping ratio of 0.7 on the PTBS200 (free: 0.03)", Table(head, tuple(rows))
    )
