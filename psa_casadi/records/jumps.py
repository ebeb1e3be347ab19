"""Jumps of a noise between levels: two that are left and met again, or a few steps.

Two levels are a Markov chain in white noise, whose likeliest path is Viterbi's: with the chance p
of a jump and c = ln(1/p - 1), the log odds of the upper level are d_k = e_k + min(max(d_(k-1), -c),
c), e_k the evidence of sample k. Steps are found by a matched filter: the noise's whitening filter
makes of each the same response. A step costs 3/2 ln n for its place and its size.

Source: Viterbi, IEEE Transactions on Information Theory 13 (1967) 260; Turin, IRE Transactions on
Information Theory 6 (1960) 311.
"""

from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from psa_casadi.records.noise import convolved, filtered, peaks
from psa_casadi.records.noise_spectra import FILTER, WHITE, Colour, colour_of, score, straightened
from psa_casadi.units import BoolArray, FloatArray, IndexArray

#: Widths of the means from which the two levels are first read, and iterations.
_WIDTHS, _ITERATIONS = (1, 4, 16, 64), 6
#: Two levels explain 2/pi = 0.64 of a normal distribution's variance, and more than this of theirs.
_SPLIT = 0.68
#: Two levels with fewer jumps are steps; steps at most: more are none.
_FEW, _MOST = 3, 24
#: Whitened samples to either side of a step by which it is found, rounds in which colour and steps
#: are, standard deviations of a step, samples between two, and steps at most.
_REACH, _ROUNDS, _STANDS_OUT, _APART, _MANY = 64, 6, 6.0, 4, 80
#: Nats beyond its price that a round of steps must gain.
_CLEAR = 5.0


@dataclass(frozen=True, eq=False)
class Jumps:
    """Levels (n,) of a signal without mean, the places where it jumps, and the score with them."""

    levels: FloatArray
    places: IndexArray
    score: float

    @property
    def sizes(self) -> FloatArray:
        """How far it jumps at each place."""
        return np.diff(self.levels)[self.places - 1]

    @property
    def alternate(self) -> bool:
        """Whether jumps go up and down in turn, by nearly the same: between two levels."""
        up, size = self.sizes > 0.0, np.abs(self.sizes)
        turns = up[1:] != up[:-1]
        return bool(up.size > _FEW and turns.mean() > 0.8 and np.std(size) < 0.4 * np.mean(size))


def two_levels(signal: FloatArray) -> Jumps | None:
    """Return the two levels between which a signal (n,) jumps, None where none are seen."""
    n = signal.size
    split, low, high, count = max(_split(signal, width) for width in _WIDTHS)
    if split < _SPLIT:
        return None
    noise = float(np.sqrt(max(float(np.var(signal)) * (1.0 - split), 1e-300)))
    for _ in range(_ITERATIONS):
        clear = float(np.log(max(n / max(count, 1.0) - 1.0, 1.5)))
        upper = _path((high - low) * (signal - 0.5 * (high + low)) / noise**2, clear)
        if upper.all() or not upper.any():
            return None
        low, high = float(signal[~upper].mean()), float(signal[upper].mean())
        levels = np.where(upper, high, low)
        noise = max(float(np.std(signal - levels)), 1e-3 * noise)
        places = np.flatnonzero(np.diff(levels)) + 1
        count = float(places.size)
    if count <= _FEW:
        return None
    price = count * clear + n * float(np.log1p(np.exp(-clear))) + 2.0 * float(np.log(n))
    rest = signal - levels
    return Jumps(levels - levels.mean(), places, score(rest, colour_of(rest)) - price)


