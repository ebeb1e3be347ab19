"""Parts around a stack as C for a microcontroller, against the Python objects, over long runs."""

import re
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

import psa_casadi as psa
from psa_casadi.examples.linearisation_trial import DriftingStack
from psa_casadi.export.fixed_step.export import FixedStep, fixed_step
from psa_casadi.export.fixed_step.expressions import PRECISIONS
from psa_casadi.export.fixed_step.probe import Probe
from psa_casadi.files import temporary_folder
from psa_casadi.simulation.compiler import compiler_command, run_compiler
from tests.export.test_fixed_step import STRICT
from tests.tiers import slow_but

FloatArray = NDArray[np.float64]
PERIOD, SAMPLES = 1e-4, 40_000
#: A machine of double precision adds in another order; one of single has 24 bits.
ROUNDING = {"double": 1e-9, "single": 1e-5}
FRAMES = (*STRICT, "-Wframe-larger-than=4096")


def code_of(model: psa.Model, precision: str) -> FixedStep:
    step = model.values[model.structure.period] if model.structure.period else 1e-5
    return fixed_step(model, name="part", step=step, precision=precision)


def played(model: psa.Model, precision: str, inputs: FloatArray) -> FloatArray:
    """Return the outputs (n, ny) of the code on inputs (n, nu), one call for each."""
    found = code_of(model, precision)
    return Probe(found.plan, found.texts).play(np.vstack([inputs[:1], inputs]))


@cache
def values() -> dict[str, float]:
    """Return a stack's values; without delta, by which a slow ramp is told from its stairs."""
    return psa.stack_values(psa.stack_model("P-885.51").with_values({"delta": 0.0}), PERIOD)


def wanted() -> FloatArray:
    """Return a displacement [m]: nested loops, a rest, a jump, and loops again."""
    t = PERIOD * np.arange(SAMPLES)
    w = 5e-6 * (1.0 - np.cos(19.0 * t)) * (0.6 + 0.4 * np.cos(2.3 * t))
    w[SAMPLES // 3 : SAMPLES // 2] = w[SAMPLES // 3]
    return np.asarray(w)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_feed_forward_and_observer_are_the_python_objects(precision: str) -> None:
    forward, observer = psa.FeedForward(values()), psa.HysteresisObserver(values())
    volts = np.array([forward.step(w) for w in wanted().tolist()])
    force = np.array([observer.step(u) for u in volts.tolist()])
    for block, given, expected in (
        (forward, wanted(), volts),
        (observer, volts, force),
    ):
        found = played(block.model, precision, given[:, None])[:, 0]
        assert np.ptp(expected) > 20.0
        assert np.abs(found - expected).max() <= ROUNDING[precision] * np.ptp(expected)


@cache
def closed_loop() -> tuple[psa.AdaptiveFeedForward, FloatArray, FloatArray]:
    """Return a tracked feed-forward that has run, its inputs (n, 2) and its voltages (n,)."""
    model = psa.stack_model("P-885.51").with_values({"delta": 0.0})
    off = model.with_values({"A": 0.9 * model.values["A"], "k_L": 1.1 * model.values["k_L"]})
    block = psa.AdaptiveFeedForward(psa.identifier_for(off, PERIOD, noise=2e-8).values)
    plant, x, rows, voltage = DriftingStack(model.values, PERIOD), 0.0, [], []
    path = wanted()[: SAMPLES // 3]
    noise = 2e-9 * np.random.default_rng(0).normal(size=path.size)
    for w, error in zip(path.tolist(), noise.tolist(), strict=True):
        rows.append((w, x + error))
        voltage.append(block.step(*rows[-1]))
        x = plant.step(voltage[-1])
    return block, np.array(rows), np.array(voltage)


@pytest.mark.parametrize("precision", PRECISIONS)
def test_learning_blocks_are_the_python_objects(precision: str) -> None:
    block, inputs, voltage = closed_loop()
    limit = {"double": 1e-8, "single": 2e-4}[precision]
    found = played(block.model, precision, inputs)
    assert np.abs(found[:, 0] - voltage).max() <= limit * np.ptp(voltage)
    learnt = np.array([block.estimate.parameters[n] for n in ("A", "n", "k_L")])
    names = [f"{n}_hat" for n in ("A", "n", "k_L")]
    at = [block.model.output_names.index(n) for n in names]
    assert found[-1, at] == pytest.approx(learnt, rel=50.0 * limit)
    online = psa.OnlineIdentification(block.model.values)
    given = np.column_stack([voltage, inputs[:, 1]])
    for row in given.tolist():
        online.step(*row)
    found = played(online.model, precision, given)
    learnt = np.array([online.estimate.parameters[n] for n in ("A", "n", "k_L")])
    at = [online.model.output_names.index(n) for n in names]
    assert found[-1, at] == pytest.approx(learnt, rel=50.0 * limit)


@pytest.mark.parametrize(
    ("name", "precision"),
    slow_but(
        [("hysteresis_compensator", "single"), ("adaptive_feed_forward", "double")],
        [(name, precision) for name in psa.PARTS for precision in PRECISIONS],
    ),
)
def test_every_part_is_c_of_small_frames_and_no_loop(name: str, precision: str) -> None:
    found = code_of(psa.part_model(name), precision)
    assert found.worst.error <= 1e-3
    source = found.texts["part.c"]
    code = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
    assert found.plan.substeps > 1 or not re.search(r"\b(for|while|goto)\b", code)
    with temporary_folder() as folder:
        for file, text in found.texts.items():
            (folder / file).write_text(text, encoding="utf-8")
        for level in ("-O0", "-O2"):
            command = [*compiler_command(), *FRAMES, level, "-c", "part.c", "-o", "part.o"]
            run_compiler(command, folder)


def test_a_controller_acts_at_every_few_steps_of_its_plant() -> None:
    """A sampled part called four times a period changes its command at the fourth call."""
    part = psa.part_model("position_controller")
    found = fixed_step(part, name="part", step=1.25e-5)
    u = np.column_stack([np.linspace(0.0, 1e-6, 401), np.zeros(401)])
    command = Probe(found.plan, found.texts).play(u)[:, 0]
    moved = np.flatnonzero(np.diff(command)) + 2  # the number of the call that changes it
    assert len(moved) > 90
    assert not np.any(moved % 4)
