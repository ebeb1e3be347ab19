"""Jumps of a noise between levels: two that are left and met again, or a few steps.

Two levels are a hidden Markov chain, whose likelihood is exact; its parameters are sought by the
iteration of Baum and Welch. Steps are found by binary segmentation: a jump at sample k of n gains

    (S_k - k/n S_n)^2 n / (2 s^2 k (n - k)),   S_k the sum of the first k samples,

and costs 3/2 ln n for its place and its size. The level s of the white noise on them is that of the
differences of neighbours.

Source: Baum, Petrie, Soules and Weiss, Annals of Mathematical Statistics 41 (1970) 164; Scott and
Knott, Biometrics 30 (1974) 507.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from psa_casadi.records.noise import convolved, filtered, peaks
from psa_casadi.records.noise_spectra import Colour, colour_of, score
from psa_casadi.units import FloatArray

IntArray = npt.NDArray[np.int64]

#: Samples of a part in which the chain's products are formed step by step.
_PART = 32
#: Widths of the means from which the two levels are first read, and iterations.
_WIDTHS, _ITERATIONS = (1, 4, 16, 64), 4
#: Two levels explain 2/pi = 0.64 of a normal distribution's variance, and more than this of theirs.
_SPLIT = 0.68
#: Steps that are sought at most: more are no steps. A level lasts so many samples at least.
_MOST, _SHORTEST = 24, 5
#: Nats beyond its price that a step must gain, and its least size over the noise.
_CLEAR, _SIZE = 5.0, 1.0


@dataclass(frozen=True, eq=False)
class Jumps:
    """Levels (n,) of a signal, the places where it jumps, and what they gain over none [nats].

    `apart` is the distance of the two levels, or the median size of the steps; `noise` the standard
    deviation on them. They are `sharp` where they stand out of a noise that is coloured.
    """

    gain: float
    levels: FloatArray
    places: IntArray
    apart: float
    noise: float
    sharp: bool = False


def two_levels(signal: FloatArray) -> Jumps | None:
    """Return the two levels between which a signal (n,) jumps, None where none are seen."""
    n, variance = signal.size, float(np.var(signal))
    white = -0.5 * n * (np.log(variance) + 1.0)
    firsts = [f for width in _WIDTHS if (f := _first(signal, width)) is not None]
    split, best = max(firsts, key=lambda f: f[0], default=(0.0, _Chain((0, 0), (0, 0), 1.0)))
    if split < _SPLIT:
        return None
    for _ in range(_ITERATIONS):
        again = _improved(signal, best)
        done = again.likelihood < best.likelihood + 1.0
        best = max(best, again, key=lambda c: c.likelihood)
        if done:
            break
    upper = best.probability > 0.5
    places = np.flatnonzero(np.diff(upper.astype(np.int8))) + 1
    low, high = best.levels
    price = 0.5 * 4 * float(np.log(n))
    levels = low + (high - low) * best.probability
    return Jumps(best.likelihood - float(white) - price, levels, places, high - low, best.noise)


@dataclass(frozen=True, eq=False)
class _Chain:
    """A chain's levels, its chances to leave the lower and the upper one, and the noise on them.

    `likelihood` is that of its values, `probability` (n,) that of the upper level.
    """

    levels: tuple[float, float]
    leaves: tuple[float, float]
    noise: float
    likelihood: float = -np.inf
    probability: FloatArray = field(default_factory=lambda: np.zeros(0))


def _first(signal: FloatArray, width: int) -> tuple[float, _Chain] | None:
    """Return the share of the variance of means of a `width` that two levels explain, and a chain.

    By k-means; None where there are too few means or no jump.
    """
    count = signal.size // width
    if count < 4 * _SHORTEST:
        return None
    means = signal[: count * width].reshape(count, width).mean(axis=1)
    middle = 0.5 * float(np.quantile(means, 0.05) + np.quantile(means, 0.95))
    for _ in range(8):
        upper = means > middle
        if not 0 < np.count_nonzero(upper) < count:
            return None
        low, high = float(means[~upper].mean()), float(means[upper].mean())
        middle = 0.5 * (low + high)
    share = float(upper.mean())
    rest = float(np.var(signal)) - share * (1.0 - share) * (high - low) ** 2
    noise = float(np.sqrt(max(rest, 1e-4 * float(np.var(signal)))))
    jumps = max(1, int(np.count_nonzero(np.diff(upper)))) / (signal.size * 2.0)
    leaves = tuple(float(np.clip(jumps / s, 1e-5, 0.4)) for s in (1.0 - share, share))
    spread = float(np.var(means))
    split = share * (1.0 - share) * (high - low) ** 2 / spread if spread > 0.0 else 0.0
    return split, _Chain((low, high), (leaves[0], leaves[1]), noise)


def _improved(signal: FloatArray, chain: _Chain) -> _Chain:
    """Return the likelihood of a chain's values, and better values."""
    (low, high), (p, q) = chain.levels, chain.leaves
    exponents = np.stack([-0.5 * ((signal - level) / chain.noise) ** 2 for level in (low, high)])
    top = exponents.max(axis=0)
    chances = np.exp(exponents - top)
    told, ahead, behind = _both_ways(chances, p, q)
    told += float(np.sum(top)) - signal.size * float(np.log(chain.noise))
    stays = np.array([q, p]) / (p + q)
    both = ahead * behind / (stays[:, None] * np.maximum(chances, 1e-300))
    upper = both[1] / np.maximum(both.sum(axis=0), 1e-300)
    above = upper > 0.5
    leaps, high_ones = np.diff(above.astype(np.int8)), int(np.count_nonzero(above))
    counts = np.count_nonzero(leaps > 0), np.count_nonzero(leaps < 0)
    stay = signal.size - high_ones, high_ones
    leaves = [
        float(np.clip((c + 0.5) / (t + 1), 1e-6, 0.45)) for c, t in zip(counts, stay, strict=True)
    ]
    weights = np.stack([1.0 - upper, upper])
    total = np.maximum(weights.sum(axis=1), 1e-9)
    new = (weights @ signal) / total
    square = sum(float(w @ (signal - level) ** 2) for w, level in zip(weights, new, strict=True))
    noise = max(float(np.sqrt(square / signal.size)), 1e-3 * chain.noise)
    return _Chain((float(new[0]), float(new[1])), (leaves[0], leaves[1]), noise, told, upper)


