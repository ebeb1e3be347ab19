"""The floor of records: the held-out error that a linear fit of many features reaches.

What has no prior size (the history before a record, how many knots a curve has, how many modes
there are) is chosen by the evidence of the fitted samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from tests.benchmarks.floor_features import (
    Columns,
    Mode,
    apart,
    fine_curve,
    memory,
    modal,
    play,
    relaxations,
    ringing,
    taps,
)
from tests.benchmarks.floor_modes import Search, beside
from tests.benchmarks.floor_ridge import Ridge, ridge

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
History = tuple[float, ...]

#: Where the voltage may have gone before a record, in half its range from its middle.
HISTORIES: tuple[History, ...] = ((), (1.0,), (-1.0,), (1.0, -1.0), (-1.0, 1.0))
#: Most modes; the log evidence that one has to add, the price of its frequency and damping.
_MODES, _WORTH = 14, 25.0
#: The play that relaxations follow beside the voltage; knots that a curve over the displacement may
#: have (0: no curve), and its rounds.
_FOLLOWED, _KNOTS, _ROUNDS = 0.3, (0, 6, 10, 20, 40, 80), 3


@dataclass(frozen=True, eq=False)
class Part:
    """A record: voltage [of half the range, from its middle], displacement, samples to fit."""

    voltage: FloatArray
    displacement: FloatArray
    used: BoolArray


@dataclass(frozen=True, eq=False)
class Floor:
    """The fit of records: predicted displacements, modes and lines, histories, curve's knots."""

    predicted: tuple[FloatArray, ...]
    modes: tuple[Mode, ...]
    histories: tuple[History, ...]
    knots: int


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A fit: features (samples, count) of all parts, the displacement, the curve's columns."""

    found: Ridge
    features: FloatArray
    shown: FloatArray
    curves: Sequence[Sequence[Columns]]


@dataclass(eq=False)
class _Problem:
    parts: Sequence[Part]
    made: dict[tuple[int, History], list[Columns]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.used = np.concatenate([p.used for p in self.parts])
        self.y = np.concatenate([p.displacement for p in self.parts])

    def columns(self, histories: Sequence[History], modes: Sequence[Mode]) -> list[list[Columns]]:
        """Return the columns of every part, an offset first."""
        every = []
        for k, (part, history) in enumerate(zip(self.parts, histories, strict=True)):
            v = part.voltage
            offset = Columns("offset of its start", np.ones((len(v), 1)))
            driven = [modal(v, m) for m in modes if m.damping]
            free = [ringing(len(v), m) for m in modes]
            every.append([offset, *self._slow(k, history), *driven, *free])
        return every

    def _slow(self, k: int, history: History) -> list[Columns]:
        if (k, history) not in self.made:
            v = self.parts[k].voltage
            longest = 3.0 * max(len(p.voltage) for p in self.parts)
            lags = relaxations(v, play(v, _FOLLOWED, history), longest)
            self.made[k, history] = [*memory(v, history), taps(v), *lags]
        return self.made[k, history]

    def fitted(
        self, columns: Sequence[Sequence[Columns]], curves: Sequence[Sequence[Columns]] = ()
    ) -> _Fitted:
        """Fit the used samples with the columns, and with curves over the displacement."""
        features, kinds = stacked(joined(columns, curves))
        used = self.used
        found = ridge(features[used], kinds, self.y[used])
        return _Fitted(found, features, features @ found.weights, curves)

    def with_curve(self, columns: Sequence[Sequence[Columns]], knots: int) -> _Fitted:
        """Fit with a curve over what the other columns say that the displacement is."""
        fitted = self.fitted(columns)
        under = fitted.shown
        for _ in range(_ROUNDS if knots else 0):
            low, high = float(under.min()), float(under.max())
            curves = [[fine_curve(y, low, high, knots)] for y in self.split(under)]
            fitted = self.fitted(columns, curves)
            hats = np.vstack([c.values for of in curves for c in of])
            under = fitted.shown - hats @ fitted.found.weights[-knots:]
        return fitted

    def best_curve(self, columns: Sequence[Sequence[Columns]]) -> tuple[_Fitted, int]:
        """Return the fit with the knots of most evidence, and their number."""
        tried = [(self.with_curve(columns, knots), knots) for knots in _KNOTS]
        return max(tried, key=lambda pair: pair[0].found.evidence)

    def split(self, shown: FloatArray) -> list[FloatArray]:
        """Return an array of all samples as one for each part."""
        edges = np.cumsum([0, *(len(p.voltage) for p in self.parts)])
        return [shown[a:b] for a, b in pairwise(edges)]


def floor_of(parts: Sequence[Part], progress: Callable[[str], None] = lambda _: None) -> Floor:
    """Fit the parts' used samples and predict all: history, curve, modes, and the curve again."""
    problem = _Problem(parts)
    progress("histories")
    histories = _histories(problem)
    fitted = problem.best_curve(problem.columns(histories, ()))[0]
    modes = _modes(problem, histories, fitted, progress)
    progress("fine curve")
    fitted, knots = problem.best_curve(problem.columns(histories, modes))
    return Floor(tuple(problem.split(fitted.shown)), modes, histories, knots)


def stacked(every: Sequence[Sequence[Columns]]) -> tuple[FloatArray, IntArray]:
    """Return the features of all parts, and the kind of each; the first columns have kind 0.

    What is left of a start belongs to its own record alone.
    """
    blocks: dict[str, list[FloatArray]] = {}
    for same in zip(*every, strict=True):
        values = [c.values for c in same]
        own = "start" in same[0].kind
        blocks.setdefault(same[0].kind, []).append(apart(values) if own else np.vstack(values))
    counts = [sum(b.shape[1] for b in of) for of in blocks.values()]
    kinds = np.repeat(np.arange(len(counts)), counts)
    return np.hstack([b for of in blocks.values() for b in of]), kinds


def joined(
    columns: Sequence[Sequence[Columns]], more: Sequence[Sequence[Columns]]
) -> list[list[Columns]]:
    """Return the columns of every part with more of them, if there are any."""
    return [[*c, *m] for c, m in zip(columns, more or [()] * len(columns), strict=True)]


def _histories(problem: _Problem) -> tuple[History, ...]:
    """Return the history of most evidence for each record, one after the other."""
    chosen: list[History] = [()] * len(problem.parts)
    for k in range(len(chosen)):
        tried = [[*chosen[:k], h, *chosen[k + 1 :]] for h in HISTORIES]
        chosen = max(tried, key=lambda h: problem.fitted(problem.columns(h, ())).found.evidence)
    return tuple(chosen)


def _modes(
    problem: _Problem,
    histories: Sequence[History],
    fitted: _Fitted,
    progress: Callable[[str], None],
) -> tuple[Mode, ...]:
    """Return modes and lines found one by one, all tuned again, while the evidence grows."""
    used, y, curves = problem.used, problem.y[problem.used], fitted.curves
    search = Search([p.voltage for p in problem.parts], used)
    modes: list[Mode] = []
    while len(modes) < _MODES:
        progress(f"mode {len(modes) + 1}")
        tried = [*modes, search.next(beside(fitted.features[used], y))]
        for k, mode in enumerate(tried[:-1]):
            without = problem.columns(histories, [*tried[:k], *tried[k + 1 :]])
            tried[k] = search.tuned(mode, beside(stacked(joined(without, curves))[0][used], y))
        wider = problem.fitted(problem.columns(histories, tried), curves)
        if wider.found.evidence < fitted.found.evidence + _WORTH:
            break
        modes, fitted = tried, wider
    return tuple(modes)
