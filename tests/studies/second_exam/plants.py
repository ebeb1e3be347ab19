"""Physics of piezoelectric stacks, their drives and gauges.

Units: time s, voltage V, displacement um. Inside, `v` is the voltage in half ranges about its
middle (-1 to 1) and `x` the displacement in half strokes (-1 to 1).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import signal

from tests.studies.exam.record import Floats, filtered

#: Steps of the simulation between two samples.
SUB = 12
#: What is hidden: a form's name -> its parameters.
Hidden = Mapping[str, Any]
#: What changes a motion [um]: times, motion, voltage in half ranges, random numbers.
Extra = Callable[[Floats, Floats, Floats, np.random.Generator], Floats]


@dataclass(frozen=True)
class Plant:
    """A healthy stack, and what is wrong with it.

    Lowest and highest voltage [V], stroke over them [um], width of the loop over the stroke at full
    amplitude; hysteresis and its parameters; resonances of wafers and bonding layers [Hz] with
    their damping ratios, stiffness k_B over k_P; `tau`: the amplifier's output resistance times
    the stack's capacitance [s].
    """

    lo: float
    hi: float
    stroke: float
    width: float
    hyst: str = "bouc_wen"
    hpar: Mapping[str, Any] = field(default_factory=dict)
    f1: float = 3000.0
    zeta1: float = 0.1
    f2: float = 9000.0
    zeta2: float = 0.25
    stiff: float = 3.0
    tau: float = 1e-4
    hidden: Hidden = field(default_factory=dict)


def lti(num: Sequence[float], den: Sequence[float], x: Floats, dt: float) -> Floats:
    """Filter x by num(s)/den(s) from the steady state of x[0], in a time of numbers near 1."""
    scale = abs(den[-1] / den[0]) ** (1 / (len(den) - 1))
    numerator, denominator = (
        [c * scale ** (len(p) - 1 - k) for k, c in enumerate(p)] for p in (num, den)
    )
    return filtered(numerator, denominator, x, dt * scale)


def bouc_wen(
    v: Floats, ell: float = 0.4, n: float = 1.3, beta: float = 0.7, delta: float = 0.0,
    rate: Floats | None = None,
) -> Floats:  # fmt: skip
    """Return z of dz = dv/ell (A - (beta sgn(dv z) + 1 - beta)|z|^n + delta sgn z), by Heun's rule.

    Source: Y. K. Wen, J. Eng. Mech. 102 (1976) 249; T. S. Low, W. Guo (1995) for stacks; `delta`:
    asymmetry of W. Zhu, D. H. Wang (2012). `rate`: A per step.
    """
    out, z, g = np.empty(len(v)), 0.0, 1.0 - beta
    steps = np.diff(v, prepend=v[0]).tolist()
    A = np.ones(len(v)).tolist() if rate is None else rate.tolist()

    def slope(z: float, s: float, a: float) -> float:
        side = 1.0 if z > 0 else -1.0 if z < 0 else 0.0
        return (a - (beta * s * side + g) * math.pow(abs(z), n) + delta * side) / ell

    for k, d in enumerate(steps):
        s, parts = 1.0 if d > 0 else -1.0, math.ceil(abs(d) / (0.03 * ell))
        e = d / max(1, parts)
        for _ in range(parts):
            q = slope(z, s, A[k])
            z += e * 0.5 * (q + slope(z + e * q, s, A[k]))
        out[k] = z
    return out


def prandtl(
    v: Floats,
    r: tuple[float, ...] = (0.05, 0.12, 0.25, 0.45, 0.8),
    w: tuple[float, ...] = (0.3, 0.25, 0.2, 0.15, 0.1),
    rate: Floats | None = None,
) -> Floats:
    """Return sum w (v - play), Prandtl-Ishlinskii.

    Source: K. Kuhnen, Eur. J. Control 9 (2003) 407. `rate`: factor on the thresholds per step,
    M. Al Janaideh, P. Krejci (2013).
    """
    out = np.zeros(len(v))
    factors = np.ones(len(v)) if rate is None else rate
    for ri, wi in zip(r, w, strict=True):
        p, ys = float(v[0]), []
        for x, q in zip(v.tolist(), (ri * factors).tolist(), strict=True):
            p = max(x - q, min(x + q, p))
            ys.append(p)
        out += wi * (v - np.array(ys))
    return out


def dahl(v: Floats, ell: float = 0.5, i: float = 2.0) -> Floats:
    """Return z of dz/dv = |1 - z sgn dv|^i / ell. Source: P. R. Dahl, 1968."""
    out, z = np.empty(len(v)), 0.0
    for k, d in enumerate(np.diff(v, prepend=v[0]).tolist()):
        s, parts = 1.0 if d > 0 else -1.0, math.ceil(abs(d) / (0.03 * ell))
        e = d / max(1, parts)
        for _ in range(parts):
            q = abs(1 - s * z) ** i / ell
            z += e * 0.5 * (q + abs(1 - s * (z + e * q)) ** i / ell)
        out[k] = z
    return out


def hodgdon(
    v: Floats, alpha: float = 3.0, e: float = 0.15, b: float = 0.4, q: float = 0.2
) -> Floats:
    """Return v - h of h' = alpha |v'| (f(v) - h) + v' g(v), f = v + e v^3, g = b(1 + q v).

    Source: B. D. Coleman, M. L. Hodgdon, Int. J. Eng. Sci. 24 (1986) 897.
    """
    out, h = np.empty(len(v)), v[0]
    for k in range(len(v)):
        if k:
            d, m = v[k] - v[k - 1], 0.5 * (v[k] + v[k - 1])
            a = 1 - np.exp(-alpha * abs(d))
            h += a * (m + e * m**3 - h) + d * b * (1 + q * m)
        out[k] = v[k] - h
    return out


def preisach(v: Floats, s2: float = 0.25, s3: float = -0.05, skew: float = 0.1) -> Floats:
    """Return v - h, h from an Everett function, Rayleigh's and a cubic, of the reversals.

    Source: I. D. Mayergoyz, "Mathematical Models of Hysteresis", 1991.
    """

    def everett(a: float, b: float) -> float:
        d = a - b
        return d * (1 - 2 * s2 - 4 * s3 + s2 * d + s3 * d * d * (1 + skew * (a + b)))

    # reversals low, high, low ...: it came up from below the range
    out, rev = np.empty(len(v)), [-1.05]
    base, x0 = [-1.05], -1.05
    for k, x in enumerate(v.tolist()):
        rising = len(rev) % 2 == 1
        if x != x0 and (x > x0) != rising and not (len(rev) == 1 and x < rev[0]):
            base.append(out[k - 1] if k else 0.0)
            rev.append(x0)
        while len(rev) > 2 and ((x >= rev[-2]) if len(rev) % 2 == 1 else (x <= rev[-2])):
            del rev[-2:], base[-2:]
        up = len(rev) % 2 == 1
        out[k] = base[-1] + (everett(x, rev[-1]) if up else -everett(rev[-1], x))
        x0 = x
    return v - out


HYST: dict[str, Callable[..., Floats]] = {
    "bouc_wen": bouc_wen,
    "prandtl": prandtl,
    "dahl": dahl,
    "hodgdon": hodgdon,
    "preisach": preisach,
}


def lag_gain(model: str, par: Mapping[str, Any], width: float) -> float:
    """Return c so that v - c z has loops `width` wide, over its stroke, at full amplitude."""
    v = np.interp(np.arange(1201), [0, 200, 600, 800, 1200], [-1, 1, -1, 0, 1])
    v = np.concatenate([v[:601], np.linspace(-1, 1, 401)[1:]])
    z = HYST[model](v, **par)
    fall, rise = z[200:601][::-1], z[600:1001]
    return float(2 * width / (np.max(np.abs(rise - fall)) + width * (z[200] - z[600])))


def drive(
    cmd: Floats, dt: float, tau: float | Floats, kappa: float = 0.0, slope: float = np.inf
) -> Floats:
    """Charge through the output resistance: tau(1 + kappa v) v' = cmd - v, |v'| <= slope [1/s]."""
    out, u, top = np.empty(len(cmd)), float(cmd[0]), slope * dt
    taus = np.broadcast_to(tau, len(cmd))
    mid = 0.5 * (cmd + np.concatenate([cmd[:1], cmd[:-1]]))
    for k in range(len(cmd)):
        d = (mid[k] - u) * -np.expm1(-dt / (taus[k] * (1 + kappa * u)))
        u += max(-top, min(top, d))
        out[k] = u
    return out


def amplifier(v: Floats, dt: float, p: Plant, h: Hidden) -> Floats:
    """Return the stack's voltage of the command, both in half ranges."""
    if "clip" in h:  # a soft knee of width `soft`, as of an output stage near its rail
        c = h["clip"]
        v = c["level"] - c["soft"] * np.logaddexp(0, (c["level"] - v) / c["soft"])
    if "amp_poly" in h:
        v = v + h["amp_poly"]["a2"] * (v * v - 1) + h["amp_poly"]["a3"] * (v**3 - v)
    if "servo" in h:  # an integrator of the reading, which is near v, left on: s/(s + ki)
        v = lti([1, 0], [1, h["servo"]["ki"]], v - v[0], dt) + v[0]
    if "leak" in h:  # charge drive's resistor (Fleming and Moheimani 2005): s/(s + 1/tau)
        q = h["leak"]["tau"]
        v = lti([1, 0], [1, 1 / q], v + 1, dt) - 1
    if "butter" in h:
        w, z = 2 * np.pi * h["butter"]["f"], h["butter"]["zeta"]
        v = lti([w * w], [1, 2 * z * w, w * w], v, dt)
    d = dict(h.get("drive") or {})
    if "contact_noise" in h:  # switches at random (fixed draw), about 40 times
        taus, g = np.array(h["contact_noise"]), np.random.default_rng(len(v))
        d["tau"] = taus[np.cumsum(g.random(len(v)) < 40 / len(v)) % 2]
    if d:
        return drive(v, dt, d.get("tau", p.tau), d.get("kappa", 0.0), d.get("slope", np.inf))
    return lti([1], [p.tau, 1], v, dt)


