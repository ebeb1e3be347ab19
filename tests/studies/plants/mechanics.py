"""Hidden effects of the mechanics: masses, springs, contacts, friction, and what shakes them."""

import math

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from tests.studies.plants.base import Run, first_order
from tests.studies.plants.ceramic import play
from tests.studies.plants.effect import Draw, Parameters, hidden
from tests.studies.plants.stack import FloatArray


def _mode(d: Draw) -> dict[str, float]:
    """A frequency in the band of the record (25 Hz to 0.2 of the sampling rate), damping 1-5 %."""
    rate = 1.0 / float(d.run.times[1] - d.run.times[0])
    low, high = math.log(min(25.0, 0.1 * rate)), math.log(0.2 * rate)
    return {"frequency": math.exp(d.uniform(low, high)), "zeta": d.uniform(0.01, 0.05)}


@hidden("g", "1", (3e-4, 0.1), linear=True, drawn=_mode)
def structural_mode(run: Run, p: Parameters, gain: float) -> FloatArray:
    """A mode of the structure around the stack that the base does not have.

        x_mode = g integral of h(t - s) x_f(s) ds,   x_f = (f_L + f_H)(1/k_P + 1/k_B)
        h(t) = w^2/w_d exp(-zeta w t) sin(w_d t)

    by modal superposition: one complex pole p = -zeta w + i w_d on the fine grid, x_mode =
    g w^2/w_d Im z, z' = p z + x_f. Source: modal superposition, e.g. D. J. Ewins, "Modal
    Testing". Not the project's form: a convolution parallel to the stack driven by the force
    before the lag, not two more states driven by the displacement.

    g is the mode's static share of the displacement.
    """
    omega, zeta = 2.0 * math.pi * p["frequency"], p["zeta"]
    damped = omega * math.sqrt(1.0 - zeta**2)
    drive = run.force * run.stack.compliance
    modal = first_order(complex(-zeta * omega, damped), drive, run.fine_step).imag
    return gain * omega**2 / damped * modal[:: run.sub_intervals]


def balance(free: FloatArray, length: float, stiffness: float) -> FloatArray:
    """x that solves x + g L sinh(x/L) = free, (N,) [m].

    Newton starts beyond the solution, where the left side is convex, so it converges from there.
    """
    z = free / length
    x = np.sign(z) * np.minimum(np.abs(z), np.arcsinh(np.abs(z) / stiffness))
    for _ in range(20):
        x = x - (x + stiffness * np.sinh(x) - z) / (1.0 + stiffness * np.cosh(x))
    return np.asarray(length * x, dtype=np.float64)


@hidden("g", "1", (3e-4, 0.2), drawn=lambda d: {"length": d.uniform(0.3, 0.6) * d.span})
def load_stiffness(run: Run, p: Parameters, gain: float) -> FloatArray:
    """A spring against which the stack works, and which hardens.

        x + g L sinh(x/L) = x_free

    g: stiffness of the spring at rest over that of the stack; L: elongation over which it
    hardens. Solved statically by Newton's method, because every resonance lies above the
    record's band. Source: elastomer and membrane springs, exponential hardening after Y. C.
    Fung, "Biomechanics", ch. 7. Not the project's form: not a cubic, and an algebraic
    equation instead of a force in the balance.

    Up to a fifth of the stack's; a stiffer spring shortens the stroke so much that it bends
    less.
    """
    return balance(run.displacement, p["length"], gain) - run.displacement


