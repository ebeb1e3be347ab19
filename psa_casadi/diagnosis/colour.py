"""The colour of noise as an autoregression: that of what nothing explains, and of any residual."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from psa_casadi.common.units import BoolArray, FloatArray, IndexArray
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.refitting import with_noise
from psa_casadi.records.noise import filtered, first_order_noise, growth, runs_of, uncertain
from psa_casadi.records.repeats import autoregression_of
from psa_casadi.records.split import Experiment, noise_share

#: Correlations below this are taken as white: estimated ones of white noise are not exactly 0.
_WHITE = 0.05
_LARGEST = 0.95
#: Correlations at which a projection is evaluated, the least share of a difference that
#: must be left, and the share of directions up to which it is evaluated at all.
_TRIED, _TOLD, _MANY = (0.15, 0.3, 0.45, 0.6, 0.7, 0.8, 0.88, _LARGEST), 0.5, 0.25


@dataclass(frozen=True, eq=False)
class Colour:
    """Noise e_k = a_1 e_(k-1) + ... + w_k, with w white of standard deviation `level` [m].

    `autoregression` holds (a_1 ... a_p) of every record, empty for white noise; `lengths` are the
    records' numbers of samples. `further` are the colours of the columns besides the displacement,
    each with a level in its unit. The first samples of a record count over the noise's rms, or
    with 0 where a record has no `known_start`; every sample over its `spread` (samples,),
    where the noise is not as large everywhere.
    """

    autoregression: tuple[FloatArray, ...]
    level: float
    lengths: tuple[int, ...]
    further: tuple["Colour", ...] = ()
    known_start: bool = True
    spread: FloatArray | None = None

    @property
    def each(self) -> tuple["Colour", ...]:
        """This colour and those of the further columns."""
        return (self, *self.further)

    @property
    def inflation(self) -> float:
        """Factor by which the colour inflates the variance of a mean, over all records.

        The noise's density at frequency 0 over its mean density: (1 + r)/(1 - r) of a first-order
        autoregression.
        """
        rest = [1.0 / max((1.0 - float(np.sum(a))) ** 2, 1e-6) for a in self.autoregression]
        each = [d / p for d, p in zip(rest, self._powers, strict=True)]
        return max(1.0, float(np.average(each, weights=self.lengths)))

    @property
    def rms(self) -> float:
        """Rms of the noise over all records [m]."""
        return self.level * float(np.sqrt(np.average(self._powers, weights=self.lengths)))

    @cached_property
    def _powers(self) -> tuple[float, ...]:
        """Variance of every record's noise over that of w: its impulse response's square sum."""
        impulse = np.eye(1, 4096)[0]
        each = (filtered([1.0], np.append(1.0, -a), impulse) for a in self.autoregression)
        return tuple(float(np.sum(e**2)) for e in each)

    def whiten(self, signal: FloatArray) -> FloatArray:
        """Filter a signal (samples,) or columns (samples, k), every record for itself."""
        if not signal.size or (self.spread is None and not any(map(len, self.autoregression))):
            return signal
        white, first = signal.copy(), 0
        records = zip(self.autoregression, self._powers, self.lengths, strict=True)
        for a, power, length in records:
            part = signal[first : first + length]
            if a.size and length > a.size:
                filtered_part = white[first : first + length]
                filtered_part[:] = filtered(np.concatenate([[1.0], -a]), [1.0], part)
                filtered_part[: a.size] = self.known_start * part[: a.size] / np.sqrt(power)
            first += length
        if self.spread is not None:
            white /= self.spread.reshape(-1, *(1,) * (signal.ndim - 1))
        return white

    def whiten_all(self, signals: Sequence[FloatArray]) -> FloatArray:
        """Filter the signals of all channels, and stack them.

        A further one counts over its noise level, in metres of that of the displacement.
        """
        pairs = zip(self.each, signals, strict=True)
        white = [self.level / c.level * c.whiten(part) for c, part in pairs]
        return np.concatenate(white) if self.further else white[0]


def colour_of(
    remainder: FloatArray,
    lengths: Sequence[int],
    known: Sequence[FloatArray | None] | None = None,
    removed: FloatArray | None = None,
) -> Colour:
    """Return colour and level of what no model and no candidate explains.

    `removed` (samples, k) is an orthonormal basis of what was projected out of it: slow directions
    for the most part, which take a colour's slow part along. The correlation is the one that leaves
    the observed one (`left_correlation`), where that can be estimated.

    `known` holds the autoregression of records whose noise is known without a model (repeats). The
    others share one of first order, estimated from the remainder: it can describe the noise of a
    sensor with a filter, but neither a tone nor a slow misfit on top of white noise, so that those
    remain visible after whitening.
    """
    regressions = list(known or [None] * len(lengths))
    top = bottom = 0.0
    ends = np.cumsum(lengths)[:-1]
    for part, regression in zip(np.split(remainder, ends), regressions, strict=True):
        if regression is None:
            top += float(part[1:] @ part[:-1])
            bottom += float(part @ part)
    correlation_left = top / bottom if bottom > 0 else 0.0
    if removed is not None and bottom > 0:
        pairs = zip(np.split(removed, ends), regressions, strict=True)
        correlation_left = _before(
            correlation_left, [q for q, regression in pairs if regression is None and len(q)]
        )
    correlation = float(np.clip(correlation_left, 0.0, _LARGEST))
    shared: FloatArray = np.array([correlation] if correlation >= _WHITE else [])
    each = tuple(shared if regression is None else regression for regression in regressions)
    return _with_level(each, remainder, lengths, 0 if removed is None else removed.shape[1])


def left_correlation(correlation: float, removed: Sequence[FloatArray]) -> float:
    """Return the correlation of neighbours that a first-order autoregression shows after all.

    `removed` are the rows, record by record, of the basis Q that was projected out of it. With the
    covariance S_ij = r^|i-j| within records and the mean D of the shifts to either side the
    expected products are tr(D P S P) of neighbours and tr(P S P) of the samples, P = I - Q Q^T.
    """
    q = np.vstack(removed)
    covered = np.vstack([_correlated(correlation, part) for part in removed])
    shifted = np.vstack([_beside(part) for part in removed])
    inner, spread = q.T @ q, q.T @ covered
    pairs = sum(len(part) - 1 for part in removed)
    top = correlation * pairs - 2.0 * np.sum(shifted * covered)
    top += np.sum((q.T @ shifted) * spread.T)
    bottom = len(q) - 2.0 * np.trace(spread) + np.sum(inner * spread.T)
    return float(top / bottom)


def _correlated(r: float, columns: FloatArray) -> FloatArray:
    """Return S q for columns q: their sum over all samples, weighted with r^|i-j|."""
    ahead = filtered([1.0], [1.0, -r], columns)
    behind = filtered([1.0], [1.0, -r], columns[::-1])[::-1]
    return ahead + behind - columns


def _beside(columns: FloatArray) -> FloatArray:
    """Return half the sum of the neighbours on either side."""
    values = np.zeros_like(columns)
    values[1:] += 0.5 * columns[:-1]
    values[:-1] += 0.5 * columns[1:]
    return values


def _before(value: float, removed: Sequence[FloatArray]) -> float:
    """Return the correlation of which `value` is left after the projection.

    Where what is left hardly grows with it any more (`_TOLD`), the correction stays as it was at
    the last place where it did; there is none where the directions are `_MANY` of the samples.
    """
    samples, directions = sum(len(part) for part in removed), removed[0].shape[1]
    if directions > _MANY * samples:
        return value
    tried, left = [0.0], [left_correlation(0.0, removed)]
    for r in _TRIED:
        if value <= left[-1]:
            break
        more = left_correlation(r, removed)
        if more - left[-1] < _TOLD * (r - tried[-1]):
            break
        tried.append(r)
        left.append(more)
    beyond = min(0.0, value - left[0]), max(0.0, value - left[-1])
    return float(np.interp(value, left, tried)) + beyond[0] + beyond[1]


def noise_rms(residual: FloatArray, colour: Colour) -> float:
    """Return the rms of the noise in a residual [m], from its fast part, at most the colour's.

    Of noise with a colour the fast part alone holds little; what no candidate explains may hold
    more than noise.
    """
    return min(first_order_noise(residual)[0], colour.rms)


def noise_left(fit: Fit, colour: Colour) -> list[float]:
    """Return the noise in every output's residual, over the shares that weighted it."""
    rows = zip(fit.channels, colour.each, strict=True)
    return [noise_rms(o.residuals, c) for o, c in rows]


