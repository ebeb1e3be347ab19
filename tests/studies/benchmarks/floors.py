"""Held-out errors of diagnoses of measured records, and the floor of each.

The floor is the held-out error of a linear fit of many features without physical meaning: what a
model of the plant's kind could reach at best on the same samples. The features come from the
voltage alone and share nothing with the package's models: plays with their squares and cubes,
relaxations over decades, discrete modes, a fine curve over the displacement. The evidence of the
fitted samples chooses the history before a record, the knots of the curve and the number of modes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.ndimage import median_filter
from scipy.optimize import minimize
from scipy.signal import lfilter

import psa_casadi as psa
from psa_casadi import datasets
from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.diagnosis.held_out import Errors, errors_of
from psa_casadi.records.split import Experiment
from psa_casadi.report.plots.figures import narrow_figure
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable


def run(progress: Progress, quick: bool, folder: Path | None = None) -> Outcome:
    """Diagnose the public records, or those of a folder; `quick` takes the shortest alone."""
    if folder is not None:
        paths = sorted(folder.glob("*.csv"))
        if not paths:
            raise psa.InputError(f"{folder}: holds no CSV file; name the folder with your records.")
        cases = [(r.name, [r]) for r in psa.read_records(paths)]
    else:
        sine, loops = datasets.micromanipulator()
        cases = [("minor loops", [loops])]
        if not quick:
            axis = datasets.load("steering_mirror")[0]
            cases += [("sine", [sine]), ("both", [sine, loops]), (axis.name, [axis])]
    rows, ratios = [], []
    for name, records in cases:

        def report(step: str, name: str = name) -> None:
            progress(f"{name}: {step}")

        d = psa.diagnose(records, progress=report)
        errors = (d.base_errors, d.extended_errors, floor_on(d.experiments, report))
        base, extended, floor = (e.holdout_nrmse_percent for e in errors)
        ratios.append(extended / floor)
        rows.append({
            "record": name, "base": f"{base:.3f}", "extended": f"{extended:.3f}",
            "floor": f"{floor:.3f}", "extended / floor": f"{ratios[-1]:.2f}", "verdict": d.verdict,
            "causes": ", ".join(c.effect for c in d.causes),
        })  # fmt: skip
    note = (
        "Held-out rms, percent of range, in the samples that `psa diagnose` holds out. The floor:"
        " plays with squares and cubes, relaxations over decades, modes, a fine curve over the"
        " displacement, linear in their weights, their prior sizes and their number by evidence."
        f" Extended over floor: median {np.median(ratios):.2f}, worst {max(ratios):.2f}."
    )
    return Outcome((TitledTable("Measured records and their floors", rows, note),))


def floor_on(experiments: Sequence[Experiment], progress: Progress) -> Errors:
    """Return the errors of the floor of experiments, in training and held-out samples."""
    voltages = np.concatenate([e.record.voltage for e in experiments])
    middle, half = 0.5 * (voltages.max() + voltages.min()), 0.5 * float(np.ptp(voltages))
    size = max(e.record.range_m for e in experiments)
    parts = [
        Part((e.record.voltage - middle) / half, e.record.measured / size, e.used)
        for e in experiments
    ]
    return errors_of(experiments, [size * y for y in floor_of(parts, progress).predicted])


IntArray = IndexArray
#: Columns (samples, count) by kind; weights of a kind have one prior size between them.
Columns = dict[str, FloatArray]

#: Thresholds of the plays over half the voltage's range; relaxations in a decade of their time;
#: voltages of the last samples that act directly.
PLAYS, IN_A_DECADE, TAPS = 14, 2, 4
#: Powers of the plays, each with a separate prior.
_POWERS = (1, 2, 3)


class Mode(NamedTuple):
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
    values = np.empty_like(v)
    for k, x in enumerate(v.tolist()):
        state = min(max(state, x - threshold), x + threshold)
        values[k] = state
    return values


def memory(v: FloatArray, before: Sequence[float]) -> Columns:
    """Return the voltage [of half its range] and its plays, with their squares and cubes.

    And the last voltages: what acts at once, and a delay of some samples.
    """
    thresholds = np.arange(1, PLAYS + 1) / (PLAYS + 1.0)
    plays = np.column_stack([play(v, float(r), before) for r in thresholds])
    late = [np.r_[np.full(k, v[0]), v[: len(v) - k]] for k in range(1, TAPS + 1)]
    curve = {"voltage": np.column_stack([v, v**2, v**3])}
    powers = {f"plays^{p}": plays**p for p in (1, 2, 3)}
    return {**curve, **powers, "taps": np.column_stack(late)}


def relaxations(v: FloatArray, driving: FloatArray, longest: float) -> Columns:
    """Return what lags behind the voltage and behind a play, and what is left of its start.

    Times go from one sample to `longest` samples.
    """
    count = max(2, int(np.ceil(IN_A_DECADE * np.log10(longest))))
    times, k = np.geomspace(1.0, longest, count), np.arange(len(v))
    lags = [np.column_stack([s - _lagging(s, t) for t in times]) for s in (v, driving)]
    start = np.column_stack([np.exp(-k / t) for t in times])
    return {"relaxations": lags[0], "relaxations of a play": lags[1], "start": start}


def modal(v: FloatArray, mode: Mode) -> FloatArray:
    """Return the answer of a damped mode to the voltage, in both phases (n, 2)."""
    s = lfilter([1.0], [1.0, -mode.pole], v.astype(complex))
    return np.column_stack([s.real, s.imag])


def ringing(n: int, mode: Mode) -> FloatArray:
    """Return the motion that a mode has by itself, in both phases (n, 2)."""
    s = mode.pole ** np.arange(n)
    return np.column_stack([s.real, s.imag])


def fine_curve(displacement: FloatArray, low: float, high: float, knots: int) -> FloatArray:
    """Return hats over the displacement: a function of the place, the same up and down."""
    at = np.clip((displacement - low) / (high - low), 0.0, 1.0) * (knots - 1)
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(knots))))


def _lagging(v: FloatArray, time: float) -> FloatArray:
    """Return a voltage behind a first-order lag of `time` samples, settled at its start."""
    a = float(np.exp(-1.0 / time))
    lag, _ = lfilter([1.0 - a], [1.0, -a], v, zi=[a * v[0]])
    values: FloatArray = lag
    return values


#: Frequencies over the sampling rate and dampings that a mode is looked for at, and their limits:
#: slower and less damped ones produce loops at the frequency of the voltage.
_FREQUENCIES, _DAMPINGS = np.linspace(0.02, 0.495, 96), (0.005, 0.02, 0.08)
_SLOWEST, _FASTEST, _LEAST, _MOST = 0.02, 0.4999, 4e-3, 0.7
#: Smallest ratio of a line to the median of its neighbours in the spectrum, and number of these; of
#: noise alone the largest of 10,000 is 3.6 times as large.
_STANDS_OUT, _NEIGHBOURS = 5.0, 101
#: Relative size of a ridge that only keeps the projections regular; steps of a refinement.
_REGULAR, _STEPS = 1e-9, 60


@dataclass(frozen=True, eq=False)
class Projection:
    """The projection of an output on features (samples, count), and its rest."""

    features: FloatArray
    left: FloatArray
    factor: tuple[FloatArray, bool]

    def gain(self, columns: FloatArray) -> float:
        """Return by how much more columns lessen the sum of squares that is left."""
        rest = columns - self.features @ cho_solve(self.factor, self.features.T @ columns)
        gram = rest.T @ rest + _REGULAR * np.eye(columns.shape[1]) * float(np.sum(columns**2))
        cross = rest.T @ self.left
        return float(cross @ np.linalg.solve(gram, cross))


def project(features: FloatArray, output: FloatArray) -> Projection:
    """Return the rest of an output after a projection on features."""
    gram = features.T @ features
    gram += np.diag(_REGULAR * np.diag(gram) + np.finfo(float).tiny)
    factor = cho_factor(gram, lower=True)
    return Projection(features, output - features @ cho_solve(factor, features.T @ output), factor)


class Search:
    """Looks for modes of voltages, one array for each record, judged at their used samples."""

    def __init__(self, voltages: Sequence[FloatArray], used: BoolArray) -> None:
        self._voltages, self._used = voltages, used
        self._grid = [
            (mode, self._answer(mode))
            for mode in (Mode(float(f), d) for f in _FREQUENCIES for d in _DAMPINGS)
        ]

    def next(self, others: Projection) -> Mode:
        """Return the mode or the line that explains most of what is left, refined."""
        mode = max(self._grid, key=lambda pair: others.gain(pair[1]))[0]
        tuned = [self.tuned(m, others) for m in (mode, *self._line(others))]
        return max(tuned, key=lambda m: others.gain(self._answer(m)))

    def tuned(self, mode: Mode, others: Projection) -> Mode:
        """Return a mode with the frequency, and the damping unless it is 0, that explain most."""
        line = mode.damping == 0.0
        step = 0.3 / len(self._used) if line else 0.002

        def made(x: FloatArray) -> Mode:
            frequency = float(np.clip(x[0], _SLOWEST, _FASTEST))
            if line:
                return Mode(frequency, 0.0)
            return Mode(frequency, float(np.exp(np.clip(x[1], np.log(_LEAST), np.log(_MOST)))))

        def loss(x: FloatArray) -> float:
            return -others.gain(self._answer(made(x)))

        begin = np.array([mode.frequency] if line else [mode.frequency, np.log(mode.damping)])
        moves = np.vstack([np.zeros(len(begin)), np.diag([step, 0.7][: len(begin)])])
        options: Any = {"maxfev": _STEPS, "initial_simplex": begin + moves}
        result: Any = minimize(loss, begin, method="Nelder-Mead", options=options)
        return made(result.x)

    def _line(self, others: Projection) -> list[Mode]:
        """Return the largest line in the spectrum of the rest, if one exceeds its neighbours."""
        left = np.zeros(len(self._used))
        left[self._used] = others.left
        size = np.abs(np.fft.rfft(left))
        frequency = np.arange(len(size)) / len(left)
        out = size > _STANDS_OUT * median_filter(size, _NEIGHBOURS)
        out &= (frequency > _SLOWEST) & (frequency < _FASTEST)
        return [Mode(float(frequency[np.argmax(size * out)]), 0.0)] if out.any() else []

    def _answer(self, mode: Mode) -> FloatArray:
        if mode.damping == 0.0:
            return block_diag(*(ringing(len(v), mode) for v in self._voltages))[self._used]
        return np.vstack([modal(v, mode) for v in self._voltages])[self._used]


#: Rounds of the re-estimation of the prior sizes and the noise, and when they have settled.
_RIDGE_ROUNDS, _SETTLED = 60, 1e-3
#: Precision of a weight without a prior, and the largest of any, in units of the output's rms.
_FREE, _LARGEST = 1e-8, 1e10


@dataclass(frozen=True, eq=False)
class Ridge:
    """Weights (features,), the standard deviation of what is left, and the log evidence."""

    weights: FloatArray
    sigma: float
    evidence: float


def ridge(features: FloatArray, kinds: IntArray, y: FloatArray) -> Ridge:
    """Fit y = features @ weights; kind 0 has no prior, evidence sizes that of all others.

    MacKay's re-estimation: each size from the weights and how well the data determine them.
    """
    size = np.sqrt(np.mean(features**2, axis=0))
    size[size == 0.0] = 1.0
    scale = float(np.sqrt(np.mean(y**2))) or 1.0
    x, target = features / size, y / scale
    gram, cross, power = x.T @ x, x.T @ target, float(target @ target)
    n = len(y)
    precision, beta = np.where(kinds == 0, _FREE, 1.0), 1e4
    for _ in range(_RIDGE_ROUNDS):
        w, inverse, _ = _solved(gram, cross, precision, beta)
        left = max(power - 2.0 * float(w @ cross) + float(w @ gram @ w), 1e-14 * power)
        known = 1.0 - precision * np.diag(inverse)
        before = precision
        precision, beta = precision.copy(), (n - float(known.sum())) / left
        for kind in set(kinds.tolist()) - {0}:
            of = kinds == kind
            precision[of] = min(float(known[of].sum()) / float(w[of] @ w[of]), _LARGEST)
        if np.all(np.abs(np.log(precision / before)) < _SETTLED):
            break
    w, _, half_log_det = _solved(gram, cross, precision, beta)
    left = power - 2.0 * float(w @ cross) + float(w @ gram @ w)
    evidence = 0.5 * (
        n * np.log(beta)
        + float(np.sum(np.log(precision)))
        - 2.0 * half_log_det
        - beta * left
        - float(precision @ w**2)
    )
    return Ridge(w * scale / size, scale / np.sqrt(beta), float(evidence))


def _solved(
    gram: FloatArray, cross: FloatArray, precision: FloatArray, beta: float
) -> tuple[FloatArray, FloatArray, float]:
    """Return the weights, their covariance, and half the log determinant of its inverse."""
    factor = cho_factor(beta * gram + np.diag(precision), lower=True)
    inverse: FloatArray = cho_solve(factor, np.eye(len(cross)))
    return beta * (inverse @ cross), inverse, float(np.sum(np.log(np.diag(factor[0]))))


History = tuple[float, ...]

#: Where the voltage may have gone before a record, in half its range from its middle.
HISTORIES: tuple[History, ...] = ((), (1.0,), (-1.0,), (1.0, -1.0), (-1.0, 1.0))
#: Most modes; the log evidence that one has to add, the price of its frequency and damping.
_MODES, _WORTH = 14, 25.0
#: The play that relaxations follow, as they do the voltage; numbers of knots of a curve over the
#: displacement (0: no curve), and its rounds.
_FOLLOWED, _KNOTS, _ROUNDS = 0.3, (0, 6, 10, 20, 40, 80), 3


@dataclass(frozen=True, eq=False)
class Part:
    """A record: voltage [of half the range, from its middle], displacement, samples to fit."""

    voltage: FloatArray
    displacement: FloatArray
    used: BoolArray


class Floor(NamedTuple):
    """The fit of records: predicted displacements, modes and lines, histories, curve's knots."""

    predicted: tuple[FloatArray, ...]
    modes: tuple[Mode, ...]
    histories: tuple[History, ...]
    knots: int


