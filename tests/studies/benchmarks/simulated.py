"""Records that the package simulates itself: nothing is missing, and nothing may be said to be.

Every named stack, driven by a sine, a triangle, a multisine and steps, without noise, rounded to
1 nm as a file may be, and with white noise from 1e-5 to 1e-3 of the range; and a displacement of
0.1 um/V times the voltage, which a stack without hysteresis shows.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.errors import PsaError
from psa_casadi.model.stacks import STACKS, stack_model
from psa_casadi.records.excitation import multisine, sine, steps, triangle
from psa_casadi.records.record import Record
from psa_casadi.report.words.phrases import number
from psa_casadi.simulation.simulate import simulate
from tests.studies.benchmarks.table import (
    Outcome,
    Progress,
    TitledTable,
    on_all_cores,
    share,
    table_of,
)

FloatArray = npt.NDArray[np.float64]

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
NOISES: dict[str, float] = {
    "none": 0.0,
    "1 nm": ROUNDED,
    "1e-5": 1e-5,
    "3e-5": 3e-5,
    "1e-4": 1e-4,
    "1e-3": 1e-3,
}


@dataclass(frozen=True)
class Case:
    """One record: a named stack or the straight line, a voltage and a noise."""

    stack: str
    voltage: str
    noise: str


@dataclass(frozen=True)
class Said:
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
    return Outcome([summary(on_all_cores(judged, [(case,) for case in cases], str, progress))])


def all_cases() -> list[Case]:
    """Return the cases: every stack with every noise, each with two of the four voltages."""
    names = list(VOLTAGES)
    cases = [
        Case(stack, names[(s + n + 2 * k) % len(names)], noise)
        for s, stack in enumerate(STACKS)
        for n, noise in enumerate(NOISES)
        for k in range(2)
    ]
    return [*cases, *(Case(LINEAR, voltage, "none") for voltage in names)]


def record_of(case: Case) -> Record:
    """Return the record of a case."""
    t = np.asarray(np.arange(_SAMPLES) / _RATE, dtype=np.float64)
    if case.stack == LINEAR:
        v = VOLTAGES[case.voltage](t, 100.0)
        return Record(name="line", time=t, voltage=v, displacement=1e-7 * v)
    model = stack_model(case.stack)
    v = VOLTAGES[case.voltage](t, 0.8 * model.values["u_rated"])
    x = simulate(model, t, v).displacement
    level = NOISES[case.noise]
    if case.noise == "1 nm":
        x = ROUNDED * np.round(x / ROUNDED)
    elif level > 0.0:
        name = f"{case.stack}/{case.voltage}/{case.noise}"  # the same seed in every process
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        x = x + level * np.ptp(x) * rng.standard_normal(x.size)
    return Record(name=case.stack, time=t, voltage=v, displacement=x)


def judged(case: Case) -> Said:
    """Return what a diagnosis says."""
    record = record_of(case)
    try:
        d = diagnose([record])
    except PsaError as error:
        return Said(case, None, (), float("nan"), str(error))
    error_share = d.base_errors.holdout_rms_m / record.range_m
    return Said(case, d.verdict, tuple(c.effect for c in d.causes), error_share)


def summary(found: Sequence[Said]) -> TitledTable:
    """Return the verdicts by noise."""
    groups = {
        f"noise {n}": [f for f in found if f.case.noise == n and f.case.stack != LINEAR]
        for n in NOISES
    }
    groups |= {LINEAR: [f for f in found if f.case.stack == LINEAR], "all": [*found]}

    def counted(holds: Callable[[Said], bool]) -> Callable[[str], str]:
        return lambda n: share(sum(map(holds, groups[n])), len(groups[n]))

    def error(name: str) -> str:
        errors = [f.error for f in groups[name] if np.isfinite(f.error)]
        return number(float(np.median(errors)), 2) if errors else "-"

    columns: dict[str, Callable[[str], str]] = {
        "records": str, "adequate": counted(lambda f: f.verdict == "adequate"),
        "a cause named": counted(lambda f: bool(f.named)),
        "failed": counted(lambda f: bool(f.failure)), "held-out error / range, median": error,
    }  # fmt: skip
    return table_of(
        "Simulated records of named stacks, nothing hidden",
        groups,
        columns,
        f"{_SAMPLES} samples at {_RATE:g} Hz. Noise is the rms over the range, or the resolution of"
        " the file.",
    )
