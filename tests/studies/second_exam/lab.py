"""What is played, how it is recorded, and disturbances that are no effect of the table."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy import interpolate, signal

from tests.studies.exam.record import Floats
from tests.studies.second_exam.plants import SUB, Extra

Random = np.random.Generator

# --- voltages, in half ranges, -1 to 1 -----------------------------------------------------------


def fading(t: Floats, f: float, floor: float = 0.2, low: bool = True) -> Floats:
    """Sines of f Hz that fall cycle by cycle, from the foot of the range or about its middle."""
    a = np.maximum(floor, 1 - np.floor(t * f) / np.ceil(t[-1] * f))
    wave = -1 + a * (1 - np.cos(2 * np.pi * f * t)) if low else a * np.sin(2 * np.pi * f * t)
    return np.asarray(wave)


def triangles(t: Floats, *tops: float) -> Floats:
    """Equally steep ways from the foot of the range to each of `tops` (0 to 1) in turn."""
    path = np.array([0, *tops])
    s = np.concatenate([[0], np.cumsum(np.abs(np.diff(path)))])
    return np.asarray(-1 + 2 * np.interp(t / t[-1] * s[-1], s, path))


def staircase(t: Floats, levels: Sequence[float]) -> Floats:
    """Levels held equally long, reached within four samples."""
    at = np.arange(len(levels)) * len(t) // len(levels)
    k = np.ravel([[a, a + 4] for a in at[1:]])
    places = np.interp(np.arange(len(t)), np.concatenate([[0], k]), np.repeat(levels, 2)[:-1])
    return np.asarray(places, dtype=np.float64)


def sweep(t: Floats, fa: float, fb: float, size: float = 0.6) -> Floats:
    """A sine whose frequency grows exponentially from fa to fb Hz, about the middle."""
    q = np.log(fb / fa) / t[-1]
    return np.asarray(size * np.sin(2 * np.pi * fa * np.expm1(q * t) / q))


def decades(t: Floats, fs: Sequence[float]) -> Floats:
    """Whole sines from the foot at each of the frequencies fs [Hz], an equal time for each."""
    edges, y = np.linspace(0, t[-1] * (1 + 1e-12), len(fs) + 1), np.full(len(t), -1.0)
    for a, b, f in zip(edges[:-1], edges[1:], fs, strict=True):
        here = (t >= a) & (t < b) & ((t - a) * f < max(1, np.floor((b - a) * f)))
        y[here] = -np.cos(2 * np.pi * f * (t[here] - a))
    return y


def multisine(t: Floats, fs: Sequence[float], rng: Random) -> Floats:
    """Sines of equal size at the frequencies fs [Hz], random phases, faded in."""
    y: Any = sum(
        np.sin(2 * np.pi * f * t + a)
        for f, a in zip(fs, rng.uniform(0, 6.28, len(fs)), strict=True)
    )
    y = y * np.minimum(1, t / (0.05 * t[-1]))
    return np.asarray(y / np.max(np.abs(y)))


def smooth(t: Floats, every: float, rng: Random) -> Floats:
    """Random places, one each `every` s, joined by a monotone cubic (PCHIP)."""
    k = np.arange(0, t[-1] + 2 * every, every)
    y = rng.uniform(-1, 1, len(k))
    y[0] = -1
    return np.asarray(interpolate.PchipInterpolator(k, y)(t))


DRAWN: dict[str, Callable[..., Floats]] = {"multisine": multisine, "smooth": smooth}
VOLTAGES: dict[str, Callable[..., Floats]] = {
    "fading": fading, "triangles": triangles, "staircase": staircase, "sweep": sweep,
    "decades": decades, **DRAWN,
}  # fmt: skip


def wave(spec: Sequence[Any], t: Floats, rng: Random) -> Floats:
    """Return the voltage of `spec`, its name and its arguments."""
    name, *inputs = spec
    return VOLTAGES[name](t, *inputs, *([rng] if name in DRAWN else []))


# --- noises, of unit standard deviation ----------------------------------------------------------


def noise(kind: str, n: int, rng: Random, dt: float, y: Floats) -> Floats:
    """Return noise (n,) of rms 1; y is the reading over the noise's rms."""
    if kind == "repeated":  # a tenth of the samples hold the one before
        out = noise("white", n, rng, dt, y)
        keep = np.maximum.accumulate(np.where(rng.random(n) < 0.1, 0, np.arange(n)))
        return np.asarray((y + out)[keep] - y)
    white = rng.standard_normal(n)
    match kind:
        case "quantised":
            q = 3.2
            return np.asarray(np.round((y + 0.3 * white) / q) * q - y)
        case "pink":  # 1/f in power, by its spectrum
            f = np.fft.rfft(white)
            white = np.fft.irfft(f / np.sqrt(np.maximum(np.arange(len(f)), 1)), n)
        case "autoregressive":
            white = signal.lfilter([1], [1, -1.5, 0.65], rng.standard_normal(n + 500))[500:]
        case "telegraph":
            white = 0.35 * white + np.where(np.cumsum(rng.random(n) < 40 / n) % 2, 1.0, -1.0)
        case "student":
            white = rng.standard_t(3, n)
        case "hum":
            s = np.arange(n) * dt
            white += sum(a * np.sin(2 * np.pi * f * s + a) for f, a in ((50, 1.3), (150, 0.4)))
    white = white - white.mean()
    out = white / white.std()
    if kind == "outliers":
        where = rng.random(n) < 0.005
        out = out + where * rng.uniform(10, 50, n) * rng.choice([-1, 1], n)
    return np.asarray(out)