class _Fitted(NamedTuple):
    """A fit: features (samples, count) of all parts, the displacement, the curve's columns."""

    ridge: Ridge
    features: FloatArray
    predicted: FloatArray
    curves: Sequence[Columns]


class _Problem:
    """The parts of a floor; columns that do not change between fits are kept."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.voltages = [p.voltage for p in parts]
        self.used = np.concatenate([p.used for p in parts])
        self.y = np.concatenate([p.displacement for p in parts])
        self.slow = cache(self._slow)

    def columns(self, histories: Sequence[History], modes: Sequence[Mode]) -> list[Columns]:
        """Return the columns of every part, an offset first."""
        every = []
        for k, (v, history) in enumerate(zip(self.voltages, histories, strict=True)):
            table = {"offset of its start": np.ones((len(v), 1)), **self.slow(k, history)}
            parts = [("modes", modal(v, m)) for m in modes if m.damping]
            parts += [(f"start of {'modes' if m.damping else 'lines'}", ringing(len(v), m))
                      for m in modes]  # fmt: skip
            for kind in dict.fromkeys(kind for kind, _ in parts):
                table[kind] = np.hstack([x for name, x in parts if name == kind])
            every.append(table)
        return every

    def _slow(self, k: int, history: History) -> Columns:
        v = self.voltages[k]
        longest = 3.0 * max(map(len, self.voltages))
        return memory(v, history) | relaxations(v, play(v, _FOLLOWED, history), longest)

    def fitted(self, columns: Sequence[Columns], curves: Sequence[Columns] = ()) -> _Fitted:
        """Fit the used samples with the columns, and with curves over the displacement."""
        features, kinds = stacked(columns, curves)
        result = ridge(features[self.used], kinds, self.y[self.used])
        return _Fitted(result, features, features @ result.weights, curves)

    def with_curve(self, columns: Sequence[Columns], knots: int) -> _Fitted:
        """Fit with a curve over what the other columns say that the displacement is."""
        fitted = self.fitted(columns)
        under = fitted.predicted
        for _ in range(_ROUNDS if knots else 0):
            low, high = float(under.min()), float(under.max())
            hats = [fine_curve(y, low, high, knots) for y in self.split(under)]
            fitted = self.fitted(columns, [{"fine curve": h} for h in hats])
            under = fitted.predicted - np.vstack(hats) @ fitted.ridge.weights[-knots:]
        return fitted

    def best_curve(self, columns: Sequence[Columns]) -> tuple[_Fitted, int]:
        """Return the fit with the knots of most evidence, and their number."""
        tried = [(self.with_curve(columns, knots), knots) for knots in _KNOTS]
        return max(tried, key=lambda pair: pair[0].ridge.evidence)

    def split(self, whole: FloatArray) -> list[FloatArray]:
        """Return an array of all samples as one for each part."""
        return np.split(whole, np.cumsum([len(v) for v in self.voltages])[:-1])


def floor_of(parts: Sequence[Part], progress: Callable[[str], None] = lambda _: None) -> Floor:
    """Fit the parts' used samples and predict all: history, curve, modes, and the curve again."""
    problem = _Problem(parts)
    progress("histories")
    histories = _histories(problem)
    fitted = problem.best_curve(problem.columns(histories, ()))[0]
    modes = _modes(problem, histories, fitted, progress)
    progress("fine curve")
    fitted, knots = problem.best_curve(problem.columns(histories, modes))
    return Floor(tuple(problem.split(fitted.predicted)), modes, histories, knots)


