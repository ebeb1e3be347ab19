"""The benchmark `floors`: a diagnosis of measured records beside the floor of each of them.

The floor is the held-out error of many features fitted together, none of them with a physical
meaning: what a model of the plant's kind could reach at best on the same samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from psa_casadi import datasets
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.held_out import Errors, errors_of
from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.records import read_records
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment
from psa_casadi.report.words.tables import Table
from tests.benchmarks.floor_fit import Floor, Part, floor_of
from tests.benchmarks.table import Outcome, Progress, TitledTable

_HEAD = ("record", "base", "extended", "floor", "extended / floor", "verdict", "causes")
_NOTE = (
    "Held-out rms, percent of range, in the samples that `psa diagnose` holds out. The floor: plays"
    " with squares and cubes, relaxations over decades, modes, a fine curve over the displacement,"
    " linear in their weights, their prior sizes and their number by evidence."
)


def run(progress: Progress, quick: bool) -> Outcome:
    """Diagnose the public records; `quick` takes the shortest one alone."""
    sine, loops = datasets.micromanipulator()
    cases = [("minor loops", [loops])]
    if not quick:
        axis = datasets.load("steering_mirror")[0]
        cases += [("sine", [sine]), ("both", [sine, loops]), (axis.name, [axis])]
    return _outcome(cases, progress)


def run_on(progress: Progress, folder: Path) -> Outcome:
    """Diagnose every record of a folder by itself."""
    paths = sorted(p for p in folder.glob("*.csv"))
    if not paths:
        raise InputError(f"{folder}: holds no CSV file; name the folder with your records.")
    return _outcome([(r.name, [r]) for r in read_records(paths)], progress)


def floor_on(experiments: Sequence[Experiment], progress: Progress) -> tuple[Floor, Errors]:
    """Return the floor of experiments and its errors, in training and held-out samples."""
    voltages = [e.record.voltage for e in experiments]
    high, low = max(float(v.max()) for v in voltages), min(float(v.min()) for v in voltages)
    middle, half = 0.5 * (high + low), 0.5 * (high - low)
    size = max(e.record.range_m for e in experiments)
    parts = [
        Part((v - middle) / half, measured(e.record) / size, e.used)
        for v, e in zip(voltages, experiments, strict=True)
    ]
    floor = floor_of(parts, progress)
    return floor, errors_of(experiments, [size * y for y in floor.predicted])


def _outcome(cases: Sequence[tuple[str, Sequence[Record]]], progress: Progress) -> Outcome:
    rows, ratios = [], []
    for name, records in cases:

        def tell(step: str, name: str = name) -> None:
            progress(f"{name}: {step}")

        found = diagnose(records, progress=tell)
        errors = floor_on(found.experiments, tell)[1]
        base, extended, floor = (
            e.holdout_nrmse_percent for e in (found.base_errors, found.extended_errors, errors)
        )
        ratios.append(extended / floor)
        causes = ", ".join(c.effect for c in found.causes)
        rows.append(
            (name, *(f"{x:.3f}" for x in (base, extended, floor)), f"{ratios[-1]:.2f}",
             found.verdict, causes)
        )  # fmt: skip
    worst = f" Extended over floor: median {np.median(ratios):.2f}, worst {max(ratios):.2f}."
    return Outcome(
        (
            TitledTable(
                "Measured records and their floors", Table(_HEAD, tuple(rows)), _NOTE + worst
            ),
        )
    )


FloatArray = npt.NDArray[np.float64]

#: Thresholds of the plays over half the voltage's range; relaxations in a decade of their time;
#: voltages of the last samples that act directly.
PLAYS, IN_A_DECADE, TAPS = 14, 2, 4
#: Powers of the plays, each with a prior of its own.
_POWERS = (1, 2, 3)


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns (samples, count) of one kind; weights of a kind have one prior size between them."""

    kind: str
    values: FloatArray


