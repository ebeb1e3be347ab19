"""The floor of records: the held-out error that a linear fit of many features reaches."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from tests.benchmarks.floor_features import (
    Columns,
    Mode,
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
_MODES, _WORTH = 14, 12.0
#: The play that relaxations follow beside the voltage; knots that a curve over the displacement may
#: have, and its rounds.
_FOLLOWED, _KNOTS, _ROUNDS = 0.3, (6, 10, 20, 40), 3


@dataclass(frozen=True, eq=False)
class Part:
    """A record: voltage [of half the range, from its middle], displacement, samples to fit."""

    voltage: FloatArray
    displacement: FloatArray
    used: BoolArray


@dataclass(frozen=True, eq=False)
class Floor:
    """The fit of records: predicted displacements, modes, histories, log evidence."""

    predicted: tuple[FloatArray, ...]
    modes: tuple[Mode, ...]
    histories: tuple[History, ...]
    evidence: float


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Weights of features (samples, count) of all parts, and the displacement they give."""

    found: Ridge
    features: FloatArray
    shown: FloatArray


@dataclass(eq=False)
class _Problem:
    parts: Sequence[Part]
    made: dict[tuple[int, History], list[Columns]] = field(default_factory=dict)

    @property
    def used(self) -> BoolArray:
        return np.concatenate([p.used for p in self.parts])

    @property
    def y(self) -> FloatArray:
        return np.concatenate([p.displacement for p in self.parts])

    def columns(self, histories: Sequence[History], modes: Sequence[Mode]) -> list[list[Columns]]:
        """Return the columns of every part."""
        every = []
        for k, (part, history) in enumerate(zip(self.parts, histories, strict=True)):
            v = part.voltage
            more = [c for m in modes for c in (modal(v, m), ringing(len(v), m))]
            every.append([*self._slow(k, history), *more])
        return every

    def _slow(self, k: int, history: History) -> list[Columns]:
        if (k, history) not in self.made:
            v = self.parts[k].voltage
            longest = 3.0 * max(len(p.voltage) for p in self.parts)
            lags = relaxations(v, play(v, _FOLLOWED, history), longest)
            self.made[k, history] = [*memory(v, history), taps(v), *lags]
        return self.made[k, history]

    def fitted(self, columns: Sequence[Sequence[Columns]]) -> _Fitted:
        """Fit the used samples: an offset of each record, and the columns."""
        offsets = [Columns("offset of its start", np.ones((len(p.voltage), 1))) for p in self.parts]
        features, kinds = stacked([[o, *c] for o, c in zip(offsets, columns, strict=True)])
        found = ridge(features[self.used], kinds, self.y[self.used])
        return _Fitted(found, features, features @ found.weights)

    def split(self, shown: FloatArray) -> list[FloatArray]:
        """Return an array of all samples as one for each part."""
        edges = np.cumsum([0, *(len(p.voltage) for p in self.parts)])
        return [shown[a:b] for a, b in pairwise(edges)]


def stacked(every: Sequence[Sequence[Columns]]) -> tuple[FloatArray, IntArray]:
    """Return the features of all parts, and the kind of each; the first columns have kind 0.

    What is left of a start belongs to its own record alone.
    """
    blocks: dict[str, list[FloatArray]] = {}
    for same in zip(*every, strict=True):
        values = [c.values for c in same]
        own = "start" in same[0].kind
        blocks.setdefault(same[0].kind, []).append(_apart(values) if own else np.vstack(values))
    counts = [sum(b.shape[1] for b in of) for of in blocks.values()]
    return np.hstack([b for of in blocks.values() for b in of]), np.repeat(
        np.arange(len(counts)), counts
    )


def floor_of(parts: Sequence[Part], progress: Callable[[str], None] = lambda _: None) -> Floor:
    """Fit the parts' used samples and predict all: history, then modes, then the fine curve."""
    problem = _Problem(parts)
    progress("histories")
    histories = _histories(problem)
    modes = _modes(problem, histories, progress)
    columns = problem.columns(histories, modes)
    progress("fine curve")
    plain = problem.fitted(columns)
    curved = [_with_curve(problem, columns, plain, knots) for knots in _KNOTS]
    best = max((plain, *curved), key=lambda f: f.found.evidence)
    return Floor(tuple(problem.split(best.shown)), modes, histories, best.found.evidence)


def _with_curve(
    problem: _Problem, columns: Sequence[Sequence[Columns]], plain: _Fitted, knots: int
) -> _Fitted:
    """Return the fit with a curve over what the other columns say that the displacement is."""
    under, curved = plain.shown, plain
    for _ in range(_ROUNDS):
        low, high = float(under.min()), float(under.max())
        curves = [fine_curve(y, low, high, knots) for y in problem.split(under)]
        curved = problem.fitted([[*c, f] for c, f in zip(columns, curves, strict=True)])
        hats = np.vstack([c.values for c in curves])
        under = curved.shown - hats @ curved.found.weights[-knots:]
    return curved


def _histories(problem: _Problem) -> tuple[History, ...]:
    """Return the history of most evidence for each record, one after the other."""
    chosen: list[History] = [()] * len(problem.parts)
    for k in range(len(chosen)):
        tried = [[*chosen[:k], h, *chosen[k + 1 :]] for h in HISTORIES]
        chosen = max(tried, key=lambda h: problem.fitted(problem.columns(h, ())).found.evidence)
    return tuple(chosen)


def _modes(
    problem: _Problem, histories: Sequence[History], progress: Callable[[str], None]
) -> tuple[Mode, ...]:
    """Return modes found one by one, all tuned again after each, as long as the evidence grows."""
    used, y = problem.used, problem.y[problem.used]
    search = Search([p.voltage for p in problem.parts], used)

    def without(modes: Sequence[Mode], k: int) -> list[Mode]:
        return [m for j, m in enumerate(modes) if j != k]

    modes: list[Mode] = []
    fitted = problem.fitted(problem.columns(histories, modes))
    while len(modes) < _MODES:
        progress(f"mode {len(modes) + 1}")
        tried = [*modes, search.next(beside(fitted.features[used], y))]
        for k, mode in enumerate(tried[:-1]):
            others = stacked(problem.columns(histories, without(tried, k)))[0]
            tried[k] = search.tuned(mode, beside(np.c_[fitted.features[:, :1], others][used], y))
        wider = problem.fitted(problem.columns(histories, tried))
        if wider.found.evidence < fitted.found.evidence + _WORTH:
            break
        modes, fitted = tried, wider
    return tuple(modes)


def _apart(values: Sequence[FloatArray]) -> FloatArray:
    """Return blocks one under the other, each in columns of its own."""
    whole = np.zeros((sum(len(v) for v in values), sum(v.shape[1] for v in values)))
    row = column = 0
    for v in values:
        whole[row : row + len(v), column : column + v.shape[1]] = v
        row, column = row + len(v), column + v.shape[1]
    return whole