def electric(v: Floats, t: Floats, p: Plant, h: Hidden) -> Floats:
    """Return the free displacement [half strokes] of the stack's voltage."""
    dt = float(t[1] - t[0])
    hpar = dict(p.hpar)
    c = lag_gain(p.hyst, hpar, p.width)
    hpar |= h.get("hyst", {})
    if "log_rate" in h:  # 1 + kappa log10(1 + |v'|/r0): Bouc-Wen's drive, or thresholds
        q = h["log_rate"]
        hpar["rate"] = 1 + q["kappa"] * np.log10(
            1 + np.abs(np.diff(v, prepend=v[0])) / dt / q["r0"]
        )
    x = v - c * HYST[p.hyst](v, **hpar)
    if "quad" in h:  # electrostriction on top of the piezoelectric strain (Damjanovic 1998)
        x = x + h["quad"] * ((v + 1) ** 2 / 2 - (v + 1))
    if "langevin" in h:  # domains run out (Smith 2005): coth(a) - 1/a from the range's foot
        a = h["langevin"] * (v - v.min() + 0.02)
        x = x - v + (1 / np.tanh(a) - 1 / a) * 3 / h["langevin"]
    gain = np.ones(len(v))
    if "heat" in h:  # one thermal mass; the loop's loss: |v'| times its half width
        q = h["heat"]
        p_loss = np.abs(np.gradient(v, dt))
        temp = lti([1], [q["tau"], 1], p_loss, dt) - p_loss[0] * np.exp(-t / q["tau"])
        gain = gain + q["kappa"] * temp
    if "age" in h:
        gain = gain - h["age"]["rate"] * np.log10(1 + t / h["age"]["t0"])
    if "depole" in h:  # each excursion below `level` switches domains back: gain is lost
        below = (v < h["depole"]["level"]) & (np.roll(v, 1) >= h["depole"]["level"])
        below[0] = False
        gain = 1 - h["depole"]["loss"] * np.minimum(np.cumsum(below), h["depole"]["most"])
    x = gain * (x + 1) - 1
    chain = power_creep(**h["power_creep"]) if "power_creep" in h else h.get("creep", ())
    for tau, w in chain:  # chain of Kelvin-Voigt elements (Croft, Shed, Devasia 2001)
        x = x + w * lti([1], [tau, 1], x, dt)
    return np.asarray(x)


