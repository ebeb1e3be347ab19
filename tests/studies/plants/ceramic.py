"""Hidden effects of the ceramic: creep, hysteresis, strain, heat and age."""

import math
from collections.abc import Callable

import numpy as np
from scipy.signal import fftconvolve, lfilter

from tests.studies.plants.base import Run, hysteresis_force
from tests.studies.plants.effect import Draw, Parameters, hidden, pushed
from tests.studies.plants.stack import FloatArray

Branch = Callable[[FloatArray], FloatArray]
Places = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


def turning_points(voltage: FloatArray) -> Places:
    """Positions of the reversals with the first and the last sample."""
    direction = np.sign(np.diff(voltage))
    moving = np.flatnonzero(direction)
    turns = moving[1:][direction[moving[1:]] != direction[moving[:-1]]]
    return np.concatenate(([0], turns, [voltage.size - 1])).astype(np.intp)


def since_reversal(voltage: FloatArray) -> FloatArray:
    """Distance from the last reversal, (M,) [V], at least 0."""
    turns = turning_points(voltage)
    last = np.searchsorted(turns[1:-1], np.arange(voltage.size), side="left")
    return np.abs(voltage - voltage[turns[:-1]][last])


def with_memory(voltage: FloatArray, branch: Branch) -> FloatArray:
    """Hysteresis with complete memory of its reversals.

    A Preisach operator of a density that depends on the difference of the two thresholds
    alone.

        R = R_r + d G(|u - u_r|),  d = sgn(u'),  (u_r, R_r) the last reversal not wiped out

    A branch that passes the reversal before the last closes its loop there and wipes both
    out (Madelung's rules). Equal spans give equal loops (congruence), so the branches meet
    exactly. Source: I. D. Mayergoyz, "Mathematical Models of Hysteresis", ch. 1.

    R along a voltage, (M,); `branch` is G, with G(0) = 0. R = 0 at the lowest voltage.
    """
    bottom = float(voltage.min())
    memory = [(bottom, 0.0)]
    state = float(branch(np.array([voltage[0] - bottom]))[0])
    out = np.full(voltage.size, state)
    turns = turning_points(voltage)
    for first, last in zip(turns[:-1].tolist(), turns[1:].tolist(), strict=True):
        piece = voltage[first : last + 1]
        sign = 1.0 if piece[-1] >= piece[0] else -1.0
        if len(memory) > 1 or sign < 0.0:
            memory.append((float(piece[0]), state))
        out[first : last + 1] = _piece(memory, piece, sign, branch)
        state = float(out[last])
    return out


def _piece(
    memory: list[tuple[float, float]], piece: FloatArray, sign: float, branch: Branch
) -> FloatArray:
    """One monotone piece; closes the loops that it passes."""
    start, level = memory[-1]
    out = level + sign * branch(np.abs(piece - start))
    while len(memory) > 2 and sign * (float(piece[-1]) - memory[-2][0]) > 0.0:
        passed = memory[-2][0]
        del memory[-2:]
        start, level = memory[-1]
        beyond = sign * (piece - passed) > 0.0
        out[beyond] = level + sign * branch(np.abs(piece[beyond] - start))
    return np.asarray(out, dtype=np.float64)


@hidden("g", "1", (0.003, 0.05), linear=True, drawn=lambda d: {"t_0": d.uniform(0.05, 0.1)})
def slow_creep(run: Run, p: Parameters, gain: float) -> FloatArray:
    """True logarithmic creep, superposed over the whole history of the elongation.

        x_creep(t) = g sum_j Dx(t_j) lg(1 + (t - t_j)/t_0)

    Dx(t_j): increments of the base displacement; g: creep for each decade of time; t_0:
    time at which creep starts. Source: H. Jung and D.-G. Gweon, "Creep characteristics of
    piezoelectric actuators", Rev. Sci. Instrum. 71 (2000) 1896 (logarithmic law);
    superposition over the voltage history after L. Boltzmann. Not the project's form: a sum
    of relaxations is a set of exponentials with a last time constant, after which it stops;
    the logarithm is a continuous spectrum and never stops.
    """
    step = float(run.times[1] - run.times[0])
    age = step * (np.arange(run.times.size - 1) + 0.5)  # in the middle of each interval
    kernel = np.log10(1.0 + age / p["t_0"])
    crept = fftconvolve(np.diff(run.displacement), kernel)[: run.times.size - 1]
    return np.asarray(gain * np.concatenate(([0.0], crept)))


def play(voltage: FloatArray, threshold: float, start: float = 0.0) -> FloatArray:
    """Play operator, (M,) [V]: recursion at the turning points only, a clip between them."""
    bounds = turning_points(voltage)
    out = np.empty_like(voltage)
    state = float(min(max(start, voltage[0] - threshold), voltage[0] + threshold))
    for first, last in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        piece = voltage[first : last + 1]
        out[first : last + 1] = np.minimum(np.maximum(state, piece - threshold), piece + threshold)
        state = float(out[last])
    return out