@dataclass(frozen=True)
class Mode:
    """A mode of a sampled system: frequency over the sampling rate, and damping ratio.

    One without damping is a line, as the mains leave it: no voltage drives it.
    """

    frequency: float
    damping: float

    @property
    def pole(self) -> complex:
        """Its pole in the z plane."""
        w = 2.0 * np.pi * self.frequency
        return complex(np.exp((-self.damping + 1j * np.sqrt(1.0 - self.damping**2)) * w))


def play(v: FloatArray, threshold: float, before: Sequence[float]) -> FloatArray:
    """Return the play of a voltage that went through the values `before` it began."""
    state = 0.0
    for x in before:
        state = min(max(state, x - threshold), x + threshold)
    shown = np.empty_like(v)
    for k, x in enumerate(v.tolist()):
        state = min(max(state, x - threshold), x + threshold)
        shown[k] = state
    return shown


def memory(v: FloatArray, before: Sequence[float]) -> list[Columns]:
    """Return the voltage [of half its range] and its plays, with their squares and cubes."""
    thresholds = np.arange(1, PLAYS + 1) / (PLAYS + 1.0)
    plays = np.column_stack([play(v, float(r), before) for r in thresholds])
    curve = Columns("voltage", np.column_stack([v, v**2, v**3]))
    return [curve, *(Columns(f"plays^{p}", plays**p) for p in _POWERS)]


def relaxations(v: FloatArray, driving: FloatArray, longest: float) -> list[Columns]:
    """Return what lags behind the voltage and behind a play, and what is left of its start.

    Times go from one sample to `longest` samples.
    """
    count = max(2, int(np.ceil(IN_A_DECADE * np.log10(longest))))
    times = np.geomspace(1.0, longest, count)
    k = np.arange(len(v))
    lags = [np.column_stack([s - _lagging(s, t) for t in times]) for s in (v, driving)]
    start = np.column_stack([np.exp(-k / t) for t in times])
    return [
        Columns("relaxations", lags[0]),
        Columns("relaxations of a play", lags[1]),
        Columns("start", start),
    ]


def taps(v: FloatArray) -> Columns:
    """Return the last voltages: what acts at once, and a delay of some samples."""
    shown = [np.r_[np.full(k, v[0]), v[: len(v) - k]] for k in range(1, TAPS + 1)]
    return Columns("taps", np.column_stack(shown))


def modal(v: FloatArray, mode: Mode) -> Columns:
    """Return the answer of a damped mode to the voltage, in both phases."""
    s = lfilter([1.0], [1.0, -mode.pole], v.astype(complex))
    return Columns("modes", np.column_stack([s.real, s.imag]))


def ringing(n: int, mode: Mode) -> Columns:
    """Return the motion that a mode has by itself, in both phases."""
    s = mode.pole ** np.arange(n)
    kind = "start of modes" if mode.damping else "start of lines"
    return Columns(kind, np.column_stack([s.real, s.imag]))


def fine_curve(displacement: FloatArray, low: float, high: float, knots: int) -> Columns:
    """Return hats over the displacement: what is fixed to a place, up and down alike."""
    at = np.clip((displacement - low) / (high - low), 0.0, 1.0) * (knots - 1)
    hats = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(knots)))
    return Columns("fine curve", hats)


def apart(values: Sequence[FloatArray]) -> FloatArray:
    """Return blocks one under the other, each in columns of its own."""
    whole = np.zeros((sum(len(v) for v in values), sum(v.shape[1] for v in values)))
    row = column = 0
    for v in values:
        whole[row : row + len(v), column : column + v.shape[1]] = v
        row, column = row + len(v), column + v.shape[1]
    return whole


def _lagging(v: FloatArray, time: float) -> FloatArray:
    """Return a voltage behind a first-order lag of so many samples, settled at its start."""
    a = float(np.exp(-1.0 / time))
    lag, _ = lfilter([1.0 - a], [1.0, -a], v, zi=[a * v[0]])
    shown: FloatArray = lag
    return shown