def power_creep(
    alpha: float, share: float, lo: float, hi: float, number: int = 9
) -> list[tuple[float, float]]:
    """Return Kelvin-Voigt elements that creep as t^alpha from lo to hi s. Andrade (1910)."""
    tau = np.geomspace(lo, hi, number)
    w = tau**alpha
    return list(zip(tau.tolist(), (share * w / w.sum()).tolist(), strict=True))


def mechanics(x: Floats, dt: float, p: Plant, h: Hidden) -> Floats:
    """Return the output's motion: wafers, then bonding layers, load and guide.

    Source: Yang and Zhu 2015, eq. 10.
    """
    w1, w2 = 2 * np.pi * p.f1, 2 * np.pi * p.f2
    cp, cb = 2 * p.zeta1 / w1, 2 * p.zeta2 / w2 * p.stiff
    den = np.polymul([1 / w1**2, 2 * p.zeta1 / w1, 1], [1 / w2**2, 2 * p.zeta2 / w2, 1])
    x = lti([(cb + cp) / (1 + p.stiff), 1], den.tolist(), x, dt)
    if "duffing" in h:  # guide k + k3 x^2 (Duffing) below its resonance: x + k3 (x+1)^3/4 = force
        y = x.copy()
        for _ in range(6):
            s = y + 1
            y -= (y + h["duffing"] * s**3 / 4 - x) / (1 + h["duffing"] * s**2 * 0.75)
        x = y
    if "contact" in h:  # a spring above one place, as a share of the stack's stiffness
        x = x - (x > h["contact"]["at"]) * (x - h["contact"]["at"]) * h["contact"]["share"]
    if "mount" in h:  # the frame recoils on a spring: b'' + 2 z w b' + w^2 b = -r x''
        w, q = 2 * np.pi * h["mount"]["f"], h["mount"]
        x = x - lti([q["mass"], 0, 0], [1, 2 * q["zeta"] * w, w * w], x, dt)
    if "play" in h:
        x = stick(x, h["play"], h["play"])
    if "stiction" in h:
        q = h["stiction"]
        x = x - q["share"] * (x - stick(x, q["hold"], q["slide"]))
    return np.asarray(x)