def noise_told(fit: Fit, colour: Colour) -> tuple[tuple[Experiment, ...], tuple[float, ...]]:
    """Return a fit's experiments and every output's noise over them, as it leaves it.

    What a search has weighted by is from the base's residual, which holds more than noise.
    """
    weighted, levels = with_noise(fit), []
    for o, c in zip(fit.channels, colour.each, strict=True):
        j = o.number
        rows = zip(o.records, o.parts, strict=True)
        left = np.concatenate(
            [p * (fit.experiments[k].share(j) / weighted[k].share(j)) for k, p in rows]
        )
        levels.append(noise_rms(left, c) * noise_share(weighted, j))
    return weighted, tuple(levels)


def excess_power(residual: FloatArray, floor: float) -> float:
    """Return the power [m^2] of a residual above its noise, negative where that is less.

    The noise's power is `floor`^2, and what that is uncertain by.
    """
    return float(np.mean(residual**2)) - floor**2 * (1.0 + uncertain(residual))


def rms(values: FloatArray) -> float:
    """Root mean square of the values that exist; 0 without any."""
    valid = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(valid**2))) if valid.size else 0.0


def residual_colour(parts: Sequence[FloatArray]) -> Colour:
    """Return the colour of the residual itself, whatever it holds, one autoregression per record.

    A missing effect counts as colour then: a negative control, and what a tone must stand out of
    (`ringing`), but not a way to know the noise.
    """
    each = tuple(autoregression_of(part) if part.size else part for part in parts)
    return _with_level(each, np.concatenate(parts), [part.size for part in parts])


def _with_level(
    autoregression: tuple[FloatArray, ...], signal: FloatArray, lengths: Sequence[int],
    removed: int = 0,
) -> Colour:  # fmt: skip
    """Return the colour whose level is that of the whitened signal.

    So many directions were `removed` of it: the square sum has fewer degrees of freedom by them.
    """
    colour = Colour(autoregression, 1.0, tuple(lengths))
    freedom = max(len(signal) - removed, 1)
    level = float(np.sqrt(np.sum(colour.whiten(signal) ** 2) / freedom))
    return replace(colour, level=max(level, 1e-15))


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