def moving_play(voltage: FloatArray, threshold: FloatArray) -> FloatArray:
    """Play operator whose threshold (M,) [V] changes on the way, from the relaxed state."""
    state, out = float(voltage[0]), []
    low, high = (voltage - threshold).tolist(), (voltage + threshold).tolist()
    for least, most in zip(low, high, strict=True):
        if state < least:
            state = least
        elif state > most:
            state = most
        out.append(state)
    return np.asarray(out)


#: Plays of the two kinds of memory, and of the one that depends on the rate.
_MEMORY, _GROWING = 5, 3


def _plays(
    d: Draw, count: int, highest: float, more: Callable[[], dict[str, float]] = dict
) -> dict[str, float]:
    """Thresholds r_j [V] at random in equal bins from 4 % of the span on, weights w_j of sum 1."""
    edges = np.linspace(0.04, highest, count + 1) * d.run.stack.u_rated
    weights = d.rng.uniform(0.5, 1.5, count)
    weights /= weights.sum()
    values = more()
    for j in range(count):
        values[f"r_{j}"] = d.uniform(edges[j], edges[j + 1])
        values[f"w_{j}"] = float(weights[j])
    return values


def _growing_plays(d: Draw) -> dict[str, float]:
    """Rate q [V/s] where growth starts, share W of the force that plays, and the plays."""
    span = d.run.stack.u_rated
    return _plays(
        d, _GROWING, 0.25, lambda: {"q": d.uniform(0.3, 1.5) * span, "share": d.uniform(0.25, 0.45)}
    )