def stick(x: Floats, hold: float, slide: float) -> Floats:
    """Return what stays until `hold` behind, then runs `slide` behind until the reversal."""
    out, y, moving = np.empty(len(x)), float(x[0]), 0
    for k, a in enumerate(x.tolist()):
        d = a - y
        s = 1 if d > 0 else -1
        if moving != s and abs(d) >= hold:
            moving = s
        if moving == s and abs(d) > slide:
            y = a - s * slide
        elif moving == s and k and (a - x[k - 1]) * s < 0:
            moving = 0
        out[k] = y
    return out


def gauge(y: Floats, t: Floats, h: Hidden, rng: np.random.Generator) -> Floats:
    """Return the reading [um] of the motion [um]."""
    dt = float(t[1] - t[0])
    mid, half = 0.5 * (y.max() + y.min()), 0.5 * np.ptp(y)
    if "delay" in h:
        y = np.interp(t - h["delay"], t, y)
    if "lag" in h:
        y = lti([1], [h["lag"], 1], y, dt)
    if "bent" in h:  # tilted plates of a capacitive gauge: second and third order over the stroke
        s = (y - mid) / half
        y = y + half * (h["bent"][0] * s * s + h["bent"][1] * s**3)
    if "ripple" in h:  # an interferometer's periodic error or an encoder's interpolation
        q = 2 * np.pi * y / h["ripple"]["pitch"]
        y = y + h["ripple"]["size"] * (np.sin(q + 0.4) + 0.3 * np.sin(2 * q + 1.1))
    if "step" in h:
        y = y + h["step"]["size"] / (
            1 + np.exp(-(y - mid - half * h["step"]["at"]) / (0.002 * half))
        )
    if "drift" in h:  # warm-up, and a slow walk on top
        q = h["drift"]
        walk = signal.lfilter([1], [1, -1], rng.standard_normal(len(t))) / np.sqrt(len(t))
        y = y + q["size"] * (1 - np.exp(-t / q["tau"])) + q.get("walk", 0.0) * walk
    if "hum" in h:
        q = h["hum"]
        y = y + q["size"] * (
            np.sin(2 * np.pi * q["f"] * t + 1) + q.get("third", 0) * np.sin(6 * np.pi * q["f"] * t)
        )
    return np.asarray(y)


def simulate(
    p: Plant, u: Floats, dt: float, rng: np.random.Generator, extra: Extra | None = None
) -> tuple[Floats, Floats]:
    """Return fine times [s] and the reading [um] without noise; u [V] is linear between samples."""
    n, fine = len(u), dt / SUB
    t = np.arange((n - 1) * SUB + 1, dtype=np.float64) * fine
    v = np.interp(t, np.arange(n) * dt, 2 * (u - p.lo) / (p.hi - p.lo) - 1)
    stack = amplifier(v, fine, p, p.hidden)
    y = 0.5 * p.stroke * (1 + mechanics(electric(stack, t, p, p.hidden), fine, p, p.hidden))
    if extra is not None:
        y = extra(t, y, v, rng)
    return t, gauge(y, t, p.hidden, rng)
