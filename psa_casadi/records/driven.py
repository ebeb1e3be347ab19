"""What of a residual follows its drive: functions of the input and of its history, by regression.

The columns are those of an input u and of the prediction y: powers, direction and rate, what first-
order lags of u leave behind, play operators (Krasnosel'skii and Pokrovskii 1989), and the distance
from the last reversal. They are weighted by the noise's spectrum, so that noise of any colour
follows them by chance only.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy

from psa_casadi.records.drive import reversals
from psa_casadi.records.noise import filtered, lag_products
from psa_casadi.records.noise_spectra import Colour, straightened
from psa_casadi.units import FloatArray, IndexArray

#: Widths of play operators and of the way after a reversal, over the input's range.
_PLAYS, _WAYS = (0.05, 0.1, 0.2, 0.4), (0.05, 0.25)
#: Lags of first order: so many, from this many samples to this part of the record.
_LAGS, _FASTEST, _SLOWEST = 4, 5.0, 4.0
#: A turn comes back by this share of the range; with more turns than this no history is formed.
_TURN, _TURNS = 0.01, 1000
#: Nats beyond its price that a column must gain, and columns at most.
_CLEAR, _MOST = 5.0, 16


def columns_of(inputs: Sequence[FloatArray], predicted: FloatArray) -> FloatArray:
    """Return functions (k, n), of equal size, of inputs (n,), and of a prediction (n,).

    The foremost input comes first.
    """
    y = _scaled(predicted)
    rate = np.gradient(y)
    items = [y, y**2, y**3, rate, np.abs(rate), np.gradient(rate)]
    for k, u in enumerate(inputs):
        v = _scaled(u)
        items += [v, v**2, v**3]
        if k == 0 and np.ptp(u) > 0.0:
            items += _history(v)
    table = np.array([straightened(c) for c in items])
    size = np.linalg.norm(table, axis=1)
    kept = size > 1e-9 * float(size.max(initial=0.0))
    rows: FloatArray = table[kept] / size[kept, None]
    return rows


def _spectra(rows: FloatArray) -> FloatArray:
    values: FloatArray = scipy.fft.rfft(rows, axis=-1)[..., 1:].view(np.float64)
    return values


def _scaled(signal: FloatArray) -> FloatArray:
    """Return a signal within -1 and 1; 0 where it stands still."""
    low, high = float(np.min(signal)), float(np.max(signal))
    return (2.0 * signal - low - high) / (high - low) if high > low else np.zeros_like(signal)


def _history(v: FloatArray) -> list[FloatArray]:
    """Return what the input's history shows, of an input within -1 and 1."""
    rate = np.gradient(v)
    way = rate / (np.abs(rate) + 0.1 * float(np.sqrt(np.mean(rate**2))) + 1e-300)
    items = [way, v * way, v**2 * way]
    times = np.geomspace(_FASTEST, max(v.size / _SLOWEST, 2.0 * _FASTEST), _LAGS)
    decays = np.exp(-1.0 / times)
    items += [filtered([1.0 - r], [1.0, -r], v - v[0]) for r in decays]
    turns = reversals(v, _TURN * 2.0)
    if not 0 < turns.size <= _TURNS:
        return items
    edges = [0, *turns.tolist(), v.size - 1]
    widths = 2.0 * np.array(_PLAYS)
    play, at = np.empty((v.size, widths.size)), np.full(widths.size, v[0])
    for a, b in pairwise(edges):
        part = v[a : b + 1, None]
        bound = np.maximum if part[-1, 0] > part[0, 0] else np.minimum
        play[a : b + 1] = bound(at, part - 0.5 * widths * np.sign(part[-1] - part[0]))
        at = play[b]
    last = np.repeat(edges[:-1], np.diff(edges) + np.r_[np.zeros(len(edges) - 2, int), 1])
    since = np.abs(v - v[last])
    side = np.sign(v[np.repeat(edges[1:], np.diff([*edges[:-1], v.size]))] - v[last])
    items += [np.exp(-since / (2.0 * w)) * side for w in _WAYS]
    return [*items, *play.T]


