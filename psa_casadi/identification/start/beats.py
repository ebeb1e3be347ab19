"""A saw tooth in delays over time: the beat of two clocks, told from everything that is smooth.

    d(t) = c_0 + c_1 t + height ((phase + beats t / T) mod 1)

in local delays d [s], each with a weight, over a record of T seconds.
"""

from dataclasses import dataclass
from math import ceil, floor

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

#: Beats that a record may hold; phases that are tried, and how much finer than 1/T the rates.
FEWEST, MOST = 2.0, 24.0
_PHASES, _FINER = 32, 8
#: Steps on either side in which a best one is refined, and the share of its grid's step each time.
_REFINED, _ROUNDS = 8, (1.0, 0.125)
#: What a saw tooth must remove of the squares over the scatter that is left, and how much more
#: than the first harmonics of its period do, this many of them, which are free in six weights.
_CLEAR, _SHARPER, _HARMONICS = 150.0, 15.0, 3
#: Its height in either half of the record must be this far from 0, in its standard deviation, and
#: this close to that of the whole; a jump within the record the same.
_HALF, _ALIKE = 6.0, 0.35
_JUMP, _JUMPS = 3.0, 2
#: Intervals within half a beat of a jump that show it.
_BESIDE = 8


@dataclass(frozen=True)
class Beat:
    """A saw tooth: beats in the record, phase at its start [beats], height [s] with its sign."""

    beats: float
    phase: float
    height: float

    def saw(self, along: FloatArray) -> FloatArray:
        """Return the saw tooth, 0 to 1, at times along the record, 0 to 1."""
        found: FloatArray = (self.phase + self.beats * along) % 1.0
        return found


@dataclass(frozen=True, eq=False)
class Delays:
    """Local delays (k,) [s] at times (k,) along a record, 0 to 1, with weights (k,) [1/s^2]."""

    along: FloatArray
    delay: FloatArray
    weight: FloatArray

    def best(self, most: float) -> Beat | None:
        """Return the saw tooth that removes most of the squares, of `FEWEST` to `most` beats."""
        first, last = ceil(FEWEST * _FINER), floor(min(most, MOST) * _FINER)
        if last < first:
            return None
        beats = np.arange(first, last + 1) / _FINER
        return self.refined(self._scanned(beats, np.arange(_PHASES) / _PHASES))

    def refined(self, beat: Beat) -> Beat:
        """Return the best saw tooth next to one."""
        steps = np.arange(-_REFINED, _REFINED + 1) / _REFINED
        for part in _ROUNDS:
            beat = self._scanned(
                beat.beats + part * steps / _FINER, beat.phase + part * steps / _PHASES
            )
        return beat

    def shows(self, beat: Beat) -> bool:
        """Whether these delays show that saw tooth beyond doubt.

        By all of

        * what it removes: `_CLEAR` times the scatter that is left, which no noise reaches;
        * its jumps: three free harmonics of its period leave more than it does;
        * both halves of the record, and every jump that has room on both sides, two at least.
        """
        saw, dof = beat.saw(self.along), self.along.size - 5
        left = self._left(saw[:, None])
        scatter = left / max(dof, 1)
        removed = (self._left() - left) / scatter
        turns = 2.0 * np.pi * beat.beats * np.outer(self.along, np.arange(1, _HARMONICS + 1))
        smooth = self._left(np.hstack([np.cos(turns), np.sin(turns)]))
        if removed < _CLEAR or (smooth - left) / scatter < _SHARPER:
            return False
        halves = [self._height(saw, half) for half in (self.along < 0.5, self.along >= 0.5)]
        jumps = [j for at in self._jumps(beat) if (j := self._jump(at, beat.beats, scatter))]
        alike = [abs(h / beat.height - 1.0) < _ALIKE and abs(z) > _HALF for h, z in halves]
        alike += [abs(h / beat.height - 1.0) < _ALIKE and abs(z) > _JUMP for h, z in jumps]
        return len(jumps) >= _JUMPS and all(alike)

    def _scanned(self, beats: FloatArray, phases: FloatArray) -> Beat:
        root, along = np.sqrt(self.weight), self.along
        line = np.linalg.qr(np.column_stack([root, root * along]))[0]
        wanted = root * self.delay
        wanted -= line @ (line.T @ wanted)
        best = (-1.0, Beat(1.0, 0.0, 0.0))
        for rate in beats.tolist():
            saws = root[:, None] * ((phases + rate * along[:, None]) % 1.0)
            saws -= line @ (line.T @ saws)
            power = np.maximum(np.sum(saws**2, axis=0), 1e-300)
            told = saws.T @ wanted
            k = int(np.argmax(told**2 / power))
            removed = float(told[k] ** 2 / power[k])
            if removed > best[0]:
                best = removed, Beat(rate, float(phases[k]) % 1.0, float(told[k] / power[k]))
        return best[1]

    def _left(self, columns: FloatArray | None = None) -> float:
        """Return the weighted squares that a straight line and columns (k, j) leave."""
        line = np.column_stack([np.ones(self.along.size), self.along])
        return self._fitted(line if columns is None else np.hstack([columns, line]))[2]

    def _fitted(
        self, columns: FloatArray, part: slice | npt.NDArray[np.bool_] = slice(None)
    ) -> tuple[float, float, float]:
        """Return the first column's weight, its variance per scatter, and the squares left."""
        root = np.sqrt(self.weight[part])
        q, r = np.linalg.qr(root[:, None] * columns[part])
        wanted = root * self.delay[part]
        inverse = np.linalg.pinv(r)
        left = wanted - q @ (q.T @ wanted)
        return float(inverse[0] @ q.T @ wanted), float(inverse[0] @ inverse[0]), float(left @ left)

    def _height(self, saw: FloatArray, half: npt.NDArray[np.bool_]) -> tuple[float, float]:
        """Return the height in a half of the record, and over its standard deviation."""
        constant = np.ones(saw.size)
        height, variance, left = self._fitted(np.column_stack([saw, constant]), half)
        return height, height / max((left / max(half.sum() - 2, 1) * variance) ** 0.5, 1e-300)

    @staticmethod
    def _jumps(beat: Beat) -> FloatArray:
        """Return the jumps with a quarter of a beat on both sides within the record, (j,)."""
        turns = np.arange(ceil(beat.phase), floor(beat.phase + beat.beats) + 1, dtype=np.float64)
        at: FloatArray = (turns - beat.phase) / beat.beats
        found: FloatArray = at[(at > 0.25 / beat.beats) & (at < 1.0 - 0.25 / beat.beats)]
        return found

    def _jump(self, at: float, beats: float, scatter: float) -> tuple[float, float] | None:
        """Return what the delay jumps by there, down counted positive, and over its deviation.

        A straight line before it and the same slope behind it; None where too little is seen.
        """
        near = np.abs(self.along - at) * beats < 0.5
        if near.sum() < _BESIDE:
            return None
        before = self.along < at
        columns = np.column_stack([before, np.ones(before.size), self.along - at])
        height, variance, left = self._fitted(columns.astype(np.float64), near)
        deviation = (max(scatter, left / (near.sum() - 3)) * variance) ** 0.5
        return height, height / max(deviation, 1e-300)
