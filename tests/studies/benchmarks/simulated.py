"""Records that the package simulates itself: nothing is missing, and nothing may be said to be.

Every named stack, driven by a sine, a triangle, a multisine and steps, without noise, rounded to
1 nm as a file may be, and with white noise from 1e-5 to 1e-3 of the range; and a displacement of
0.1 um/V times the voltage, which a stack without hysteresis shows.
"""

import zlib
from collections import Counter
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
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.simulate import simulate
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, on_all_cores, share

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
    found = on_all_cores(judged, [(case,) for case in cases], str, progress)
    wrong = [f for f in found if f.verdict != "adequate"]
    return Outcome((summary(found), *([alarms(wrong)] if wrong else [])))


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
        rng = np.random.default_rng(seed_of(case))
        x = x + level * np.ptp(x) * rng.standard_normal(x.size)
    return Record(name=case.stack, time=t, voltage=v, displacement=x)


def seed_of(case: Case) -> int:
    """Return a seed of a case, the same in every process."""
    return zlib.crc32(f"{case.stack}/{case.voltage}/{case.noise}".encode())


def judged(case: Case) -> Said:
    """Return what a diagnosis says."""
    record = record_of(case)
    try:
        d = diagnose([record])
    except PsaError as error:
        return Said(case, None, (), float("nan"), str(error))
    return Said(
        case,
        d.verdict,
        tuple(c.effect for c in d.causes),
        d.base_errors.holdout_rms_m / record.range_m,
    )


def summary(found: Sequence[Said]) -> TitledTable:
    """Return the verdicts by noise."""
    rows = []
    for noise in NOISES:
        own = [f for f in found if f.case.noise == noise and f.case.stack != LINEAR]
        rows.append(_row(f"noise {noise}", own))
    rows.append(_row(LINEAR, [f for f in found if f.case.stack == LINEAR]))
    rows.append(_row("all", found))
    head = ("records", "adequate", "a cause named", "failed", "held-out error / range, median")
    return TitledTable(
        "Simulated records of named stacks, nothing hidden",
        Table(head, tuple(rows)),
        f"{_SAMPLES} samples at {_RATE:g} Hz. Noise is the rms over the range, or the resolution of"
        " the file.",
    )


def _row(name: str, own: Sequence[Said]) -> tuple[str, ...]:
    errors = [f.error for f in own if np.isfinite(f.error)]
    return (
        name,
        share(sum(f.verdict == "adequate" for f in own), len(own)),
        share(sum(bool(f.named) for f in own), len(own)),
        share(sum(bool(f.failure) for f in own), len(own)),
        number(float(np.median(errors)), 2) if errors else "-",
    )


def alarms(wrong: Sequence[Said]) -> TitledTable:
    """Return the records of which something was said to be missing."""
    rows = tuple(
        (
            f.case.stack,
            f.case.voltage,
            f.case.noise,
            f.failure or str(f.verdict),
            ", ".join(f.named),
            number(f.error, 2),
        )
        for f in wrong
    )
    named = Counter(n for f in wrong for n in f.named)
    note = "; ".join(f"{n} {k} times" for n, k in named.most_common())
    head = ("stack", "voltage", "noise", "verdict", "named", "held-out error / range")
    return TitledTable("Records with an alarm", Table(head, rows), note)
