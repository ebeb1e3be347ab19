"""The package's simulations are adequate: nothing is missing, and nothing is reported to be.

Every named stack, driven by a sine, a triangle, a multisine and steps, without noise, rounded to
1 nm as a file may be, and with white noise from 1e-5 to 1e-3 of the range; and a displacement of
0.1 um/V times the voltage, which a stack without hysteresis shows. A sixth of them is tried.
"""

import zlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.noise import detection_limit, known_colour, noise_floor
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.records import multisine, sine, triangle
from psa_casadi.records.noise import last_place_of
from tests.studies.benchmarks.records import noisy
from tests.tiers import slow
from tests.voltages import steps

_SAMPLES, _RATE = 2000, 1000.0
LINEAR = "0.1 um/V"
VOLTAGES: dict[str, Callable[[FloatArray, float], FloatArray]] = {
    "sine": lambda t, top: sine(t, 0.0, top, 2.0),
    "triangle": lambda t, top: triangle(t, 0.0, top, 2.0),
    "multisine": lambda t, top: multisine(t, 0.0, top, (0.5, 50.0), seed=1),
    "steps": lambda t, top: steps(t, top * np.array([0.0, 0.5, 1.0, 0.3, 0.8, 0.0, 0.6, 0.2])),
}
#: Noise: None, the file's resolution [m], or the rms over the range.
ROUNDED = 1e-9
NOISES = {"none": 0.0, "1 nm": ROUNDED, "1e-5": 1e-5, "3e-5": 3e-5, "1e-4": 1e-4, "1e-3": 1e-3}


class Case(NamedTuple):
    """One record: a named stack or the straight line, a voltage and a noise."""

    stack: str
    voltage: str
    noise: str


def all_cases() -> list[Case]:
    """Return the cases: every stack with every noise, each with two of the four voltages."""
    names = list(VOLTAGES)
    cases = [
        Case(stack, names[(s + n + 2 * k) % len(names)], noise)
        for s, stack in enumerate(psa.STACKS)
        for n, noise in enumerate(NOISES)
        for k in range(2)
    ]
    return [*cases, *(Case(LINEAR, voltage, "none") for voltage in names)]


def record_of(case: Case) -> psa.Record:
    """Return the record of a case."""
    t = np.asarray(np.arange(_SAMPLES) / _RATE, dtype=np.float64)
    if case.stack == LINEAR:
        v = VOLTAGES[case.voltage](t, 100.0)
        return psa.Record(name="line", time=t, voltage=v, displacement=1e-7 * v)
    model = psa.stack_model(case.stack)
    v = VOLTAGES[case.voltage](t, 0.8 * model.values["u_rated"])
    x = psa.simulate(model, t, v).displacement
    if case.noise == "1 nm":
        x = ROUNDED * np.round(x / ROUNDED)
    clean = psa.Record(name=case.stack, time=t, voltage=v, displacement=x)
    if case.noise in ("none", "1 nm"):
        return clean
    name = f"{case.stack}/{case.voltage}/{case.noise}"  # the same seed in every process
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    return noisy(clean, NOISES[case.noise] * clean.range_m, rng)


QUICK = (
    Case("P-885.51", "sine", "none"),
    Case("demo", "triangle", "1e-4"),
    Case("WYDS0808020", "sine", "1 nm"),
)


@pytest.mark.parametrize(
    "case",
    [*QUICK, *(pytest.param(c, marks=slow) for c in all_cases()[::6] if c not in QUICK)],
    ids=lambda c: f"{c.stack} {c.voltage} {c.noise}",
)
def test_what_the_package_simulates_is_adequate(case: Case) -> None:
    result = psa.diagnose([record_of(case)])
    assert (result.verdict, result.causes) == ("adequate", ())


@pytest.mark.parametrize("step", [1e-6, 1e-9, 1e-10])
def test_the_last_place_of_a_file_is_detected(step: float) -> None:
    x = 1e-5 * np.sin(np.linspace(0.0, 20.0, 3000))
    assert last_place_of(step * np.round(x / step)) == pytest.approx(step)
    assert last_place_of(x) == 0.0
    assert last_place_of(np.zeros(10)) == 0.0


def test_what_can_be_known_holds_rounding_error_and_form() -> None:
    record = record_of(Case("P-885.51", "sine", "1 nm"))
    whole = float(np.ptp(record.displacement)) if record.displacement is not None else np.nan
    rounding, error = 1e-9 / np.sqrt(12.0), 2e-10
    rest = float(np.hypot(error, LIMITS.form_of_range * whole))
    signs = np.where(np.arange(record.n) % 2, 1.0, -1.0)
    small, large = rounding * signs, 2.0 * rounding * signs
    assert detection_limit(record, error, small) == pytest.approx(float(np.hypot(rest, rounding)))
    assert detection_limit(record, error, large) == pytest.approx(rest)  # noise has made it white


def test_what_a_first_loop_leaves_behind_is_no_noise() -> None:
    """Repeats of a triangle that starts at rest differ by the first loop and by creep."""
    record = record_of(Case("demo", "triangle", "1e-4"))
    assert record.displacement is not None
    level = 1e-4 * float(np.ptp(record.displacement))
    residual = level * np.random.default_rng(0).standard_normal(record.n)
    (by_repeats,) = noise_floor([record], [100.0 * residual])
    assert by_repeats.source == "repeats"
    assert by_repeats.level > 1.5 * level
    (floor,) = noise_floor([record], [residual])
    assert floor.source == "fast part"
    assert floor.level == pytest.approx(level, rel=0.1)
    assert known_colour(record, residual) is None
    assert known_colour(record, 100.0 * residual) is not None