def _split(signal: FloatArray, width: int) -> tuple[float, float, float, float]:
    """Return the share of the variance of means that two levels explain, these, and the jumps."""
    means = signal[: signal.size // width * width].reshape(-1, width).mean(axis=1)
    low, high = np.quantile(means, [0.05, 0.95]).tolist()
    for _ in range(8):  # k-means
        upper = means > 0.5 * (low + high)
        if upper.all() or not upper.any():
            return 0.0, low, high, 0.0
        low, high = float(means[~upper].mean()), float(means[upper].mean())
    share = float(upper.mean())
    split = share * (1.0 - share) * (high - low) ** 2 / float(np.var(means))
    return split, low, high, 0.5 * float(np.count_nonzero(np.diff(upper)))


def _path(evidence: FloatArray, clear: float) -> BoolArray:
    """Return where the likeliest path is on the upper level, (n,)."""
    odds = np.array(
        list(accumulate(evidence.tolist(), lambda d, e: e + min(max(d, -clear), clear)))
    )
    sure = np.where(np.abs(odds) > clear, np.arange(odds.size), odds.size - 1)
    upper: BoolArray = odds[np.minimum.accumulate(sure[::-1])[::-1]] > 0.0
    return upper


def steps_in(signal: FloatArray, colour: Colour) -> Jumps | None:
    """Return the steps, or jumps between two levels, of a signal (n,) on a noise of a colour.

    None where none are clear, or too many for steps. The colour becomes that of what they leave.
    """
    n, best, places = signal.size, None, np.zeros(0, np.int64)
    least, levels = score(signal, colour) + _CLEAR, np.zeros(n)
    for _ in range(_ROUNDS):
        a = colour.filter(n)
        shape = np.cumsum(np.r_[np.zeros(_REACH), a, np.zeros(_REACH + 1 - a.size)])
        kernel = (shape - shape.mean())[::-1]
        match = np.abs(convolved(colour.whitened(signal - levels)[:, None], kernel)[:, 0])
        match /= 1.4826 * float(np.median(match))
        apart = _REACH if colour is WHITE else _APART
        match[: 2 * apart] = match[-2 * apart :] = 0.0
        more = peaks(np.where(match > _STANDS_OUT, match, 0.0), apart, _MANY)
        places = np.unique(np.r_[places, more])
        if not more.size or places.size > _MANY:
            break
        places, levels = _fitted(signal, places, colour)
        item = colour_of(signal - levels)
        value = score(signal - levels, item) - 1.5 * places.size * float(np.log(n))
        if value < least:
            break
        best, least = Jumps(levels, places, value), value
        colour = colour if colour is WHITE else item
    few = best is None or best.places.size <= _MOST or best.alternate
    return best if few else None


def _fitted(
    signal: FloatArray, places: IndexArray, colour: Colour
) -> tuple[IndexArray, FloatArray]:
    """Return the places of steps that are clear, and these (n,), by generalised least squares."""
    least = 3.0 * float(np.log(signal.size)) + 2.0 * _CLEAR
    steps = (np.arange(signal.size)[:, None] >= np.r_[0, places]).astype(np.float64)
    white = filtered(colour.filter(signal.size), [1.0], steps)[FILTER:]
    y = colour.whitened(signal)[FILTER:]
    normal, along, power = white.T @ white, white.T @ y, float(y @ y)
    kept = np.arange(places.size + 1)
    while True:
        inverse = np.linalg.pinv(normal[np.ix_(kept, kept)], hermitian=True)
        sizes = inverse @ along[kept]
        noise = (power - float(along[kept] @ sizes)) / y.size
        gains = sizes[1:] ** 2 / (np.diag(inverse)[1:] * noise)
        if not gains.size or gains.min() > least:
            break
        kept = np.delete(kept, 1 + int(np.argmin(gains)))
    levels = steps[:, kept] @ sizes
    return places[kept[1:] - 1], levels - levels.mean()


def jumps_in(signal: FloatArray) -> Jumps | None:
    """Return the likeliest jumps of a signal (n,), None without any."""
    colour = colour_of(signal)
    starts = [colour] if colour is WHITE else [colour, WHITE]
    tried = [two_levels(straightened(signal)), *(steps_in(signal, c) for c in starts)]
    return max((t for t in tried if t is not None), key=lambda t: t.score, default=None)
