"""The colour of the noise as an autoregression for each record, and tests for what it is not."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.refitting import with_noise
from psa_casadi.notes import Note, note
from psa_casadi.records.noise import filtered, first_order_noise, growth, runs_of, uncertain
from psa_casadi.records.repeats import autoregression_of
from psa_casadi.records.split import Experiment, noise_share
from psa_casadi.units import BoolArray, FloatArray, IndexArray

#: Correlations below this are taken as white: estimated ones of white noise are not exactly 0.
_WHITE = 0.05
_LARGEST = 0.95
#: Correlations at which it is asked what a projection leaves, the least share of a difference that
#: must be left, and the share of directions up to which it is asked at all.
_TRIED, _TOLD, _MANY = (0.15, 0.3, 0.45, 0.6, 0.7, 0.8, 0.88, _LARGEST), 0.5, 0.25


@dataclass(frozen=True, eq=False)
class Colour:
    """Noise e_k = a_1 e_(k-1) + ... + w_k, with w white of standard deviation `level` [m].

    `autoregression` holds (a_1 ... a_p) of every record, empty for white noise; `lengths` are the
    records' numbers of samples. `further` are the colours of the columns beside the displacement,
    each with a level in its own unit. The first samples of a record count over the noise's rms, or
    with 0 where a record does not say how it `begins`; every sample over its `spread` (samples,),
    where the noise is not as large everywhere.
    """

    autoregression: tuple[FloatArray, ...]
    level: float
    lengths: tuple[int, ...]
    further: tuple["Colour", ...] = ()
    begins: bool = True
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
        white = signal.copy()
        first = 0
        records = zip(self.autoregression, self._powers, self.lengths, strict=True)
        for a, power, length in records:
            part = signal[first : first + length]
            if a.size and length > a.size:
                own = white[first : first + length]
                own[:] = filtered(np.concatenate([[1.0], -a]), [1.0], part)
                own[: a.size] = self.begins * part[: a.size] / np.sqrt(power)
            first += length
        if self.spread is not None:
            white /= self.spread.reshape(-1, *(1,) * (signal.ndim - 1))
        return white

    def whiten_all(self, signal: FloatArray, further: Sequence[FloatArray]) -> FloatArray:
        """Filter a signal of the displacement and those of the further columns, and stack them.

        A further one counts over its noise level, in metres of that of the displacement.
        """
        if not further:
            return self.whiten(signal)
        beside = [
            self.level / own.level * own.whiten(part)
            for own, part in zip(self.further, further, strict=True)
        ]
        return np.concatenate([self.whiten(signal), *beside])


def colour_of(
    remainder: FloatArray,
    lengths: Sequence[int],
    known: Sequence[FloatArray | None] | None = None,
    removed: FloatArray | None = None,
) -> Colour:
    """Return colour and level of what no model and no candidate explains.

    `removed` (samples, k) is an orthonormal basis of what was projected out of it: slow directions
    for the most part, which take a colour's slow part along. The correlation is the one that leaves
    what is seen (`left_correlation`), where that can be told.

    `known` holds the autoregression of records whose noise is known without a model (repeats). The
    others share one of first order, estimated from the remainder: it can describe the noise of a
    sensor with a filter, but neither a tone nor a slow misfit on top of white noise, so that those
    remain visible after whitening.
    """
    given = list(known or [None] * len(lengths))
    top = bottom = 0.0
    ends = np.cumsum(lengths)[:-1]
    for part, own in zip(np.split(remainder, ends), given, strict=True):
        if own is None:
            top += float(part[1:] @ part[:-1])
            bottom += float(part @ part)
    seen = top / bottom if bottom > 0 else 0.0
    if removed is not None and bottom > 0:
        pairs = zip(np.split(removed, ends), given, strict=True)
        seen = _before(seen, [q for q, own in pairs if own is None and len(q)])
    correlation = float(np.clip(seen, 0.0, _LARGEST))
    shared: FloatArray = np.array([correlation] if correlation >= _WHITE else [])
    each = tuple(shared if own is None else own for own in given)
    return _with_level(each, remainder, lengths)


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
    both: FloatArray = ahead + behind - columns
    return both


def _beside(columns: FloatArray) -> FloatArray:
    """Return half the sum of the neighbours on either side."""
    found = np.zeros_like(columns)
    found[1:] += 0.5 * columns[:-1]
    found[:-1] += 0.5 * columns[1:]
    return found


def _before(seen: float, removed: Sequence[FloatArray]) -> float:
    """Return the correlation of which `seen` is left after the projection.

    Where what is left hardly grows with it any more (`_TOLD`), the correction stays as it was at
    the last place where it did; there is none where the directions are `_MANY` of the samples.
    """
    samples, directions = sum(len(part) for part in removed), removed[0].shape[1]
    if directions > _MANY * samples:
        return seen
    own, left = [0.0], [left_correlation(0.0, removed)]
    for r in _TRIED:
        if seen <= left[-1]:
            break
        more = left_correlation(r, removed)
        if more - left[-1] < _TOLD * (r - own[-1]):
            break
        own.append(r)
        left.append(more)
    return float(np.interp(seen, left, own)) + min(0.0, seen - left[0]) + max(0.0, seen - left[-1])


def noise_rms(residual: FloatArray, colour: Colour) -> float:
    """Return the rms of the noise in a residual [m], from its fast part, at most the colour's.

    Of noise with a colour the fast part alone holds little; what no candidate explains may hold
    more than noise.
    """
    return min(first_order_noise(residual)[0], colour.rms)


def noise_left(fit: Fit, colour: Colour) -> list[float]:
    """Return the noise in every output's residual, over the shares that weighted it."""
    rows = zip(fit.channels, colour.each, strict=True)
    return [noise_rms(o.residuals, own) for o, own in rows]


