"""The colour that a residual has as if it were noise alone: any autoregression, and jitter."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.diagnosis.colour import Colour, rms
from psa_casadi.records.noise import growth, runs_of

#: Orders of an autoregression that a residual may have, and samples that each of its terms needs.
_ORDERS, _EACH = (0, 1, 2, 4, 8, 16), 20
#: Colour and parameters follow each other so often.
_TURNS = 4
#: Poles beyond this radius whose damping ratio is below this ring.
_SHARP, _DAMPED = 0.95, 0.1
#: Nats that jitter must gain beyond its price.
_UNEVEN = 8.0


@dataclass(frozen=True)
class Entering:
    """Where noise enters a model: at an input, or in the `rate` of a state, with its rms [unit].

    `time` is that of its correlation [s], 0 where it is white; infinite for a walk, whose rms is
    that of what it moves by from the beginning to the end of a record.
    """

    place: str
    rate: bool
    unit: str
    rms: float
    time: float


@dataclass(frozen=True, eq=False)
class OwnColour:
    """The noise that a residual would be if it were nothing else: an autoregression of order p.

    Its `level` is the rms of the n innovations at the ends of all windows without gaps that are
    longer than the highest order, so that n is the same for every model of the same samples.
    Where the reading's clock jitters, the innovations have a `spread` (samples,), which costs the
    likelihood `lost` nats. `residuals` are those of all fitted samples, where the parameters have
    followed the colour; `runs` are the numbers of these between gaps. Where the parameters stay as
    they were fitted, `learnt` (n,) and `ahead` (m,) are the innovations in fitted and in held-out
    samples. Where noise that is `entering` the model is likelier, by what is `gained` [nats], they
    are those of that noise; `entered` is the residual, which the parameters have followed, and the
    colour of it.
    """

    autoregression: FloatArray
    level: float
    samples: int
    residuals: FloatArray
    runs: tuple[int, ...]
    learnt: FloatArray
    ahead: FloatArray
    spread: FloatArray | None
    lost: float
    entering: Entering | None = None
    gained: float = 0.0
    entered: tuple[FloatArray, Colour] | None = None

    def nats(self, straight: float = 0.0) -> float:
        """Ln of the likelihood, up to a constant, less p/2 ln n for p coefficients.

        What is `straight` is unknown of an output and adds to the level.
        """
        level = float(np.hypot(self.level, straight))
        return _nats(self.samples, level, self.autoregression.size) - self.lost + self.gained

    @property
    def colour(self) -> Colour:
        """It as the colour of the fitted samples, which restarts after every gap."""
        each = (self.autoregression,) * len(self.runs)
        level = max(self.level, 1e-15)
        return Colour(each, level, self.runs, known_start=False, spread=self.spread)

    @property
    def tested(self) -> tuple[FloatArray, Colour]:
        """What is tested for what is not noise, and the colour that it has."""
        return self.entered or (self.residuals, self.colour)


def own_colour(
    errors: Sequence[FloatArray],
    fitted: Sequence[BoolArray],
    judged: Sequence[BoolArray],
    jacobian: FloatArray,
    prior: FloatArray,
    rates: Sequence[FloatArray],
) -> OwnColour:
    """Return the colour that the errors (n,) of all records have by themselves.

    `fitted` and `judged` (n,) say which samples count, `rates` (n,) how fast the prediction changes
    from sample to sample: a clock that jitters makes an error in proportion to it. `jacobian`
    (fitted samples, k) is that of the prediction, `prior` (k,) the parameters' standard deviations.
    A fit by least squares is not the likeliest one under a colour: linearly, colour and parameters
    follow each other. All orders on the same windows, the order by Schwarz's criterion (Ljung,
    System Identification, 2nd ed. 1999, sections 3.2 and 16.4).
    """
    error = np.concatenate(errors)
    used, held = (np.concatenate(rows).astype(np.bool_) for rows in (fitted, judged))
    runs = tuple(stop - start for rows in fitted for start, stop in runs_of(rows))
    at, starts, most = windows(fitted)
    columns = np.zeros((len(error), jacobian.shape[1]))
    columns[used] = jacobian
    rate, first = np.concatenate(rates), used.copy()
    first[at] = False  # no innovation is known of these: they count over the noise's rms
    started = columns[first]
    fixed = np.where(used | held, error, 0.0)
    known = np.isfinite(prior)
    weight = np.where(known, 1.0 / np.where(known, prior, 1.0) ** 2, 0.0)

    def follow(start: FloatArray, uneven: bool) -> Iterator[tuple[OwnColour, FloatArray]]:
        """Yield colours and the errors that they are of, each likelier than the one before."""
        left, reached = start, -np.inf
        for _ in range(_TURNS):
            a = _autoregression(left, at, most)
            new = _innovations(left, at, a)
            spread, lost = _jitter(new, rate, at) if uneven else (np.ones_like(rate), 0.0)
            new = new / spread[at]
            learnt, ahead = (
                _innovations(fixed, k, a) / spread[k]
                for k in (at, _ends(used | held, starts, a.size, held))
            )
            result = OwnColour(
                a, rms(new), len(at), left[used], runs, learnt, ahead,
                spread[used] if lost else None, lost,
            )  # fmt: skip
            if result.nats() <= reached:
                return
            reached = result.nats()
            yield result, left
            if not a.size and not lost:
                return  # the fit is the likeliest one already
            white = _innovations(columns, at, a) / spread[at, None]
            share = (result.level / max(rms(left[used]), 1e-300)) ** 2
            normal = white.T @ white + share * started.T @ started
            normal += np.diag(result.level**2 * weight)
            along = white.T @ new + share * started.T @ left[first]
            left = left - columns @ np.linalg.lstsq(normal, along, rcond=1e-12)[0]

    *_, even = follow(fixed, uneven=False)
    *_, jittering = follow(even[1], uneven=True)
    return max(even, jittering, key=lambda result: result[0].nats())[0]


def windows(fitted: Sequence[BoolArray]) -> tuple[IndexArray, IndexArray, int]:
    """Return the ends of all windows without gaps in all records that are longer than an order.

    Also where the records start, and that order, the highest one that this many windows determine.
    """
    used = np.concatenate(fitted).astype(np.bool_)
    starts = np.cumsum([0, *(len(rows) for rows in fitted[:-1])])
    for most in _ORDERS[::-1]:
        at = _ends(used, starts, most)
        if len(at) >= _EACH * most:
            break
    return at, starts, most


def price_of(order: int, samples: int) -> float:
    """Return what `order` coefficients cost the likelihood of samples [nats] (Schwarz)."""
    return 0.5 * order * float(np.log(samples + 2.0))


def _jitter(new: FloatArray, rates: FloatArray, at: IndexArray) -> tuple[FloatArray, float]:
    """Return the spread sqrt(1 + c r^2) of noise at the rate r (n,), and what it costs [nats].

    The likeliest c for innovations `new` (n,) at some samples, 0 unless they ask for it.
    """
    power = float(np.mean(rates[at] ** 2)) if len(at) else 0.0
    squares = rates**2 / max(power, 1e-300)
    ratio, gain = growth(new**2, squares[at]) if power > 0 else (0.0, 0.0)
    price = price_of(1, len(new))
    if gain < price + _UNEVEN:
        return np.ones_like(rates), 0.0
    spread = np.sqrt(1.0 + ratio * squares)
    return spread, float(np.sum(np.log(spread[at]))) + price


def _nats(samples: int, level: float, order: int) -> float:
    return -samples * float(np.log(max(level, 1e-300))) - price_of(order, samples)


def _autoregression(left: FloatArray, at: IndexArray, most: int) -> FloatArray:
    """Return the best autoregression of windows that end at some samples."""
    rows = left[at[:, None] - np.arange(most + 1)]
    n, products = len(rows), rows.T @ rows
    result: list[tuple[float, FloatArray]] = [(-np.inf, np.zeros(0))]
    for p in (p for p in _ORDERS if p <= most and n and products[0, 0] > 0):
        past, along = products[1 : p + 1, 1 : p + 1], products[1 : p + 1, 0]
        a = np.linalg.lstsq(past, along, rcond=1e-12)[0]
        level = float(np.sqrt(max(float(products[0, 0] - along @ a), 0.0) / n))
        if not _rings(a):
            result.append((_nats(n, level, p), a))
    return max(result, key=lambda row: row[0])[1]


def _rings(a: FloatArray) -> bool:
    """Whether an autoregression rings: that is a vibration or a hum, and no noise of a sensor."""
    poles = np.roots(np.concatenate([[1.0], -a])) if a.size else np.zeros(0)
    poles = poles[(np.imag(poles) > 0.0) & (np.abs(poles) > _SHARP)]
    rates = np.log(poles)
    return bool(np.any(-np.real(rates) < _DAMPED * np.abs(rates)))


def _innovations(signal: FloatArray, at: IndexArray, a: FloatArray) -> FloatArray:
    """Return what an autoregression leaves of a signal (samples,) or columns at some samples."""
    values: FloatArray = signal[at].copy()
    for k, share in enumerate(a, 1):
        values -= share * signal[at - k]
    return values


def _ends(
    there: BoolArray, indices: IndexArray, most: int, ends: BoolArray | None = None
) -> IndexArray:
    """Return the samples, of some `ends`, with `most` before them without a gap in one record."""
    index = np.arange(len(there))
    first = there & ~np.concatenate([[False], there[:-1]])
    first[indices[indices < len(there)]] = True
    since = index - np.maximum.accumulate(np.where(first, index, 0))
    return np.flatnonzero((there if ends is None else ends) & (since >= most))