def followed(signal: FloatArray, columns: FloatArray, colour: Colour) -> tuple[FloatArray, float]:
    """Return what of a signal (n,) follows the columns, 0 where it does none, and its price.

    Column by column the one that explains most is added, as long as it gains more nats than
    ln k + ln(n)/2 and `_CLEAR`; weighted by the noise's spectrum at the level of what is left.
    """
    k, n = columns.shape
    none = np.zeros(n), 0.0
    if not k or n < 4 * k:
        return none
    weight = np.repeat(1.0 / np.sqrt(colour.density(np.arange(1, n // 2 + 1) / n)), 2)
    x, e = _spectra(columns) * weight, _spectra(straightened(signal)) * weight
    normal, cross, power = x @ x.T, x @ e, float(e @ e)
    least = float(np.log(k)) + 0.5 * float(np.log(n))
    chosen, left, weights = list[int](), power, np.zeros(0)
    while len(chosen) < _MOST:
        rest = normal - normal[:, chosen] @ _solved(normal, chosen, normal[chosen])
        free = np.diag(rest) > 1e-8 * np.diag(normal)
        gone = cross - normal[:, chosen] @ weights
        explains = np.where(free, gone**2, 0.0) / np.where(free, np.diag(rest), 1.0)
        best = int(np.argmax(explains))
        if 0.5 * n * np.log(left / max(left - explains[best], 1e-12 * power)) < least + _CLEAR:
            break
        chosen.append(best)
        weights = _solved(normal, chosen, cross[chosen])
        left = max(power - float(cross[chosen] @ weights), 1e-12 * power)
    if not chosen:
        return none
    values: FloatArray = weights @ columns[chosen]
    return values, least * len(chosen)


def _solved(normal: FloatArray, chosen: list[int], right: FloatArray) -> FloatArray:
    """Return the solution of the chosen normal equations; an empty one of none."""
    return np.asarray(np.linalg.lstsq(normal[np.ix_(chosen, chosen)], right, rcond=1e-12)[0])


#: A period returns the input to this share of the variance of its changes, after it has moved by
#: half of it; it is no shorter, and is passed so many times at least.
_SAME, _MOVED, _SHORTEST, _PASSES = 0.02, 0.5, 8, 3
#: Phases of a period between which what returns is a straight line.
_PHASES = 64


def period_of(drive: FloatArray) -> float | None:
    """Return after how many samples a drive (n,) returns, None where it does not do so thrice."""
    n = drive.size
    v = drive - np.mean(drive)
    products = lag_products(v, n // _PASSES)
    square = np.r_[0.0, np.cumsum(v**2)]
    lags = np.arange(products.size)
    both = square[n - lags] + (square[n] - square[lags])
    away = (both - 2.0 * products) / np.maximum(both, 1e-300)
    moved = np.flatnonzero(away > _MOVED)
    back = np.flatnonzero(away[moved[0] :] < _SAME) if moved.size else moved
    if not back.size:
        return None
    first = int(moved[0] + back[0])
    lag = first + int(np.argmin(away[first : first + max(first // 4, 2)]))
    if not _SHORTEST <= lag < away.size - 1:
        return None
    low, middle, high = away[lag - 1 : lag + 2]
    bend = float(low - 2.0 * middle + high)
    return lag + (0.5 * float(low - high) / bend if bend > 0.0 else 0.0)


def returning(signal: FloatArray, index: IndexArray, period: float) -> tuple[FloatArray, float]:
    """Return what of a signal (m,) at samples `index` returns with a period, and its price."""
    phase = (index / period % 1.0) * _PHASES
    cell = phase.astype(np.int64) % _PHASES
    count = np.bincount(cell, minlength=_PHASES)
    mean = np.bincount(cell, weights=signal, minlength=_PHASES) / np.maximum(count, 1)
    result = np.asarray(np.interp(phase, np.arange(_PHASES) + 0.5, mean, period=_PHASES))
    return result, 0.5 * _PHASES * float(np.log(signal.size))
