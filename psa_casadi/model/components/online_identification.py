"""Blocks that learn the hysteresis sample by sample, or take it off.

The voltage goes in a line from one sample to the next, so that it turns at samples only: the kink
of eq. (8) never lies inside a step (see below). The voltage at which `k_L u + f_H(u)` is
the wanted force, `K w` of a wanted displacement w at the stiffness K, is solved for by three Newton
steps. Every sample takes the same operations.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice

import casadi as ca

from psa_casadi.model.component import Equations, Expression, Symbols, component
from psa_casadi.model.shapes import hysteresis_scale, voltage_scale
from psa_casadi.model.variables import Input, Output, Parameter, State, Values

#: Parameters that are tracked, in the order of z, and the unit of each.
TRACKED = {
    "A": "N/V", "beta": "N/V", "gamma": "N/V", "delta": "N/(V.s)", "n": "1",
    "k_L": "N/V", "offset": "N",
}  # fmt: skip
COUNT = len(TRACKED)
SHAPES = 5
#: A parameter of the hysteresis is at least of this size, as a share of k_L, to change by shares.
_LEAST_SIZE = 0.02
#: The slope of force over voltage is taken as no smaller than this share of k_L.
_LEAST_SLOPE = 0.2
#: Implicit share of a stage of the force's step, and Newton steps towards it.
IMPLICIT, _NEWTON = 1.0 - math.sqrt(0.5), 2
#: Newton steps towards the voltage of a wanted force.
_OUTER = 3


@dataclass(frozen=True)
class Constants:
    """What does not change from sample to sample: spreads (7), lag weights, noise [N], ...

    `forget` is T/memory; `keep`, `old`, `new` step the lag.
    """

    start: tuple[Expression, ...]
    spread: tuple[Expression, ...]
    h_ref: Expression
    hold_rate: Expression
    stiffness: Expression
    period: Expression
    keep: Expression
    old: Expression
    new: Expression
    noise_square: Expression
    forget: Expression
    standstill_rate: Expression


def constants(p: Mapping[str, Expression]) -> Constants:
    """Return the constants from parameters in SI units (`online_identification` lists them)."""
    k, share, T = p["k_L"], p["spread"], p["period"]
    bend, least = ca.fabs(p["beta"]) + ca.fabs(p["gamma"]), _LEAST_SIZE * k
    sizes = (
        ca.fabs(p["A"]) + least, bend + least, bend + least, ca.fabs(p["delta"]) + least,
        1.0, k, 0.1 * k * p["u_rated"],
    )  # fmt: skip
    keep = ca.exp(-T / p["lag"])
    held = (1.0 - keep) * p["lag"] / T
    return Constants(
        start=(p["A"], p["beta"], p["gamma"], p["delta"], p["n"], k, 0.0),
        spread=tuple(share * size for size in sizes),
        h_ref=p["h_ref"],
        hold_rate=p["hold_rate"],
        stiffness=p["stiffness"],
        period=T,
        keep=keep,
        old=held - keep,
        new=1.0 - held,
        noise_square=(p["noise"] * p["stiffness"]) ** 2,
        forget=T / p["memory"],
        standstill_rate=p["standstill_rate"],
    )


def estimates(c: Constants, z: Sequence[Expression]) -> list[Expression]:
    """Return A, beta, gamma, delta, n, k_L, offset in SI units."""
    return [a + s * d for a, s, d in zip(c.start, c.spread, z, strict=True)]


def slopes(
    c: Constants, theta: Sequence[Expression], f: Expression, du: Expression, swept: Expression,
    held: Expression,
) -> tuple[Expression, Expression, list[Expression]]:  # fmt: skip
    """Return the change of f over du at f, its derivative by f, and by A, beta, gamma, delta, n.

    `swept` is |du| and `held` the integral of u sgn(u'), both with the smooth sign.
    """
    A, beta, gamma, delta, n = theta[:SHAPES]
    ratio = f / c.h_ref
    square = ratio * ratio + 1e-24
    bare = square ** (0.5 * (n - 1.0))  # |ratio|^(n-1)
    signed, power = ratio * bare, square * bare / ca.sqrt(square)
    bend = beta * swept * signed + gamma * du * power
    slope = -n * (beta * swept * bare + gamma * du * signed / ca.sqrt(square)) / c.h_ref
    by = [du, -swept * signed, -du * power, held, -0.5 * ca.log(square) * bend]
    return A * du - bend + delta * held, slope, by


def swept_over(
    c: Constants, last: Expression, u: Expression
) -> tuple[Expression, Expression, Expression, Expression]:
    """Return du [V], |du|, the integral of u sgn(u') over a period [V s], and u' [V/s]."""
    du = u - last
    rate = du / c.period
    sign = rate / ca.sqrt(rate * rate + c.hold_rate * c.hold_rate)
    return du, du * sign, 0.5 * (u + last) * sign * c.period, rate


def stages(
    c: Constants, theta: Sequence[Expression], f: Expression, last: Expression, u: Expression,
    held: Expression | None = None,
) -> tuple[Expression, Expression, Expression]:  # fmt: skip
    """Return the two stages of the step of f, of which the second is its end, and df/du there.

    The derivative is that before the last Newton step towards each stage, without that of `held`,
    the integral of u sgn(u'), which follows from u if it is not given.
    """
    du, swept, following, _ = swept_over(c, last, u)
    held = following if held is None else held
    free = theta[0] * du + theta[3] * held

    def solved(known: Expression) -> tuple[Expression, Expression, Expression]:
        """Return the stage F = known + IMPLICIT g(F), from the outer side of the root, g_F, g_u."""
        farthest = ca.fmax(_largest_force(c, theta), ca.fabs(f)) + ca.fabs(theta[3] * held)
        stage = ca.fmax(ca.fmin(known + IMPLICIT * free, farthest), -farthest)
        slope = by_u = ca.SX(0)
        for _ in range(_NEWTON):
            change, slope, _ = slopes(c, theta, stage, du, swept, held)
            by_u = ca.if_else(ca.fabs(du) > 0.0, (change - theta[3] * held) / du, theta[0])
            stage -= (stage - known - IMPLICIT * change) / (1.0 - IMPLICIT * slope)
        return stage, slope, by_u

    first, slope, by_u = solved(f)
    rise = (slope * IMPLICIT * by_u) / (1.0 - IMPLICIT * slope) + by_u
    end, slope, by_u = solved(f + (1.0 - IMPLICIT) / IMPLICIT * (first - f))
    return first, end, ((1.0 - IMPLICIT) * rise + IMPLICIT * by_u) / (1.0 - IMPLICIT * slope)


def _largest_force(c: Constants, theta: Sequence[Expression]) -> Expression:
    """Return the size of f [N] at which it bends no further, the larger one of both directions."""
    A, beta, gamma, _, n = theta[:SHAPES]
    sizes = ca.fabs(beta) + ca.fabs(gamma)
    least = ca.fmax(beta - ca.fabs(gamma), 1e-3 * sizes + 1e-12)
    return c.h_ref * (ca.fabs(A) / least + 1e-24) ** (1.0 / n)


def force_after(
    c: Constants, theta: Sequence[Expression], f: Expression, last: Expression, u: Expression
) -> Expression:
    """Return the hysteresis force [N] after the voltage has gone from `last` to u in one period."""
    return stages(c, theta, f, last, u)[1]


def linearising_voltage(
    c: Constants, theta: Sequence[Expression], f: Expression, last: Expression, guess: Expression,
    force: Expression,
) -> tuple[Expression, Expression]:  # fmt: skip
    """Return the next voltage u [V] at which k_L u + f_H(u) is the wanted force [N], and f_H there.

    Eqs. (39) to (41). The paper subtracts the observed force of the moment; here it is that of the
    next instant, so that no sample is lost. From `guess`, Newton's steps, which are enough for a
    jump across the range: the slope only grows along the way from a turn. sgn(u') is that on the
    way to `guess`: with delta < 0 a voltage that creeps on solves the equation of a place at rest,
    too.
    """
    u, held = guess, swept_over(c, last, guess)[2]
    for _ in range(_OUTER):
        _, end, by_u = stages(c, theta, f, last, u, held)
        slope = ca.fmax(theta[5] + by_u, _LEAST_SLOPE * theta[5])
        u -= (theta[5] * u + end - force) / slope
    return u, stages(c, theta, f, last, u, held)[1]


#: Deviations stay within this many spreads; the bend n stays above its least value.
_FARTHEST, _LEAST_N = 3.0, 1.0
#: Largest change of z in one sample: what a reversal suddenly shows is taken in over some samples.
_LARGEST_STEP = 0.05


@dataclass(frozen=True)
class Memory:
    """What is kept between samples: z (7), the factors of P, signals and their lags.

    `factors` are 7 columns: what U has above its diagonal of ones, and D, of P = U D U'.
    `u` [V], `f` [N] and `sigma` (5) at the last sample; `nu` [V], `phi` [N], `psi` (5) behind the
    lag.
    """

    z: list[Expression]
    factors: list[list[Expression]]
    u: Expression
    f: Expression
    sigma: list[Expression]
    nu: Expression
    phi: Expression
    psi: list[Expression]


def stepped(
    c: Constants, theta: Sequence[Expression], m: Memory, u: Expression
) -> tuple[Expression, list[Expression], Expression]:
    """Return f and sigma after the voltage has gone from `m.u` to u in one period, and u'."""
    du, swept, held, rate = swept_over(c, m.u, u)
    first, last, _ = stages(c, theta, m.f, m.u, u)
    _, slope, by = slopes(c, theta, first, du, swept, held)
    rises = [(slope * s + b) / (1.0 - IMPLICIT * slope) for s, b in zip(m.sigma, by, strict=True)]
    _, slope, by = slopes(c, theta, last, du, swept, held)
    sigma = [
        (s + (1.0 - IMPLICIT) * r + IMPLICIT * b) / (1.0 - IMPLICIT * slope)
        for s, r, b in zip(m.sigma, rises, by, strict=True)
    ]
    return last, sigma, rate


def advance(c: Constants, m: Memory, u: Expression, x: Expression) -> Memory:
    """Return the memory after a sample of voltage u [V] and displacement x [m]."""
    theta = estimates(c, m.z)
    f, sigma, rate = stepped(c, theta, m, u)
    nu = c.keep * m.nu + c.old * m.u + c.new * u
    phi = c.keep * m.phi + c.old * m.f + c.new * f
    psi = [
        c.keep * was + c.old * before + c.new * now
        for was, before, now in zip(m.psi, m.sigma, sigma, strict=True)
    ]
    d = [s * v for s, v in zip(c.spread, (*psi, nu, 1.0), strict=True)]
    error = c.stiffness * x - (theta[5] * nu + phi + theta[6])
    gate = rate * rate > c.standstill_rate * c.standstill_rate
    z, factors = correct(c, m, d, error, gate)
    moved = [s * (b - a) for s, a, b in zip(c.spread, m.z, z, strict=True)]
    f = f + sum(s * v for s, v in zip(sigma, moved, strict=False))
    phi = phi + sum(s * v for s, v in zip(psi, moved, strict=False))
    return Memory(z, factors, u, f, sigma, nu, phi, psi)


def correct(
    c: Constants, m: Memory, d: Sequence[Expression], error: Expression, gate: Expression
) -> tuple[list[Expression], list[list[Expression]]]:
    """Return z and the factors of P after an error [N] with regressors d, where `gate` is 1, not 0.

    Bierman's update: the factors keep P positive and its small directions, which the difference of
    the covariances would lose, in single precision within a second.
    """
    variance = c.noise_square
    g: list[Expression] = []
    new: list[list[Expression]] = []
    for j, (*above, diagonal) in enumerate(m.factors):
        f = gate * (sum((u * b for u, b in zip(above, d, strict=False)), d[j]))
        v, before = diagonal * f, variance
        variance += f * v
        new.append(
            [
                *(u - f / before * k for u, k in zip(above, g, strict=True)),
                diagonal * (before / variance),
            ]
        )
        g = [*(k + u * v for k, u in zip(g, above, strict=True)), v]
    step = error / variance
    size = ca.fabs(step) * ca.sqrt(sum(b * b for b in g))
    step = step * _LARGEST_STEP / ca.fmax(size, _LARGEST_STEP)
    z = bounded(c, [a + step * b for a, b in zip(m.z, g, strict=True)])
    stretch = [ca.sqrt(1.0 + gate * c.forget * (1.0 - p)) for p in variances(new)]
    return z, [
        [*(u * stretch[i] / stretch[j] for i, u in enumerate(above)), diagonal * stretch[j] ** 2]
        for j, (*above, diagonal) in enumerate(new)
    ]


def variances(factors: Sequence[Sequence[Expression]]) -> list[Expression]:
    """Return the diagonal of P from its factors."""
    return [
        column[-1] + sum(factors[j][i] ** 2 * factors[j][-1] for j in range(i + 1, len(factors)))
        for i, column in enumerate(factors)
    ]


def bounded(c: Constants, z: Sequence[Expression]) -> list[Expression]:
    """Return z within its bounds: n >= 1; beta, beta +- gamma a tenth of their starts or more.

    Beyond, the force of eq. (8) would grow without bound.
    """
    z = [ca.fmax(ca.fmin(v, _FARTHEST), -_FARTHEST) for v in z]
    z[4] = ca.fmax(z[4], (_LEAST_N - c.start[4]) / c.spread[4])
    z[1] = ca.fmax(z[1], -0.9 * c.start[1] / c.spread[1])
    beta, gamma = c.start[1] + c.spread[1] * z[1], c.start[2]
    least, apart = c.start[1] + gamma, c.start[1] - gamma
    z[2] = ca.fmax(z[2], (ca.fmin(0.1 * least, 2.0 * least) - beta - gamma) / c.spread[2])
    z[2] = ca.fmin(z[2], (beta - 0.1 * apart - gamma) / c.spread[2])
    return z


def stroke(p: Values) -> float:
    """Return the displacement at the rated voltage, without hysteresis [m]."""
    return abs(p["k_L"]) * p["u_rated"] / p["stiffness"]


_ESTIMATES = tuple(
    Output(f"{name}_hat", unit, f"estimate of {name}", 1.0 if unit != "N" else hysteresis_scale)
    for name, unit in TRACKED.items()
)
_FORCE = Output("hysteresis_force", "N", "estimated hysteresis force", hysteresis_scale)
_CORRECTION = Output("correction", "V", "voltage to add so that the stack is linear", voltage_scale)
_VOLTAGE_IN = Input("voltage", "V", "voltage at the stack", nominal=voltage_scale)
_POSITION = Input("position", "m", "measured displacement", 0.0, stroke, "um")
_UNITS = {"A": "V", "beta": "V", "gamma": "V", "delta": "V.s", "n": "N"}
_MEANING = "of the covariance U D U' of the deviations"
_LAST = (
    State("u_last", "V", "voltage at the last instant", voltage_scale),
    State("f_H", "N", "estimated hysteresis force", hysteresis_scale),
)
#: What the block keeps between instants, in the order of `flattened`.
SAMPLED = (
    *(State(f"z_{n}", "1", f"deviation of {n} from its start, in spreads", 1.0) for n in TRACKED),
    *(
        State(f"D_{j + 1}", "1", f"variance {_MEANING}", 1.0, start=1.0)
        if i == j
        else State(f"U_{i + 1}_{j + 1}", "1", f"factor {_MEANING}", 1.0)
        for j in range(COUNT)
        for i in range(j + 1)
    ),
    *_LAST,
    *(State(f"s_{n}", unit, f"derivative of f_H by {n}", 1.0) for n, unit in _UNITS.items()),
    State("u_lag", "V", "voltage behind the lag", voltage_scale),
    State("f_lag", "N", "estimated hysteresis force behind the lag", hysteresis_scale),
    *(State(f"l_{n}", unit, f"s_{n} behind the lag", 1.0) for n, unit in _UNITS.items()),
)


def flattened(m: Memory) -> list[Expression]:
    """Return the memory as a list, in the order of the sampled states."""
    factors = [value for column in m.factors for value in column]
    return [*m.z, *factors, m.u, m.f, *m.sigma, m.nu, m.phi, *m.psi]


def _memory(s: Symbols) -> Memory:
    """Return the memory that the sampled states hold, the inverse of `flattened`."""
    left = iter([getattr(s, state.name) for state in SAMPLED])
    z = list(islice(left, COUNT))
    factors = [list(islice(left, j + 1)) for j in range(COUNT)]
    u, f, sigma = next(left), next(left), list(islice(left, SHAPES))
    return Memory(z, factors, u, f, sigma, next(left), next(left), list(islice(left, SHAPES)))


def _learnt(
    s: Symbols, c: Constants, voltage: Expression
) -> tuple[Memory, Memory, Equations, dict[str, Expression]]:
    """Return the memory now and after a sample, the equations of that, and the estimates now."""
    now = _memory(s)
    after = advance(c, now, voltage, s.position)
    estimated = dict(zip(TRACKED, estimates(c, now.z), strict=True))
    following = dict(zip((state.name for state in SAMPLED), flattened(after), strict=True))
    out = {f"{name}_hat": value for name, value in estimated.items()} | {"hysteresis_force": now.f}
    return now, after, Equations(next=following, out=out), estimated


_PARAMETERS = (
    Parameter("k_L", 10.0, "N/V", (1e-6, 1e6), "start of the linear force per volt", log=True),
    Parameter("A", -2.5, "N/V", (-1e5, 1e5), "start of the slope of the hysteresis force"),
    Parameter("beta", 2.5, "N/V", (-1e5, 1e5), "start of the dissipative bend"),
    Parameter("gamma", 0.4, "N/V", (-1e5, 1e5), "start of the elastic bend; below beta"),
    Parameter("delta", 0.0, "N/(V.s)", (-1e5, 1e5), "start of the asymmetry"),
    Parameter("n", 1.5, "1", (1.0, 4.0), "start of the sharpness of the bend"),
    Parameter("h_ref", 100.0, "N", (1e-9, 1e7), "reference force of the bend; not tracked"),
    Parameter("hold_rate", 0.1, "V/s", (1e-9, 1e6), "rate below which the voltage counts as held"),
    Parameter("u_rated", 150.0, "V", (1e-3, 1e5), "rated voltage span, sets nominal sizes"),
    Parameter("stiffness", 5e7, "N/m", (1.0, 1e12), "force per displacement of the stack at rest"),
    Parameter(
        "lag", 1e-4, "s", (1e-9, 10.0), "from voltage to displacement: first moment", "ms", log=True
    ),
    Parameter("period", 1e-4, "s", (1e-7, 10.0), "sample period", "ms", log=True),
    Parameter("memory", 1.0, "s", (1e-6, 1e9), "time over which what was learnt is forgotten"),
    Parameter(
        "standstill_rate", 1.0, "V/s", (0.0, 1e9), "voltage rate below which nothing is learnt"
    ),
    Parameter(
        "noise", 3e-8, "m", (1e-15, 1.0), "rms error of the displacement and the model", "nm"
    ),
    Parameter("spread", 0.3, "1", (1e-6, 10.0), "how far the starts may be off, as a share"),
)

_block = partial(component, belongs_to="drive", sample_period="period")


@_block(
    *_PARAMETERS,
    _VOLTAGE_IN,
    _POSITION,
    *_ESTIMATES,
    _FORCE,
    _CORRECTION,
    Output("prediction_error", "m", "measured minus predicted displacement", stroke, "um"),
    description="recursive least squares of the hysteresis parameters, one sample in, one out",
    source="Yang and Zhu 2015, eq. 38; Ljung and Soderstrom 1983, chapter 3",
    equation_text=(
        "e = K x - (k_L u_lag + f_lag + offset);  z+ = z + P d e/(noise^2 + d'P d);"
        "  P+ = S (P - P d d'P/(noise^2 + d'P d)) S;  d: derivatives of the prediction"
    ),
    sampled=SAMPLED,
)
def online_identification(s: Symbols) -> Equations:
    """Recursive least squares of the hysteresis parameters, one sample in, one out."""
    c = _constants(s, _PARAMETERS)
    now, _, learning, theta = _learnt(s, c, s.voltage)
    predicted = (theta["k_L"] * now.nu + now.phi + theta["offset"]) / c.stiffness
    more = {"correction": -now.f / theta["k_L"], "prediction_error": s.position - predicted}
    return replace(learning, out={**learning.out, **more})


_LEARNING = ("lag", "memory", "standstill_rate", "noise", "spread")
_OBSERVING = tuple(
    replace(p, description=p.description.removeprefix("start of the "))
    for p in online_identification.parameters
    if p.name not in _LEARNING
)
_VOLTAGE = Output("voltage", "V", "voltage at which the stack is where it is wanted", voltage_scale)
_WANTED = Input("wanted", "m", "displacement that is wanted", 0.0, stroke, "um")
_WANTED_LAST = State(
    "wanted_last", "m", "wanted displacement of the last instant", stroke, 0.0, "um"
)
_PAPER = "Yang and Zhu 2015, section 5.1:"


def _constants(s: Symbols, parameters: tuple[Parameter, ...]) -> Constants:
    """Return the constants; what learning needs has its default where a block does not learn."""
    default: dict[str, Expression] = {p.name: p.value for p in online_identification.parameters}
    return constants(default | {p.name: getattr(s, p.name) for p in parameters})


def _next_voltage(
    c: Constants, s: Symbols, theta: list[Expression], force: Expression, last: Expression
) -> tuple[Expression, Expression]:
    """Return voltage and force at the next instant, from the force and the voltage at the last."""
    guess = last + (s.wanted - s.wanted_last) * s.stiffness / s.k_L
    return linearising_voltage(c, theta, force, last, guess, s.stiffness * s.wanted)


@_block(
    *_OBSERVING,
    _VOLTAGE_IN,
    _FORCE,
    _CORRECTION,
    description="observer of the hysteresis force on the known voltage, one sample in, one out",
    source=f"{_PAPER} observer (37)",
    equation_text="f_H+ = f_H by (8) along the line from u- to u",
    sampled=_LAST,
)
def hysteresis_observer(s: Symbols) -> Equations:
    """Observer of the hysteresis force on the known voltage, one sample in, one out."""
    c = _constants(s, _OBSERVING)
    force = force_after(c, c.start, s.f_H, s.u_last, s.voltage)
    return Equations(
        next={"u_last": s.voltage, "f_H": force},
        out={"hysteresis_force": s.f_H, "correction": -s.f_H / s.k_L},
    )


@_block(
    *_OBSERVING,
    _WANTED,
    _VOLTAGE,
    _FORCE,
    description="voltage for a wanted displacement of a stack, its hysteresis taken off, sampled",
    source=f"{_PAPER} observer (37), compensation (39) to (41)",
    equation_text="k_L u + f_H(u) = K w for u;  f_H(u) by (8) along the line from u-",
    sampled=(*_LAST, _WANTED_LAST),
)
def feed_forward(s: Symbols) -> Equations:
    """Voltage for a wanted displacement of a stack, its hysteresis taken off, sampled."""
    c = _constants(s, _OBSERVING)
    u, force = _next_voltage(c, s, list(c.start), s.f_H, s.u_last)
    return Equations(
        next={"u_last": u, "f_H": force, "wanted_last": s.wanted},
        out={"voltage": s.u_last, "hysteresis_force": s.f_H},
    )


@_block(
    *online_identification.parameters,
    _WANTED,
    _POSITION,
    _VOLTAGE,
    *_ESTIMATES,
    _FORCE,
    description="feed-forward whose hysteresis parameters follow the measured displacement",
    source=f"{_PAPER} equations (37) to (41)",
    equation_text="as feed_forward, with A, beta, gamma, delta, n, k_L of online_identification",
    sampled=(
        *SAMPLED,
        State("applied", "V", "voltage that was returned last", voltage_scale),
        _WANTED_LAST,
    ),
)
def adaptive_feed_forward(s: Symbols) -> Equations:
    """The voltage that was returned last has been applied when the displacement is measured."""
    c = _constants(s, online_identification.parameters)
    _, after, learning, _ = _learnt(s, c, s.applied)
    u, _ = _next_voltage(c, s, estimates(c, after.z), after.f, after.u)
    return Equations(
        next={**learning.next, "applied": u, "wanted_last": s.wanted},
        out={"voltage": s.applied, **learning.out},
    )
