"""Benchmark `design`: experiments that separate causes, inputs that follow paths, linearisation."""

import time
from collections.abc import Callable

import numpy as np

from psa_casadi.examples.linearisation_trial import (
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
from tests.studies.benchmarks import design_separation, design_tracking
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, table_of


def run(progress: Progress, quick: bool) -> Outcome:
    """Measure every part; with `quick` on fewer and smaller cases."""
    found = [p.tables(progress, quick) for p in (design_separation, design_tracking)]
    linear = (_nonlinearity(progress, quick), _time_table(progress, quick))
    return Outcome((*found[0], *found[1], *linear))


STACKS = ("P-885.51", "demo")
FREQUENCY, PERIOD = 5.0, 5e-4


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
    drift = ageing(plant, end) if ages else None
    part = slice(-round((2.0 if ages else 1.2) / PERIOD), None)

    def figure(control: str) -> str:
        times = np.arange(0.0, end, PERIOD)
        run = driven(plant, control, known, times, drift=drift, frequency=FREQUENCY)
        return number(100.0 * run.nonlinearity(part), 3)

    return tuple(figure(control) for control in ("none", "feed-forward", "tracked"))


def _time_table(progress: Progress, quick: bool) -> TitledTable:
    progress("time per sample")
    model, count = stack_model("P-885.51"), 4000 if quick else 40000
    values = stack_values(model, PERIOD)
    tuned = identifier_for(model, PERIOD, noise=1e-9).values
    u = wanted_voltage(np.linspace(0.0, PERIOD * count, count), model.values["u_rated"]).tolist()
    x = [1e-7 * v for v in u]
    observer, forward = HysteresisObserver(values), FeedForward(values)
    online, adaptive = OnlineIdentification(tuned), AdaptiveFeedForward(tuned)
    steps: dict[str, Callable[[int], object]] = {
        "observer (37)": lambda k: observer.step(u[k]),
        "feed-forward (39-41)": lambda k: forward.step_voltage(u[k]),
        "recursive least squares (38)": lambda k: online.step(u[k], x[k]),
        "tracked feed-forward": lambda k: adaptive.step_voltage(u[k], x[k]),
    }

    def microseconds(name: str) -> str:
        """Return the least CPU time of three passes per sample [us]."""
        found = []
        for _ in range(3):
            start = time.process_time()
            for k in range(count):
                steps[name](k)
            found.append((time.process_time() - start) / count)
        return number(1e6 * min(found), 3)

    title = "Time per sample of the streaming objects, CPU [us]"
    note = "One call from Python, with the loop around it."
    return table_of(title, steps, {"object": str, "time": microseconds}, note)