# --- what no effect of the table is: changes of a motion [um] ------------------------------------


def fringes(t: Floats, y: Floats, _v: Floats, rng: Random) -> Floats:
    """An interferometer (633 nm, double pass) loses or gains fringes at four fast places."""
    speed = np.abs(np.gradient(y, t[1] - t[0]))
    where = rng.choice(np.flatnonzero(speed > np.quantile(speed, 0.8)), 4, replace=False)
    jump = np.zeros(len(t))
    jump[where] = 0.1582 * rng.choice([-2, -1, 1, 2], 4)
    return np.asarray(y + np.cumsum(jump))


def clamp(t: Floats, y: Floats, _v: Floats, rng: Random) -> Floats:
    """The clamp slips back near the top of the stroke, now and then, and settles within 20 ms."""
    top = signal.find_peaks(y, height=np.quantile(y, 0.85), distance=len(t) // 25)[0]
    for k in top[rng.random(len(top)) < 0.6]:
        s = np.maximum(0, t - t[k])
        y = y - 0.06 * rng.uniform(0.5, 1.5) * (1 - np.exp(-s / 0.02))
    return y


def other_axis(t: Floats, y: Floats, _v: Floats, _rng: Random) -> Floats:
    """Another axis scans a raster: a triangle of 3.7 Hz and a slow staircase leak in."""
    line = 3.7 * t
    scan = 0.08 * signal.sawtooth(2 * np.pi * line, 0.8)
    return np.asarray(y + scan + 0.012 * np.floor(line / 2))


def series(t: Floats, y: Floats, _v: Floats, rng: Random) -> Floats:
    """A second actuator in series follows a voltage that nobody recorded: holds, smooth moves."""
    at = np.sort(rng.uniform(0, t[-1], 9))
    signs = rng.choice([-1, 1], 9)
    moves = [a * 0.5 * (1 + np.tanh((t - b) / 0.15)) for a, b in zip(signs, at, strict=True)]
    return np.asarray(y + 0.2 * sum(moves))


def floor_shake(t: Floats, y: Floats, _v: Floats, rng: Random) -> Floats:
    """The floor shakes a table of 13 Hz, damping 5 %; now and then somebody walks by."""
    w, dt = 2 * np.pi * 13.0, t[1] - t[0]
    swell = np.interp(t, np.linspace(0, t[-1], 12), rng.uniform(0.1, 1, 12) ** 2)
    b, c = signal.bilinear([w * w], [1, 0.1 * w, w * w], 1 / dt)
    x = signal.lfilter(b, c, swell * rng.standard_normal(len(t)))
    return np.asarray(y + 0.06 * x / x.std())


def brownout(t: Floats, y: Floats, _v: Floats, rng: Random) -> Floats:
    """The gauge's excitation sags for a while, three times: all of the reading shrinks by 1.5 %."""
    k = np.sort(rng.uniform(0.05, 0.95, 6)) * t[-1]
    return np.asarray(y * (1 - 0.015 * (np.searchsorted(k, t) % 2)))


def wander(t: Floats, y: Floats, _v: Floats, rng: Random) -> Floats:
    """The gauge's clock wanders slowly against the generator's, 6 ms rms."""
    w = np.interp(t, np.linspace(0, t[-1], 25), rng.standard_normal(25))
    return np.asarray(np.interp(t + 0.006 * (w - w.mean()) / w.std(), t, y), dtype=np.float64)


FOREIGN: dict[str, Extra] = {
    f.__name__: f for f in (fringes, clamp, other_axis, series, floor_shake, brownout, wander)
}

# --- the recorder --------------------------------------------------------------------------------


def record(
    fine: Floats, full: Floats, t: Floats, rms: float, colour: str, rng: Random
) -> tuple[Floats, Floats]:
    """Return readings [um] and their stamps [s] of a motion `full` [um] at times `fine` [s].

    The gauge's trigger has `jitter`, or the `stamps` in the file have.
    """
    at, stamp, dt = t, t, float(t[1] - t[0])
    if colour in ("jitter", "stamps"):
        rms *= 0.7
        late = rng.standard_normal(len(t)) * rms / np.std(np.gradient(full[::SUB], dt))
        late = np.clip(late, -0.45 * dt, 0.45 * dt)
        late[0] = 0
        at, stamp = (t + late, t) if colour == "jitter" else (t, t + late)
    y = np.interp(at, fine, full)
    return y + rms * noise(colour, len(t), rng, dt, y / rms), stamp