def noise_told(
    fit: Fit, colour: Colour, experiments: Sequence[Experiment]
) -> tuple[tuple[Experiment, ...], tuple[float, ...]]:
    """Return the experiments and every output's noise over them, in its unit, as a fit leaves it.

    What a search has weighted by is from the base's residual, which holds more than noise.
    """
    told, levels = with_noise(fit, experiments), []
    for o, own in zip(fit.channels, colour.each, strict=True):
        j = o.number
        rows = zip(o.records, o.parts, strict=True)
        left = np.concatenate([p * (experiments[k].share(j) / told[k].share(j)) for k, p in rows])
        levels.append(noise_rms(left, own) * noise_share(told, j))
    return told, tuple(levels)


def excess_power(residual: FloatArray, colour: Colour, floor: float | None = None) -> float:
    """Return the power [m^2] of a residual above its noise, negative where that is less.

    The noise's power is `floor`^2, or what `noise_rms` finds, and what that is uncertain by.
    """
    level = noise_rms(residual, colour) if floor is None else floor
    return float(np.mean(residual**2)) - level**2 * (1.0 + uncertain(residual))


def rms(values: FloatArray) -> float:
    """Root mean square of the values that exist; 0 without any."""
    valid = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(valid**2))) if valid.size else 0.0


def residual_colour(residual: FloatArray, lengths: Sequence[int]) -> Colour:
    """Return the colour of the residual itself, whatever it holds, one autoregression per record.

    A missing effect counts as colour then: a negative control, and what a tone must stand out of
    (`ringing`), but not a way to know the noise.
    """
    ends = np.cumsum(lengths)
    parts = np.split(residual, ends[:-1])
    each = (autoregression_of(part) if part.size else part for part in parts)
    return _with_level(tuple(each), residual, lengths)


#: Orders of an autoregression that a residual may have, and samples that each of its terms needs.
_ORDERS, _EACH = (0, 1, 2, 4, 8, 16), 20
#: Colour and parameters follow each other so often.
_TURNS = 4
#: Poles beyond this radius whose damping ratio is below this ring.
_SHARP, _DAMPED = 0.95, 0.1
#: Nats that jitter must gain beyond its price.
_UNEVEN = 8.0