@hidden("g", "1", (1e-3, 1.0), drawn=lambda d: {"x_0": d.place(0.3, 0.7), "side": d.sign()})
def preload_loss(run: Run, p: Parameters, gain: float) -> FloatArray:
    """A preload that is lost on one side of a position.

    Another stiffness beyond it, with a hard kink.

        x = x_free - F/k,   F/k = g max(0, s (x - x_0)) s,   s = 1 or -1
        so   x = x_free - s g/(1 + g) max(0, s (x_free - x_0))

    g: stiffness of what is in contact over that of the stack; s: the side on which it
    touches. Solved statically in closed form. Source: unilateral contact (Signorini), e.g.
    K. L. Johnson, "Contact Mechanics". Not the project's form: the corner is not smoothed,
    and the equation is algebraic.
    """
    place, side = p["x_0"], p["side"]
    reach = np.maximum(0.0, side * (run.displacement - place)) - max(0.0, -side * place)
    return np.asarray(-(side * (gain / (1.0 + gain)) * reach))


@hidden("g", "m", (1e-9, 3e-6))
def backlash(run: Run, _: Parameters, gain: float) -> FloatArray:
    """Lost motion of fixed width between the stack and the output.

        x_out = max(x - g, min(x + g, x_out before))

    A hard play operator in the displacement; g is half the gap. It dwells for 2 g after
    every reversal, whatever the amplitude. Source: any text on mechanisms; G. Tao and P. V.
    Kokotovic, "Adaptive Control of Systems with Actuator and Sensor Nonlinearities". Not
    the project's form: no smooth stop element in series.
    """
    return (play(run.fine_displacement, gain) - run.fine_displacement)[:: run.sub_intervals]


def friction(free: FloatArray, stiction: float, coulomb: float, kappa: float) -> FloatArray:
    """F/k [m] along the free displacement, (M,) [m]; F_s/k = stiction, F_c/k = coulomb [m]."""
    out: list[float] = []
    anchor, before, slipping = float(free[0]), float(free[0]), 0.0
    for value in free.tolist():
        move = value - before
        before = value
        if slipping != 0.0 and move * slipping < 0.0:
            anchor = value - move - slipping * coulomb * (1.0 + 1.0 / kappa)
            slipping = 0.0
        if slipping == 0.0:
            force = kappa * (value - anchor) / (1.0 + kappa)
            if abs(force) > stiction:
                slipping = 1.0 if force > 0.0 else -1.0
        out.append(slipping * coulomb if slipping != 0.0 else force)
    return np.asarray(out)