@hidden("g", "1", (0.01, 0.6), drawn=_growing_plays)
def rate_dependent_hysteresis(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Loops that widen with the rate.

    Play operators whose thresholds grow with the logarithm of it.

        p_j = max(u - R_j, min(u + R_j, p_j before)),   R_j = r_j (1 + g lg(1 + |u'|/q))
        F = W k_L sum_j w_j (p_j with g - p_j with g = 0),   sum_j w_j = 1

    u: voltage on the stack. Because p follows u at a distance, stroke falls as width grows.
    Source: M. Al Janaideh, C.-Y. Su and S. Rakheja, "Development of the rate-dependent
    Prandtl-Ishlinskii model for smart actuators", Smart Mater. Struct. 17 (2008) 035026
    (logarithmic dynamic threshold). Not the project's form: thresholds of hard operators,
    neither a lag before the hysteresis nor rates in the coefficients of Bouc and Wen.

    g is growth of the loop's width for each decade of rate; 3 to 10 % of stroke has been
    measured.
    """
    voltage = run.path.path_voltage
    command = np.interp(run.path.path_time, run.path.time, run.fine_command)
    rate = (command - voltage) / run.stack.drive_time  # 0 at every reversal
    wider = 1.0 + gain * np.log10(1.0 + np.abs(rate) / p["q"])
    total = np.zeros_like(voltage)
    for j in range(_GROWING):
        change = moving_play(voltage, p[f"r_{j}"] * wider) - play(voltage, p[f"r_{j}"])
        total += p[f"w_{j}"] * change
    return pushed(run, p["share"] * run.stack.k_l * total[run.path.node])


def _memory_draw(d: Draw) -> dict[str, float]:
    return _plays(d, _MEMORY, 0.18)


@hidden("g", "1", (0.01, 0.6), linear=True, drawn=_memory_draw)
def hysteresis_memory(run: Run, p: Parameters, gain: float) -> FloatArray:
    """More memory than one Bouc-Wen state can hold: parallel play operators.

        p_j(t) = max(u - r_j, min(u + r_j, p_j before))
        F = g k_L sum_j w_j (p_j - u),   sum_j w_j = 1

    u: voltage on the stack; r_j: thresholds spread over 4 to 18 % of the span; the force
    goes through lag and mechanics. Source: K. Kuhnen, "Modeling, identification and
    compensation of complex hysteretic nonlinearities", Eur. J. Control 9 (2003) 407. Not
    the project's form: the operators are hard (a corner at each threshold, wiped out
    exactly by larger reversals), not smooth stop elements of Bouc-Wen type, and there are
    more of them than one would fit.
    """
    path = run.path.path_voltage
    total = np.zeros_like(path)
    for j in range(_MEMORY):
        total += p[f"w_{j}"] * (play(path, p[f"r_{j}"]) - path)
    return pushed(run, gain * run.stack.k_l * total[run.path.node])


@hidden(
    "g", "1", (0.01, 0.6), linear=True, called="hysteresis_memory",
    drawn=lambda d: {**_memory_draw(d), "b": d.uniform(0.7, 2.0)},
)  # fmt: skip
def asymmetric_memory(run: Run, p: Parameters, gain: float) -> FloatArray:
    """More memory, asymmetric: a generalised Prandtl-Ishlinskii loop, plays with their
    squares.

        F = g k_L sum_j w_j (p_j - u + b (p_j^2 - u^2)/u_rated),   sum_j w_j = 1

    p_j: play operators of the voltage u with thresholds over 4 to 18 % of the span
    (hysteresis_memory.py). Rising and falling branches differ more the higher the voltage,
    so that no symmetric memory forms the loop. Not the project's form: hard operators, and
    every one of them has a separate envelope. Source: M. Al Janaideh, S. Rakheja, C.-Y.
    Su, "An analytical generalized Prandtl-Ishlinskii model inversion for hysteresis
    compensation in micropositioning control", IEEE/ASME Trans. Mechatronics 16 (2011) 734:
    envelope functions of the play; here 1 + b u.
    """
    path, span = run.path.path_voltage, run.stack.u_rated
    total = np.zeros_like(path)
    for j in range(_MEMORY):
        y = play(path, p[f"r_{j}"])
        total += p[f"w_{j}"] * (y - path + p["b"] * (y**2 - path**2) / span)
    return pushed(run, gain * run.stack.k_l * total[run.path.node])


@hidden("g", "1", (0.01, 0.8), drawn=lambda d: {"branch": d.sign()})
def rate_independent_asymmetry(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Ascending and descending branches that curve differently, equally at every rate.

        df_H = A du - r^n (beta sgn(f_H) |du| + gamma du + g beta |du|) + delta u sgn(u') dt

    The last loss, g beta r^n |du|, has one sign on both branches: domains that switch while
    the voltage rises are lost at another rate than those that switch back, so the two
    envelopes lie at different distances and are approached with different curvature. No
    time enters, so the shape is the same at every rate. Source: J. Song and A. Der
    Kiureghian, "Generalized Bouc-Wen model for highly asymmetric hysteresis", J. Eng. Mech.
    132 (2006) 610 (their term beta_4 sgn(x')). Not the project's form: it depends on the
    state of the hysteresis and not on the voltage, as `delta_r u |u'|` does.
    """
    stack = run.stack
    force = hysteresis_force(stack, run.path, gain * p["branch"] * stack.beta)
    return pushed(run, force + stack.k_l * run.path.voltage - run.force)


@hidden(
    "g", "1", (1e-3, 0.4), linear=True,
    drawn=lambda d: {"p": d.uniform(0.7, 1.5), "w": d.uniform(0.2, 0.5)},
)  # fmt: skip
def field_dependent_gain(run: Run, p: Parameters, gain: float) -> FloatArray:
    """A force for each volt that grows with the field: reversible growth and Rayleigh loops.

        F = g k_L u_r [ (1 - w) (u/u_r)^(1 + p) + w R(u)/u_r^2 ]
        dR = |u - u_last reversal| du   (closed loops are wiped out, memory.py)

    u_r: rated voltage. Of the growth a share w comes from domain walls that move
    irreversibly: then the gain grows with the amplitude and the loop with its square.
    Source: D. Damjanovic, "Ferroelectric, dielectric and piezoelectric properties of
    ferroelectric thin films and ceramics", Rep. Prog. Phys. 61 (1998) 1267, Rayleigh law.
    Not the project's form: the power is not 2 and part of the growth depends on the last
    reversal, not on the voltage.
    """
    span, w = run.stack.u_rated, p["w"]
    u = run.path.voltage / span
    reversible = np.sign(u) * np.abs(u) ** (1.0 + p["p"])
    half_squares = with_memory(run.path.path_voltage, lambda distance: 0.5 * distance**2)
    irreversible = half_squares[run.path.node] / span**2
    return pushed(run, gain * run.stack.k_l * span * ((1.0 - w) * reversible + w * irreversible))


def bent(u: FloatArray, p: float) -> FloatArray:
    """u / (1 + |u|^p)^(1/p): slope 1 at zero, limit 1."""
    return np.asarray(u / (1.0 + np.abs(u) ** p) ** (1.0 / p), dtype=np.float64)


@hidden("g", "1", (0.05, 1.0), drawn=lambda d: {"p": d.uniform(1.8, 4.0)})
def saturation_of_strain(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Strain that saturates once most domains are turned: the linear force bends over.

        f_L = k_L u / (1 + |g u/u_r|^p)^(1/p)

    u_r: rated voltage; u_r/g: voltage at which the tangent at zero would reach saturation.
    Source: the Froehlich-Kennelly law of saturation, A. E. Kennelly, Trans. AIEE 8 (1891)
    485, for polarisation instead of magnetisation. Not the project's form: neither a
    polynomial nor tanh.
    """
    scale, u = run.stack.u_rated / gain, run.path.voltage
    return pushed(run, run.stack.k_l * (scale * bent(u / scale, p["p"]) - u))


def heat(voltage: FloatArray, q: float) -> FloatArray:
    """Heat since the start, (M,) [V^q]: the sum over all swings of D^q/q, exact on each step."""
    released = since_reversal(voltage) ** q / q
    steps = np.diff(released)
    turns = turning_points(voltage)[1:-1]
    steps[turns] = released[turns + 1]
    return np.concatenate(([0.0], np.cumsum(steps)))


def _heating(d: Draw) -> dict[str, float]:
    """Thermal time constant [s], 0.1-0.5 of the record's length; power q of the loss."""
    return {"tau": d.uniform(0.1, 0.5) * d.length, "q": d.uniform(2.2, 3.2)}


@hidden("g", "1", (1e-4, 0.15), linear=True, drawn=_heating)
def self_heating(run: Run, p: Parameters, gain: float) -> FloatArray:
    """A gain that climbs with the heat of the hysteresis loops.

        P = |u - u_last reversal|^(q - 1) |u'|           (a swing of D gives the heat D^q/q)
        tau T' + T = P/mean(P),    x -> x (1 + g T)

    The energy lost in a cycle grows with a power of its amplitude (q = 3 for Rayleigh
    loops), so it is counted along each half cycle. Temperature in units of what the
    record's mean loss would reach; exact exponential steps for a loss that is constant on
    each sub-interval. Source: S. Li, W. Cao and L. E. Cross, "The extrinsic nature of
    nonlinear behavior observed in lead zirconate titanate ferroelectric ceramic", J. Appl.
    Phys. 69 (1991) 7219; heating: K. Uchino and S. Hirose, IEEE Trans. UFFC 48 (2001) 307.
    Not the project's form: the loss comes from the history of reversals, not from current
    and voltage at one instant.

    Gain times temperature: 0.1-0.5 % for each kelvin over at most 30 K.
    """
    energy = heat(run.path.path_voltage, p["q"])[run.path.node]
    mean = float(energy[-1]) / float(run.times[-1] - run.times[0])
    if mean == 0.0:
        return np.zeros_like(run.times)
    decay = math.exp(-run.fine_step / p["tau"])
    power = np.diff(energy / mean) / run.fine_step
    warm = np.concatenate(([0.0], lfilter([1.0 - decay], [1.0, -decay], power)))
    return np.asarray(gain * warm[:: run.sub_intervals] * run.displacement)


@hidden(
    "g", "1", (1e-4, 0.1), linear=True,
    drawn=lambda d: {"n_0": float(np.exp(d.rng.uniform(np.log(0.3), np.log(3.0))))},
)  # fmt: skip
def ageing(run: Run, p: Parameters, gain: float) -> FloatArray:
    """A stack that loses polarisation with the cycles it has made.

        x -> x (1 - g lg(1 + N/N_0)),   N = integral |du|/(2 u_r)

    N: cycles at rated voltage u_r that equal the travel; g: loss for each decade.
    Source: D. A. Hall and M. M. Ben-Omran, "Ageing of high field dielectric properties in
    BaTiO3-based piezoceramics", J. Phys.: Condens. Matter 10 (1998) 9129 (logarithmic law,
    there in time). Not the project's form: the clock is the travel of the voltage.
    """
    travel = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(run.path.path_voltage)))))
    cycles = (travel / (2.0 * run.stack.u_rated))[run.path.node][:: run.sub_intervals]
    return -gain * np.log10(1.0 + cycles / p["n_0"]) * run.displacement


@hidden(
    "g", "1", (1e-3, 0.5), linear=True, foreign=True,
    drawn=lambda d: {"dead_zone": d.uniform(0.35, 0.55) * d.run.stack.u_rated},
)  # fmt: skip
def dead_zone_hysteresis(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Foreign: hysteresis of the force only where a swing is larger than a threshold.

        R = R_r + d max(0, |u - u_r| - D)^2/2,   d = sgn(u'),  (u_r, R_r) the last reversal
        F = g k_L u_rated R/R(rated swing)

    A Preisach operator whose density is zero where the two switching voltages differ by
    less than D and uniform beyond (memory.py): small loops have none, large ones grow with
    the square. Source: I. D. Mayergoyz, "Mathematical Models of Hysteresis", ch. 1.

    g is its size over the linear force after a rated swing.
    """
    span, dead_zone = run.stack.u_rated, p["dead_zone"]
    beyond = lambda swing: 0.5 * np.maximum(0.0, swing - dead_zone) ** 2  # noqa: E731
    operator = with_memory(run.path.path_voltage, beyond)[run.path.node]
    return pushed(run, gain * run.stack.k_l * span * operator / (0.5 * (span - dead_zone) ** 2))