@dataclass(frozen=True, eq=False)
class OwnColour:
    """The noise that a residual would be if it were nothing else: an autoregression of order p.

    Its `level` is the rms of the n innovations at the ends of all windows without gaps that are
    longer than the highest order, so that n is the same for every model of the same samples.
    Where the reading's clock jitters, the innovations have a `spread` (samples,), which costs the
    likelihood `lost` nats. `residuals` are those of all fitted samples, where the parameters have
    followed the colour; `runs` are the numbers of these between gaps. Where the parameters stay as
    they were fitted, `learnt` (n,) and `ahead` (m,) are the innovations in fitted and in held-out
    samples.
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

    def nats(self, straight: float = 0.0) -> float:
        """Ln of the likelihood, up to a constant, less p/2 ln n for p coefficients.

        What is `straight` is not told of an output and adds to the level.
        """
        level = float(np.hypot(self.level, straight))
        return _nats(self.samples, level, self.autoregression.size) - self.lost

    @property
    def colour(self) -> Colour:
        """It as the colour of the fitted samples, which begins anew after every gap."""
        each = (self.autoregression,) * len(self.runs)
        level = max(self.level, 1e-15)
        return Colour(each, level, self.runs, begins=False, spread=self.spread)


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
    begins = np.cumsum([0, *(len(e) for e in errors[:-1])])
    runs = tuple(stop - start for rows in fitted for start, stop in runs_of(rows))
    for most in _ORDERS[::-1]:
        at = _ends(used, begins, most)
        if len(at) >= _EACH * most:
            break
    columns = np.zeros((len(error), jacobian.shape[1]))
    columns[used] = jacobian
    rate, first = np.concatenate(rates), used.copy()
    first[at] = False  # no innovation is known of these: they count over the noise's rms
    begun = columns[first]
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
                for k in (at, _ends(used | held, begins, a.size, held))
            )
            found = OwnColour(
                a, rms(new), len(at), left[used], runs, learnt, ahead,
                spread[used] if lost else None, lost,
            )  # fmt: skip
            if found.nats() <= reached:
                return
            reached = found.nats()
            yield found, left
            if not a.size and not lost:
                return  # the fit is the likeliest one already
            white = _innovations(columns, at, a) / spread[at, None]
            share = (found.level / max(rms(left[used]), 1e-300)) ** 2
            normal = white.T @ white + share * begun.T @ begun + np.diag(found.level**2 * weight)
            along = white.T @ new + share * begun.T @ left[first]
            left = left - columns @ np.linalg.lstsq(normal, along, rcond=1e-12)[0]

    *_, even = follow(fixed, uneven=False)
    *_, jittering = follow(even[1], uneven=True)
    return max(even, jittering, key=lambda found: found[0].nats())[0]


def _jitter(new: FloatArray, rates: FloatArray, at: IndexArray) -> tuple[FloatArray, float]:
    """Return the spread sqrt(1 + c r^2) of noise at the rate r (n,), and what it costs [nats].

    The likeliest c for innovations `new` (n,) at some samples, 0 unless they ask for it.
    """
    power = float(np.mean(rates[at] ** 2)) if len(at) else 0.0
    squares = rates**2 / max(power, 1e-300)
    ratio, gain = growth(new**2, squares[at]) if power > 0 else (0.0, 0.0)
    price = 0.5 * float(np.log(len(new) + 2.0))
    if gain < price + _UNEVEN:
        return np.ones_like(rates), 0.0
    spread = np.sqrt(1.0 + ratio * squares)
    return spread, float(np.sum(np.log(spread[at]))) + price


def _nats(samples: int, level: float, order: int) -> float:
    return -samples * float(np.log(max(level, 1e-300))) - 0.5 * order * float(np.log(samples + 2.0))


def _autoregression(left: FloatArray, at: IndexArray, most: int) -> FloatArray:
    """Return the best autoregression of windows that end at some samples."""
    rows = left[at[:, None] - np.arange(most + 1)]
    n, products = len(rows), rows.T @ rows
    found: list[tuple[float, FloatArray]] = [(-np.inf, np.zeros(0))]
    for p in (p for p in _ORDERS if p <= most and n and products[0, 0] > 0):
        past, along = products[1 : p + 1, 1 : p + 1], products[1 : p + 1, 0]
        a = np.linalg.lstsq(past, along, rcond=1e-12)[0]
        level = float(np.sqrt(max(float(products[0, 0] - along @ a), 0.0) / n))
        if not _rings(a):
            found.append((_nats(n, level, p), a))
    return max(found, key=lambda row: row[0])[1]


def _rings(a: FloatArray) -> bool:
    """Whether an autoregression rings: that is a vibration or a hum, and no noise of a sensor."""
    poles = np.roots(np.concatenate([[1.0], -a])) if a.size else np.zeros(0)
    poles = poles[(np.imag(poles) > 0.0) & (np.abs(poles) > _SHARP)]
    rates = np.log(poles)
    return bool(np.any(-np.real(rates) < _DAMPED * np.abs(rates)))


def _innovations(signal: FloatArray, at: IndexArray, a: FloatArray) -> FloatArray:
    """Return what an autoregression leaves of a signal (samples,) or columns at some samples."""
    found: FloatArray = signal[at].copy()
    for k, share in enumerate(a, 1):
        found -= share * signal[at - k]
    return found


def _ends(
    there: BoolArray, begins: IndexArray, most: int, ends: BoolArray | None = None
) -> IndexArray:
    """Return the samples, of some `ends`, with so many before them without a gap in one record."""
    index = np.arange(len(there))
    first = there & ~np.concatenate([[False], there[:-1]])
    first[begins[begins < len(there)]] = True
    since = index - np.maximum.accumulate(np.where(first, index, 0))
    return np.flatnonzero((there if ends is None else ends) & (since >= most))


def _with_level(
    autoregression: tuple[FloatArray, ...], signal: FloatArray, lengths: Sequence[int]
) -> Colour:
    """Return the colour whose level is that of the whitened signal."""
    colour = Colour(autoregression, 1.0, tuple(lengths))
    level = float(np.sqrt(np.mean(colour.whiten(signal) ** 2)))
    return replace(colour, level=max(level, 1e-15))


#: Neighbours correlate, the spectrum has a line, the residual or its size follows the drive.
Seen = Literal["correlation", "line", "drive", "size"]

_LAGS = 25
#: So many times more rarely a correlation counts beside a residual's own colour.
_LEFT = 100.0
#: Squares of the residual over their mean that count at most.
_MOST = 9.0


@dataclass(frozen=True)
class Omnibus:
    """Probability of the residual under noise alone, and the test that says so.

    `seen` is what that test sees, `output` the one of several whose residual it is. `excess` is the
    share of the residual's power above the noise; `size` [m] the rms of what the test sees,
    `knowable` [m] that below which nothing can be told of a stack, `alarms_below` the probability
    from which on it does not alarm.
    """

    p_value: float
    excess: float
    seen: Seen
    size: float
    knowable: float
    alarms_below: float
    output: str = ""

    @property
    def alarm(self) -> bool:
        """Whether something besides noise is in the residual, large enough to be told."""
        return self.p_value < self.alarms_below and self.size > self.knowable

    @property
    def finding(self) -> Note:
        """What is in the residual besides noise, where the test alarms."""
        return note("structure", seen=self.seen, output=self.output, excess=self.excess)


def omnibus(
    residual: FloatArray,
    voltage: FloatArray,
    time: FloatArray,
    colour: Colour,
    floor: float,
    *,
    lengths: Sequence[int],
    knowable: float,
    own: bool,
    alarms_below: float,
) -> Omnibus:
    """Test a residual (samples,) [m] for structure that noise of the given colour does not have.

    Four tests with Bonferroni's correction: are neighbours of the whitened residual correlated;
    Fisher's g for a line in its spectrum; an F test on general features of the voltage and time;
    and is its size the same everywhere? A sensor's noise is, what a colour may have swallowed of a
    misfit is not. Where the colour is the residual's `own`, its jitter is for the size, and its
    order leaves some correlation that Schwarz's criterion does not pay for. `excess` is the share
    of the residual's power above the noise `floor` [m]; what is seen must be larger than what is
    `knowable` [m]; `lengths` are the records' numbers of samples.
    """
    white = colour.whiten(residual)
    p, share = whiteness(white)
    tests: dict[Seen, tuple[float, float]] = {
        "correlation": (min(1.0, _LEFT * p) if own else p, share),
        "line": _fisher_line(white),
        "drive": _features(white, voltage, time, colour),
    }
    if not own:
        tests["size"] = _sizes(white, voltage, time, lengths)
    seen, (p, share) = min(tests.items(), key=lambda item: item[1][0])
    power = float(np.mean(residual**2))
    size = float(np.sqrt(share * power))
    excess = max(0.0, 1.0 - floor**2 / power) if power > 0 else 0.0
    p = min(1.0, len(tests) * p)
    return Omnibus(p, excess, seen, size, knowable, alarms_below)


def whiteness(white: FloatArray) -> tuple[float, float]:
    """Return the p-value that neighbours are not correlated, and the largest correlation.

    What is correlated has that share. Box and Pierce's test with the variance that each product
    has by itself: noise whose size changes is not correlated (Lobato, Nankervis and Savin,
    International Economic Review 42 (2001) 187).
    """
    n = len(white)
    centred = white - np.mean(white)
    power = float(centred @ centred)
    if power <= 0 or n <= 2 * _LAGS:
        return 1.0, 0.0
    pairs = [(centred[k:], centred[:-k]) for k in range(1, _LAGS + 1)]
    sums = np.array([a @ b for a, b in pairs])
    spread = np.array([a**2 @ b**2 for a, b in pairs])
    statistic = float(np.sum(sums**2 / np.maximum(spread, 1e-300)))
    share = float(np.max(np.abs(sums))) / power
    return float(scipy.special.chdtrc(_LAGS, statistic)), share


def _fisher_line(white: FloatArray) -> tuple[float, float]:
    """Return the p-value of the strongest line, and its share of the power."""
    power = np.abs(np.fft.rfft(white - np.mean(white))[1:-1]) ** 2
    count = len(power)
    if count < 8 or not np.sum(power) > 0:
        return 1.0, 0.0
    share = float(np.max(power) / np.sum(power))
    return float(min(1.0, count * (1.0 - share) ** (count - 1))), share


def _features(
    white: FloatArray, voltage: FloatArray, time: FloatArray, colour: Colour
) -> tuple[float, float]:
    """F test of the residual on u, u^2, u^3, sgn(u'), |u'|, u sgn(u'), a trend and slow waves."""
    u, rate, turn, t = _drive(voltage, time)
    columns = [np.ones_like(u), u, u**2, u**3, turn, np.abs(rate), u * turn, u**2 * turn, t, t**2]
    columns += [f(np.pi * k * t) for k in (1, 2, 3) for f in (np.sin, np.cos)]
    x = colour.whiten(np.column_stack(columns))
    return _f_test(x, white)


def _sizes(
    white: FloatArray, voltage: FloatArray, time: FloatArray, records: Sequence[int]
) -> tuple[float, float]:
    """F test of the squares on voltage, rate, time and way since the last reversal.

    Breusch and Pagan, Econometrica 47 (1979) 1287, with Koenker's correction; squares are over
    their mean in each record, and those above `_MOST` count as that.
    """
    lengths = [n for n in records if n]
    parts = np.split(white, np.cumsum(lengths)[:-1])
    powers = np.array([np.mean(part**2) for part in parts])
    if not np.all(powers > 0):
        return 1.0, 0.0
    u, rate, turn, t = _drive(voltage, time)
    speed = np.abs(rate) / (float(np.max(np.abs(rate))) or 1.0)
    way, age = _since_reversal(u, turn)
    columns = [u, u**2, speed, np.sqrt(speed), way, np.exp(-20.0 * way), np.exp(-0.1 * age), t]
    x = np.column_stack([*columns, t**2])
    squares = np.minimum(white**2 / np.repeat(powers, lengths), _MOST)
    return _f_test(x - np.mean(x, axis=0), squares - np.mean(squares))


def _drive(
    voltage: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return voltage about its mean over its range, its rate, direction, and the time in 0 to 1."""
    u = (voltage - np.mean(voltage)) / (np.ptp(voltage) or 1.0)
    rate = np.gradient(u)
    turn = np.sign(rate) * (np.abs(rate) > 1e-3 * np.max(np.abs(rate)))
    return u, rate, turn, (time - time[0]) / ((time[-1] - time[0]) or 1.0)


def _since_reversal(u: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance |u - u_r| from the last reversal and the samples since it."""
    index = np.arange(len(u))
    moving = np.flatnonzero(turn)
    reversed_at = moving[1:][turn[moving[1:]] != turn[moving[:-1]]]
    last = np.zeros(len(u), dtype=np.int64)
    last[reversed_at] = reversed_at
    last = np.maximum.accumulate(last)
    return np.abs(u - u[last]), (index - last).astype(np.float64)


def _f_test(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return the p-value that columns x (n, k) tell nothing of y (n,), and their share of it."""
    coefficients, _, rank, _ = np.linalg.lstsq(x, y, rcond=None)
    explained = float(np.sum((x @ coefficients) ** 2))
    rest = float(y @ y) - explained
    freedom = len(y) - rank
    if rest <= 0 or freedom <= 0:
        return 1.0, 0.0
    p = float(scipy.special.fdtrc(rank, freedom, explained / rank / (rest / freedom)))
    return p, explained / (explained + rest)