@hidden(
    "F_s/k", "m", (1e-9, 3e-6), foreign=True,
    drawn=lambda d: {"rho": d.uniform(1.6, 2.4), "kappa": d.uniform(3.0, 8.0)},
)  # fmt: skip
def dry_friction(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Foreign: stick-slip of the output against a guide.

        x = x_base - F/k
        stuck:  F/k = kappa (x - a)  until  |F| = F_s
        slips:  |F| = F_c = F_s/rho < F_s, against the motion, until the motion reverses
                (then it is stuck again, with a = x - F/(k kappa))

    Quasi-static, because every resonance lies above the record's band. kappa k is the
    pre-sliding stiffness. The force band in which the output sticks after each reversal is
    F_c + F_s wide, and each break-away is a jump of (F_s - F_c)/k: the stick-slip. Source:
    B. Armstrong-Helouvry, P. Dupont and C. Canudas de Wit, Automatica 30 (1994) 1083.
    """
    stride = max(1, run.sub_intervals // 8)
    lost = friction(run.fine_displacement[::stride], gain, gain / p["rho"], p["kappa"])
    return -lost[:: run.sub_intervals // stride]


def guided(free: FloatArray, centre: float, width: float, stiffness: float) -> FloatArray:
    """x that solves the equation, (N,) [m], by bisection: the spring moves x by at most 2 g w_s."""
    rest = np.tanh(-centre / width)
    low, high = free - 2.0 * stiffness * width, free + 2.0 * stiffness * width
    for _ in range(60):
        x = 0.5 * (low + high)
        over = x + stiffness * width * (np.tanh((x - centre) / width) - rest) > free
        low, high = np.where(over, low, x), np.where(over, x, high)
    return np.asarray(0.5 * (low + high), dtype=np.float64)


def _guide(d: Draw) -> dict[str, float]:
    """Centre x_c and width w_s [m], at 30-70 % and 6-12 % of the range moved."""
    return {"centre": d.place(0.3, 0.7), "width": d.uniform(0.06, 0.12) * d.span}


@hidden("g", "1", (1e-3, 1.0), foreign=True, drawn=_guide)
def guide_stiffness(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Foreign.

    A flexure guide that is stiff about one position and softer away from it on both sides.

        x + g (w_s tanh((x - x_c)/w_s) - w_s tanh((0 - x_c)/w_s)) = x_free

    Bilinear with a rounded corner: stiffness 1 + g within w_s of the centre x_c, 1 outside,
    equal on both sides, so not a contact. w_s is a small part of the range, too narrow for
    a low polynomial. Solved statically by bisection. Source: guides that are stiff before
    they slide, and buckled flexures, e.g. S. Henein, "Conception des guidages flexibles",
    ch. 4.

    g is the guide's stiffness over that of the stack.
    """
    return guided(run.displacement, p["centre"], p["width"], gain) - run.displacement


def _vibrations(d: Draw) -> dict[str, float]:
    """Frequencies, widths, relative size, and the seed of the random force."""
    return {
        "frequency_1": d.uniform(6.0, 11.0), "frequency_2": d.uniform(17.0, 31.0),
        "q_1": d.uniform(8.0, 20.0), "q_2": d.uniform(8.0, 20.0), "b": d.uniform(0.5, 1.0),
        "seed": d.seed(),
    }  # fmt: skip


@hidden("g", "m", (1e-9, 1e-6), linear=True, foreign=True, random=True, drawn=_vibrations)
def floor_vibration(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Foreign: two random narrow-band vibrations of the set-up, unrelated to the voltage.

        x_vib = g (n_1 + b n_2),   n_i = real part of z_i, scaled to unit rms
        z_i' = (-w_i/(2 Q_i) + i w_i) z_i + white noise

    Centre frequencies 6-11 Hz and 17-31 Hz, incommensurate, Q 8-20: bands, not lines, so
    neither mains hum nor drift. Source: floors and tables, e.g. C. G. Gordon, "Generic
    criteria for vibration-sensitive equipment", Proc. SPIE 1619 (1991).
    """
    rng = np.random.default_rng(int(p["seed"]))
    first = _band(rng, run.times, p["frequency_1"], p["q_1"])
    second = _band(rng, run.times, p["frequency_2"], p["q_2"])
    return gain * (first + p["b"] * second)


def _band(rng: np.random.Generator, times: FloatArray, frequency: float, q: float) -> FloatArray:
    omega = 2.0 * math.pi * frequency
    growth = np.exp(complex(-omega / (2.0 * q), omega) * float(times[1] - times[0]))
    warm_up = times.size
    noise = rng.standard_normal(times.size + warm_up)
    wave = np.asarray(lfilter([1.0], [1.0, -growth], noise.astype(np.complex128)))[warm_up:].real
    return np.asarray(wave / np.std(wave), dtype=np.float64)


_LINES = 12


def _stage(d: Draw) -> dict[str, float]:
    """Band [Hz], threshold r and share a of the play, seed of frequencies and phases."""
    return {
        "f_1": d.uniform(3.0, 6.0) / d.length, "f_2": d.uniform(15.0, 30.0) / d.length,
        "r": d.uniform(0.3, 0.8), "a": d.uniform(0.2, 0.5), "seed": d.seed(),
    }  # fmt: skip


@hidden("g", "m", (1e-9, 3e-6), linear=True, foreign=True, random=True, drawn=_stage)
def cross_axis(run: Run, p: Parameters, gain: float) -> FloatArray:
    """Foreign: the neighbouring axis of a stage moves too, and part of it is measured.

        x_cross = g (w - a (w - play(w, r))),   w: random-phase signal within a band, rms 1

    w has 12 random frequencies between f_1 and f_2 (0.4 to 4 Hz in a record of some
    seconds), unrelated to the voltage of this axis; the neighbour's hysteresis is a
    play operator. Source: crosstalk of parallel-kinematic stages, e.g. Y. K. Yong, S. O. R.
    Moheimani, B. J. Kenton and K. K. Leang, Rev. Sci. Instrum. 83 (2012) 121101.
    """
    rng = np.random.default_rng(int(p["seed"]))
    frequency = rng.uniform(p["f_1"], p["f_2"], _LINES)
    phase = rng.uniform(0.0, 2.0 * math.pi, _LINES)
    waves = np.sin(2.0 * math.pi * np.outer(frequency, run.times) + phase[:, None])
    w: FloatArray = waves.sum(axis=0) / math.sqrt(0.5 * _LINES)
    return gain * (w - p["a"] * (w - play(w, p["r"], float(w[0]))))


def two_masses(run: Run, load: FloatArray | None = None) -> FloatArray:
    """A stack of two masses with action and reaction, unlike the paper's one-way cascade.

        M z'' + C z' + K z = (f_out, f_load),   z = (y, x)
        M = diag(m_P, m_B),  C = [[c_P + c_B, -c_B], [-c_B, c_B]],  K likewise of k_P, k_B

    M, C and K are symmetric: that is Newton's third law for springs and dampers. The force
    behind the lag is that of the base (quasi-static hysteresis of the electrode voltage);
    lag and masses are solved by a matrix exponential, exact for a force that is linear on
    each sub-interval. Source: any text on vibration, e.g. L. Meirovitch, "Fundamentals of
    Vibrations", ch. 5. Not the project's form: no gain that blends two sets of equations,
    matrices instead of balances.

    Displacement x at the samples, (N,) [m], for the force of a run of the base; load: force
    on the output mass at the samples, (N,) [N], linear in between.
    """
    s = run.stack
    mass = np.diag([s.m_p, s.m_b])
    damping, stiffness = (
        np.array([[p + b, -b], [-b, b]]) for p, b in ((s.c_p, s.c_b), (s.k_p, s.k_b))
    )
    a = np.zeros((5, 5))
    a[:2, 2:4] = np.eye(2)
    a[2:4, :2] = -np.linalg.solve(mass, stiffness)
    a[2:4, 2:4] = -np.linalg.solve(mass, damping)
    a[2, 4] = 1.0 / s.m_p
    a[4, 4] = -1.0 / s.tau
    b = np.zeros((5, 2))
    b[4, 0], b[3, 1] = 1.0 / s.tau, 1.0 / s.m_b
    pushed = np.zeros_like(run.times) if load is None else load
    fine = np.interp(np.arange(run.force.size) / run.sub_intervals, np.arange(pushed.size), pushed)
    x = linear_response(a, b, np.column_stack([run.force, fine]), run.fine_step)[:, 1]
    return x[:: run.sub_intervals]


def linear_response(a: FloatArray, b: FloatArray, u: FloatArray, step: float) -> FloatArray:
    """Solve z' = a z + b u from rest, (M, n), exactly for inputs (M, k) linear on each step.

    One exponential of [[a, b, 0], [0, 0, 1/h], [0, 0, 0]] gives growth and both weights.
    """
    n, k = b.shape
    block = np.zeros((n + 2 * k, n + 2 * k))
    block[:n, :n], block[:n, n : n + k] = a * step, b * step
    block[n : n + k, n + k :] = np.eye(k)
    moved = expm(block)
    growth, new = moved[:n, :n], moved[:n, n + k :]
    old = moved[:n, n : n + k] - new
    driven = u[:-1] @ old.T + u[1:] @ new.T
    z = np.zeros((len(u), n))
    for index, push in enumerate(driven):
        z[index + 1] = growth @ z[index] + push
    return z
