"""Records that the package simulates itself: nothing is missing, and nothing may be said to be.

Every named stack, driven by a sine, a triangle, a multisine and steps, without noise, rounded to
1 nm as a file may be, and with white noise from 1e-5 to 1e-3 of the range; and a displacement of
0.1 um/V times the voltage, which a stack without hysteresis shows.
"""

import zlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

import psa_casadi as psa
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.records import multisine, sine, triangle
from psa_casadi.report.words.phrases import number
from tests.studies.benchmarks.records import noisy
from tests.studies.benchmarks.table import (
    FloatArray,
    Outcome,
    Progress,
    TitledTable,
    on_all_cores,
    share,
)
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


class Said(NamedTuple):
    """What a diagnosis said of a case; `error` is the largest over the range, "" or a failure."""

    case: Case
    verdict: Verdict | None
    named: tuple[str, ...]
    error: float
    failure: str = ""

    def __str__(self) -> str:
        """Return case and answer in a line."""
        said = self.failure or f"{self.verdict} {', '.join(self.named)} ({self.error:.1e})"
        return f"{self.case.stack}, {self.case.voltage}, noise {self.case.noise}: {said}"


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose all cases on all cores."""
    cases = all_cases()[:: 5 if quick else 1]
    return Outcome([summary(on_all_cores(judged, [(case,) for case in cases], progress))])


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


def judged(case: Case) -> Said:
    """Return what a diagnosis says."""
    record = record_of(case)
    try:
        d = psa.diagnose([record])
    except psa.PsaError as error:
        return Said(case, None, (), float("nan"), str(error))
    error_share = d.base_errors.holdout_rms_m / record.range_m
    return Said(case, d.verdict, tuple(c.effect for c in d.causes), error_share)


def summary(found: Sequence[Said]) -> TitledTable:
    """Return the verdicts by noise."""
    rows = []
    for name in (*NOISES, LINEAR, "all"):
        own = [
            f for f in found if name in ("all", LINEAR if f.case.stack == LINEAR else f.case.noise)
        ]
        errors = [f.error for f in own if np.isfinite(f.error)]
        rows.append({
            "records": f"noise {name}" if name in NOISES else name,
            "adequate": share(f.verdict == "adequate" for f in own),
            "a cause named": share(bool(f.named) for f in own),
            "failed": share(bool(f.failure) for f in own),
            "held-out error / range, median": number(np.median(errors), 2) if errors else "-",
        })  # fmt: skip
    return TitledTable(
        "Simulated records of named stacks, nothing hidden",
        rows,
        f"{_SAMPLES} samples at {_RATE:g} Hz. Noise is the rms over the range, or the resolution of"
        " the file.",
    )