def stacked(
    columns: Sequence[Columns], curves: Sequence[Columns] = ()
) -> tuple[FloatArray, IntArray]:
    """Return the features of all parts, and the kind of each; the first columns have kind 0.

    The transient of a start belongs to one record.
    """
    every = [c | m for c, m in zip(columns, curves or [{}] * len(columns), strict=True)]
    blocks = [
        block_diag(*(c[kind] for c in every)) if "start" in kind
        else np.vstack([c[kind] for c in every])
        for kind in every[0]
    ]  # fmt: skip
    return np.hstack(blocks), np.repeat(np.arange(len(blocks)), [b.shape[1] for b in blocks])


def _histories(problem: _Problem) -> tuple[History, ...]:
    """Return the history of most evidence for each record, one after the other."""
    chosen: list[History] = [()] * len(problem.voltages)
    for k in range(len(chosen)):
        tried = [[*chosen[:k], h, *chosen[k + 1 :]] for h in HISTORIES]
        chosen = max(tried, key=lambda h: problem.fitted(problem.columns(h, ())).ridge.evidence)
    return tuple(chosen)


def _modes(
    problem: _Problem,
    histories: Sequence[History],
    fitted: _Fitted,
    progress: Callable[[str], None],
) -> tuple[Mode, ...]:
    """Add modes and lines one by one, and tune all again, while the evidence grows."""
    used, y, curves = problem.used, problem.y[problem.used], fitted.curves
    search = Search(problem.voltages, used)
    modes: list[Mode] = []
    while len(modes) < _MODES:
        progress(f"mode {len(modes) + 1}")
        tried = [*modes, search.next(project(fitted.features[used], y))]
        for k, mode in enumerate(tried[:-1]):
            without = problem.columns(histories, [*tried[:k], *tried[k + 1 :]])
            tried[k] = search.tuned(mode, project(stacked(without, curves)[0][used], y))
        wider = problem.fitted(problem.columns(histories, tried), curves)
        if wider.ridge.evidence < fitted.ridge.evidence + _WORTH:
            break
        modes, fitted = tried, wider
    return tuple(modes)


def measured(progress: Progress, quick: bool) -> Outcome:
    """Diagnose the records; `quick` takes the sine alone, whose picture is that of README.md."""
    sine, loops = datasets.micromanipulator()
    cases = {
        "sine_1hz": ([sine], []), "minor_loops": ([loops], []), "both files": ([sine, loops], []),
        "minor_loops, judged on sine_1hz": ([loops], [sine]),
    }  # fmt: skip
    rows, diagnoses = [], list[psa.StackDiagnosis]()
    for name in list(cases)[: 1 if quick else None]:
        progress(name)
        d = psa.diagnose(cases[name][0], holdout=cases[name][1])
        diagnoses.append(d)
        rows.append({
            "records": name, "base, held out": f"{d.base_errors.holdout_nrmse_percent:.2f}",
            "extended, held out": f"{d.extended_errors.holdout_nrmse_percent:.2f}",
            "verdict": d.verdict, "causes": ", ".join(c.effect for c in d.causes),
        })  # fmt: skip
    table = TitledTable("Micromanipulator of Y. N. Aye, rms in percent of range", rows)
    return Outcome([table], partial(narrow_figure, diagnoses[0]))
