"""From free strain to displacement: masses, load, contact, friction."""

import math
from collections.abc import Callable

import numpy as np

from tests.studies.exam.linear import filtered, resonant
from tests.studies.exam.record import Floats, Run, Values

MotionCause = Callable[[Floats, Run, Values], Floats]


def displacement(strain: Floats, run: Run) -> Floats:
    """Return the displacement [um] of a stack whose free strain is given [V]."""
    moved = _vibrating(strain, run)
    modes = run.record.hidden.get("mode", ())
    if modes:
        frequency, damping, share = modes
        moved = moved + share * resonant(strain, frequency, damping, run.step)
    moved = moved * run.record.stack.stroke / run.record.test.span
    for name, cause in MOTION.items():
        if name in run.record.hidden:
            moved = cause(moved, run, run.record.hidden[name])
    return moved


def _vibrating(strain: Floats, run: Run) -> Floats:
    """Two resonances in a row, unless the masses are a pair or the damping grows."""
    f1, zeta1, f2, zeta2 = run.record.stack.mechanics
    hidden = run.record.hidden
    if "reciprocal masses" in hidden:
        return _two_masses(strain, run, hidden["reciprocal masses"][0])
    if "amplitude damping" in hidden:
        first = _growing_damping(strain, run, hidden["amplitude damping"][0])
        return resonant(first, f2, zeta2, run.step)
    zero = (2 * zeta1 / f1 + 6 * zeta2 / f2) / (8 * math.pi)
    return resonant(resonant(strain, f1, zeta1, run.step), f2, zeta2, run.step, zero)


def _two_masses(strain: Floats, run: Run, ratio: float) -> Floats:
    """Newton's equations of two masses, the outer `ratio` times the inner.

    x_B = (c_B s + k_B) k_P/((s^2 + (c_P + c_B) s + k_P + k_B)(q s^2 + c_B s + k_B) - (c_B s +
    k_B)^2) g, in a time that is scaled by the first frequency.
    """
    f1, zeta1, f2, zeta2 = run.record.stack.mechanics
    w1, w2 = 2 * math.pi * f1, 2 * math.pi * f2
    k_p, c_p = w1**2, 2 * zeta1 * w1
    k_b, c_b = ratio * w2**2, 2 * zeta2 * w2 * ratio
    link = np.array([c_b, k_b])
    outer = np.polymul([1, c_p + c_b, k_p + k_b], [ratio, c_b, k_b])
    total = np.polysub(outer, np.polymul(link, link)) / (k_b * k_p)
    numerator = link * w1 ** np.array([1, 0]) / k_b
    denominator = total * w1 ** np.arange(total.size)[::-1]
    return filtered(numerator.tolist(), denominator.tolist(), strain, run.step * w1)


def _growing_damping(strain: Floats, run: Run, growth: float) -> Floats:
    """One mode whose damping grows with its speed: 2 zeta w v (1 + k |v|/(w R)), midpoint rule."""
    f1, zeta, *_ = run.record.stack.mechanics
    w = 2 * math.pi * f1
    parts = max(1, math.ceil(run.step * w / 0.15))
    h, scale = run.step / parts, w * run.record.test.span

    def acceleration(force: float, x: float, v: float) -> float:
        return w * w * (force - x) - 2 * zeta * w * v * (1 + growth * abs(v) / scale)

    x, v = float(strain[0]), 0.0
    places = [x]
    for before, after in zip(strain[:-1].tolist(), strain[1:].tolist(), strict=True):
        for part in range(parts):
            force = before + (after - before) * (part + 0.5) / parts
            middle = v + h / 2 * acceleration(force, x, v)
            v += h * acceleration(force, x + h / 2 * v, middle)
            x += h * middle
        places.append(x)
    return np.array(places)


def _stiffening_load(x: Floats, run: Run, values: Values) -> Floats:
    """A load whose force grows exponentially: y + a R (exp(y/l) - 1 - y/l) = x, by Newton."""
    force, length = values[0] * run.record.stack.stroke, values[1] * run.record.stack.stroke
    y = x.copy()
    for _ in range(30):
        growth = np.exp(y / length)
        error = y + force * (growth - 1 - y / length) - x
        y -= error / (1 + force / length * (growth - 1))
    return y


def _contact(x: Floats, run: Run, values: Values) -> Floats:
    """A contact that opens: beyond x_0 the slope is smaller by k, with a rounded corner."""
    loss, place, width = values
    size = width * run.record.stack.stroke
    corner = np.logaddexp(0, (x - place * run.record.stack.stroke) / size)
    return np.asarray(x - loss * size * corner)


def _guide_friction(x: Floats, run: Run, values: Values) -> Floats:
    """The stack's spring against a guide that sticks: y = x - c F, F' = (1 - F sgn y') y'/l.

    Source: P. R. Dahl, AIAA J. 14 (1976) 1675.
    """
    push, length = values[0] * run.record.stack.stroke, values[1] * run.record.stack.stroke
    force, last = 0.0, float(x[0])
    out = []
    for place in x.tolist():
        moved, last = place - last, place
        slope = (1 - force * float(np.sign(moved))) / length
        force += slope * moved / (1 + push * slope)
        out.append(place - push * force)
    return np.array(out)


def _play(x: Floats, run: Run, values: Values) -> Floats:
    """A joint that follows only beyond its play."""
    width, place = values[0] * run.record.stack.stroke, float(x[0])
    out = []
    for driven in x.tolist():
        place = max(driven - width, min(driven + width, place))
        out.append(place)
    return np.array(out)


def _stick_slip(x: Floats, run: Run, values: Values) -> Floats:
    """Short whiles in which the output moves in jerks."""
    size, count = values
    rng, out = run.record.draws(5), np.zeros(x.size)
    for start in np.sort(rng.integers(0, x.size, int(count))).tolist():
        stop = min(x.size, start + int(x.size * rng.uniform(0.01, 0.04)))
        jerk = size * run.record.stack.stroke * rng.uniform(0.5, 1.5)
        away = x[start:stop] - x[start]
        out[start:stop] = np.clip(np.round(away / (4 * jerk)) * 4 * jerk - away, -jerk, jerk)
    return x + out


#: Causes that change the displacement [um], in the order of the signal.
MOTION: dict[str, MotionCause] = {
    "stiffening load": _stiffening_load,
    "contact": _contact,
    "guide friction": _guide_friction,
    "play": _play,
    "stick-slip": _stick_slip,
}
#: Causes within the masses.
MASSES = ("mode", "reciprocal masses", "amplitude damping")