def _both_ways(chances: FloatArray, p: float, q: float) -> tuple[float, FloatArray, FloatArray]:
    """Return the log likelihood and the normalised forward chances (2, n), of both directions.

    Products of the 2 x 2 matrices are formed within parts, side by side, and then chained.
    """
    n = chances.shape[1]
    parts = -(-n // _PART)
    padded = np.ones((2, 2, parts * _PART))  # way, level
    padded[0, :, :n], padded[1, :, :n] = chances, chances[:, ::-1]
    # (_PART, way and part) for either level: what a sample does at the same place of all parts
    low, high = (np.ascontiguousarray(padded[:, k].reshape(2 * parts, _PART).T) for k in (0, 1))
    a, b, c, d = (np.full(2 * parts, v) for v in (1.0, 0.0, 0.0, 1.0))
    products, logs = np.empty((_PART, 4, 2 * parts)), np.zeros(2 * parts)
    for k in range(_PART):
        u, v = low[k], high[k]
        a, b = (a * (1.0 - p) + b * q) * u, (a * p + b * (1.0 - q)) * v
        c, d = (c * (1.0 - p) + d * q) * u, (c * p + d * (1.0 - q)) * v
        size = 0.5 * (a + b + c + d)
        size = np.where(size > 0.0, size, 1e-300)
        a, b, c, d = a / size, b / size, c / size, d / size
        logs += np.log(size)
        products[k] = a, b, c, d
    begins, told = np.empty((2, 2 * parts)), 0.0
    last = products[-1].T.tolist()
    steady = q / (p + q), p / (p + q)
    for way in (0, 1):
        x, y = steady
        for part, (a1, b1, c1, d1) in enumerate(last[way * parts : (way + 1) * parts]):
            begins[:, way * parts + part] = x, y
            x, y = x * a1 + y * c1, x * b1 + y * d1
            size1 = x + y or 1e-300
            x, y = x / size1, y / size1
            if way == 0:
                told += float(np.log(size1))
    told += float(np.sum(logs[:parts]))
    x0, y0 = begins
    ahead = np.stack(
        [x0 * products[:, 0] + y0 * products[:, 2], x0 * products[:, 1] + y0 * products[:, 3]]
    )
    ahead /= np.maximum(ahead.sum(axis=0), 1e-300)
    ways = ahead.transpose(0, 2, 1).reshape(2, 2, parts * _PART)[:, :, :n]
    return told, ways[:, 0], ways[:, 1, ::-1]


def steps_in(signal: FloatArray) -> Jumps | None:
    """Return the steps of a signal (n,), None where there are none, or too many for steps."""
    n = signal.size
    noise = float(1.4826 * np.median(np.abs(np.diff(signal)))) / float(np.sqrt(2.0))
    if not noise > 0.0 or n < 4 * _SHORTEST:
        return None
    total = np.r_[0.0, np.cumsum(signal)]
    least = 1.5 * float(np.log(n)) + _CLEAR
    edges, open_parts = [0, n], [(0, n)]
    while open_parts:
        start, stop = open_parts.pop()
        if stop - start < 2 * _SHORTEST:
            continue
        size = stop - start
        k = np.arange(_SHORTEST, size - _SHORTEST + 1)
        away = total[start + k] - total[start] - k / size * (total[stop] - total[start])
        gain = away**2 * size / (2.0 * noise**2 * k * (size - k))
        best = int(np.argmax(gain))
        if gain[best] > least:
            place = start + int(k[best])
            edges.append(place)
            open_parts += [(start, place), (place, stop)]
            if len(edges) > _MOST + 2:
                return None
    edges.sort()
    return _kept(signal, total, edges, noise)


def _kept(signal: FloatArray, total: FloatArray, edges: list[int], noise: float) -> Jumps | None:
    """Return the steps that are clear when both neighbours are there, None without any."""
    n = signal.size
    while len(edges) > 2:
        at = np.array(edges)
        means = np.diff(total[at]) / np.diff(at)
        sizes = np.abs(np.diff(means))
        weight = np.diff(at)[:-1] * np.diff(at)[1:] / (np.diff(at)[:-1] + np.diff(at)[1:])
        gains = 0.5 * sizes**2 * weight / noise**2
        weakest = int(np.argmin(np.where(sizes > _SIZE * noise, gains, 0.0)))
        if gains[weakest] > 1.5 * np.log(n) + _CLEAR and sizes[weakest] > _SIZE * noise:
            levels = np.repeat(means, np.diff(at))
            left = float(np.var(signal - levels))
            gain = 0.5 * n * float(np.log(np.var(signal) / left))
            gain -= 1.5 * sizes.size * float(np.log(n))
            return Jumps(gain, levels, at[1:-1], float(np.median(sizes)), float(np.sqrt(left)))
        del edges[weakest + 1]
    return None


#: Whitened samples after a jump by which it is told, rounds in which colour and jumps are found,
#: standard deviations of a jump, samples between two, and jumps at most.
_TELLS, _TIMES, _STANDS_OUT, _APART, _MANY = 48, 3, 6.0, 4, 80


def jumps_on(signal: FloatArray, colour: Colour) -> Jumps | None:
    """Return the steps, or jumps between two levels, of a signal (n,) on a noise that is coloured.

    None where none are clear, or too many for steps. A matched filter finds the response of the
    whitening filter to a step; the colour is that of what the jumps leave, and the `gain` is over
    white noise, as elsewhere.
    """
    n, places, best = signal.size, np.zeros(0, np.int64), None
    least = score(signal, colour) + _CLEAR
    for _ in range(_TIMES):
        shape = np.cumsum(np.r_[colour.filter(n), np.zeros(_TELLS - colour.filter(n).size)])
        levels = np.zeros(n) if best is None else best.levels
        white = colour.whitened(signal - levels)
        kernel = np.r_[shape[::-1], np.zeros(_TELLS - 1)]
        match = convolved(white[:, None], kernel)[:, 0] / float(np.linalg.norm(shape))
        size = np.abs(match) / (1.4826 * float(np.median(np.abs(match))))
        size[: 2 * _APART] = size[-2 * _APART :] = 0.0
        more = peaks(np.where(size > _STANDS_OUT, size, 0.0), _APART, _MANY)
        places = np.unique(np.r_[places, more])
        if not more.size or places.size > _MANY:
            break
        levels, sizes = _fitted_steps(signal, places, colour)
        own = colour_of(signal - levels)
        value = score(signal - levels, own) - 1.5 * places.size * float(np.log(n))
        if value < least:
            break
        white_alone = -0.5 * n * float(np.log(max(float(np.var(signal)), 1e-300)))
        noise = float(np.std(signal - levels))
        apart = float(np.median(np.abs(sizes)))
        best = Jumps(value - white_alone, levels, places, apart, noise, sharp=True)
        least, colour = value, own
        if colour.family == "white":
            break
    few = best is None or best.places.size <= _MOST or alternates(best)
    return best if few else None


def _fitted_steps(
    signal: FloatArray, places: IntArray, colour: Colour
) -> tuple[FloatArray, FloatArray]:
    """Return steps (n,) at the places and their sizes, by least squares in a noise of the colour.

    Whitened steps are alike but for where they begin: only their beginnings are not orthogonal.
    """
    steps = (np.arange(signal.size)[:, None] >= places).astype(np.float64)
    rows = np.column_stack([np.ones(signal.size), steps])
    white = filtered(colour.filter(signal.size), [1.0], rows)
    sizes = np.linalg.lstsq(white[1:], colour.whitened(signal)[1:], rcond=1e-10)[0][1:]
    levels = steps @ sizes
    return levels - float(np.mean(levels)), np.asarray(sizes, dtype=np.float64)


def alternates(found: Jumps) -> bool:
    """Whether jumps go up and down in turn, by nearly the same: between two levels."""
    sizes = np.diff(found.levels)[found.places - 1]
    turns = np.sign(sizes[1:]) != np.sign(sizes[:-1])
    return bool(turns.mean() > 0.8 and np.std(np.abs(sizes)) < 0.4 * np.mean(np.abs(sizes)))
