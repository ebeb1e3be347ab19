"""The reference against closed forms; reciprocal coupling: Newton's third law at gain 1."""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, exp, pi, sin

import numpy as np
import pytest
from scipy.linalg import expm

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.records import time_grid
from psa_casadi.reference import Mechanics, Trajectory, from_samples, simulate
from tests.model.random_models import random_model, random_point
from tests.model.stack_models import LINEAR, PAPER_STACKS, plant_of, stack, stack_values
from tests.studies.plants.base import Run, simulate_base
from tests.studies.plants.mechanics import two_masses
from tests.studies.plants.stack import Stack
from tests.tiers import slow_but

SINGLE = {"m": 7e-3, "c": 90.0, "k": 9.6e7}


def linear_step(
    p: dict[str, float], v: float, load: float, times: FloatArray, start: FloatArray
) -> FloatArray:
    """Return (u, f_out, y, y', x, x') at `times` without hysteresis, for constant v and load.

    z' = a z + b has the solution z = z_e + e^(a t) (z_0 - z_e) with a z_e = -b.
    """
    rc, m_P, m_B = p["R_s"] * p["C_p"], p["m_P"], p["m_B"]
    a = np.zeros((6, 6))
    a[0, 0] = -1 / rc
    a[1, :2] = p["k_L"] / p["tau"], -1 / p["tau"]
    a[2, 3] = a[4, 5] = 1.0
    a[3, 1:4] = 1 / m_P, -p["k_P"] / m_P, -p["c_P"] / m_P
    a[5, 2:] = (p["k_P"] + p["k_B"], p["c_P"] + p["c_B"], -p["k_B"], -p["c_B"])
    a[5] /= m_B
    b = np.array([p["G"] * v / rc, 0.0, 0.0, 0.0, 0.0, load / m_B])
    end = -np.linalg.solve(a, b)
    return np.stack([end + expm(a * t) @ (start - end) for t in times])


def triangle(low: float, high: float, period: float) -> Callable[[float], float]:
    """Return a triangle that starts at `low`, with kinks at every half period."""
    return lambda t: low + (high - low) * (1.0 - abs(2.0 * ((t / period) % 1.0) - 1.0))


def loop_width(trajectory: Trajectory, period: float) -> float:
    """Return falling minus rising f_H at mid voltage in the last full period [N]."""
    end = trajectory.times[-1]
    turn = trajectory.times > end - period / 2
    last = trajectory.times > end - period
    u, f_H = trajectory.states["u"], trajectory.states["f_H"]
    rising, falling = last & ~turn, turn
    middle = float(np.mean([u.min(), u.max()]))
    up = np.interp(middle, u[rising], f_H[rising])
    down = np.interp(-middle, -u[falling], f_H[falling])
    return float(down - up)


@pytest.mark.parametrize("stack", sorted(psa.STACKS))
def test_linear_step_response_is_the_matrix_exponential(stack: str) -> None:
    p = stack_values(stack) | LINEAR
    times = np.linspace(0.0, 3e-3, 601)
    response = simulate(p, lambda _: 100.0, times)
    truth = linear_step(p, 100.0, 0.0, times, np.zeros(6))
    for column, name in enumerate(("u", "f_out", "y", "v_y", "x", "v_x")):
        size = np.abs(truth[:, column]).max()
        np.testing.assert_allclose(
            response.states[name], truth[:, column], rtol=0, atol=6e-8 * size, err_msg=name
        )
    assert not response.states["f_H"].any()


def test_jumps_and_load_enter_between_breakpoints() -> None:
    p = stack_values("PTBS200") | LINEAR
    times = np.linspace(0.0, 4e-3, 801)
    response = simulate(
        p,
        lambda t: 100.0 if t < 1e-3 else -30.0,
        times,
        load_force=lambda t: 0.0 if t < 2e-3 else 200.0,
        breakpoints=(1e-3, 2e-3),
    )
    state = np.zeros(6)
    for begin, v, load in ((0, 100.0, 0.0), (200, -30.0, 0.0), (400, -30.0, 200.0)):
        stretch = times[begin : begin + 201] - times[begin]
        truth = linear_step(p, v, load, stretch, state)
        state = truth[-1]
        np.testing.assert_allclose(
            response.displacement[begin : begin + 201], truth[:, 4], rtol=0, atol=3e-13
        )


def test_single_mass_rings_as_its_closed_form() -> None:
    """A light stack let go from x_0: x = x_0 e^(-s t) (cos w t + s/w sin w t)."""
    p = stack_values("PTBS200") | LINEAR | SINGLE
    times = np.linspace(0.0, 2e-3, 401)
    response = simulate(
        p, lambda _: 0.0, times, initial={"x": 1e-5}, mechanics="single_mass", rtol=1e-11
    )
    decay = p["c"] / (2 * p["m"])
    w = np.sqrt(p["k"] / p["m"] - decay**2)
    truth = 1e-5 * np.exp(-decay * times) * (np.cos(w * times) + decay / w * np.sin(w * times))
    np.testing.assert_allclose(response.displacement, truth, rtol=0, atol=1e-13)
    assert not response.blocked_force.any()


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_monotonic_ramp_with_n_1_is_an_exponential_in_voltage(sense: float) -> None:
    """From rest upward, f_H = h_ref A/b (1 - e^(-b u/h_ref)) with b = beta - gamma."""
    p = stack_values("PTBS200", n=1.0, delta=0.0, hold_rate=1e-6)
    times = np.linspace(0.0, 1.0, 201)
    response = simulate(p, lambda t: sense * 150.0 * t, times)
    u, slope = response.states["u"], p["beta"] - p["gamma"]
    assert abs(u[-1]) > 149.0
    truth = -sense * p["h_ref"] * p["A"] / slope * np.expm1(-slope * np.abs(u) / p["h_ref"])
    np.testing.assert_allclose(response.states["f_H"], truth, rtol=0, atol=1e-7 * p["h_ref"])


def test_hold_leaves_the_hysteresis_force_at_rest() -> None:
    p = stack_values("PTBS200")
    times = np.array([0.0, 0.099, 0.11, 0.5, 5.0])
    ramp = from_samples(np.array([0.0, 0.1]), np.array([0.0, 150.0]))
    f_H = simulate(p, ramp, times, breakpoints=(0.1,)).states["f_H"]
    assert abs(f_H[2]) > 0.3 * p["h_ref"]
    np.testing.assert_allclose(f_H[3:], f_H[2], rtol=0, atol=1e-8 * p["h_ref"])


@pytest.mark.parametrize("stack", PAPER_STACKS)
@pytest.mark.parametrize("share", [0.0, -0.2])
def test_the_papers_stacks_have_their_stroke_and_loop(stack: str, share: float) -> None:
    p = stack_values(stack)
    rated, period = p["u_rated"], 1.0
    times = np.linspace(0.0, 2.0, 1001)
    drive = triangle(share * rated, rated, period)
    start = {"u": share * rated}
    kinks = (0.5, 1.0, 1.5)
    response = simulate(p, drive, times, initial=start, breakpoints=kinks, rtol=1e-7)
    stroke = np.ptp(response.displacement[500:])
    assert stroke == pytest.approx(18e-6 * (1.0 - share * 1.1), rel=0.03)
    compliance = 1 / p["k_P"] + 1 / p["k_B"]
    assert 0.08 < loop_width(response, period) * compliance / stroke < 0.15
    assert np.abs(response.states["f_H"]).max() < 1.5 * p["h_ref"]


def test_every_mistake_is_named_at_once() -> None:
    p = stack_values("PTBS200", C_p=-1e-6)
    del p["beta"]
    with pytest.raises(psa.InputError) as caught:
        simulate(p, lambda _: 0.0, np.array([0.0, 0.0]), initial={"z": 1.0}, rtol=1.0)
    text = str(caught.value)
    for word in ("beta", "C_p is -1e-06", "state 'z'", "do not increase", "rtol = 1"):
        assert word in text


def test_runaway_hysteresis_is_an_error_not_a_curve() -> None:
    p = stack_values("PTBS200", A=-5.0, beta=-40.0, gamma=0.0, n=2.0)
    with pytest.raises(RuntimeError, match="check these parameters"):
        simulate(p, lambda t: 2000.0 * t, np.array([0.0, 1.0]))


def test_a_jump_that_is_no_breakpoint_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="name the jump as a breakpoint"):
        simulate(
            stack_values("PTBS200"), lambda t: 100.0 if t < 1e-3 else -30.0, np.array([0.0, 4e-3])
        )


#: Samples of the stepper's input, linear in between; a sine's error between them is 5e-9 of it.
SAMPLES = 30001
#: The paths take this long [s], or five times the stack's lag.
SHORTEST, LAGS = 2e-3, 5.0
FORCE = 0.05


@dataclass(frozen=True)
class Drive:
    """A voltage in units of the rated one; its kinks and jumps in units of the duration."""

    name: str
    shape: Callable[[float], float]
    breakpoints: tuple[float, ...] = ()
    hold: str = "linear"


def _sine(s: float) -> float:
    return 0.4 * (1.0 - cos(3 * pi * s))


def _triangle(s: float) -> float:
    return 0.8 * (1.0 - abs(2.0 * ((1.5 * s) % 1.0) - 1.0)) - 0.1 * s


def _step(s: float) -> float:
    return 0.6 if s < 0.4 else -0.1 if s < 0.7 else 0.35


def _multisine(s: float) -> float:
    tones = ((1, 0.3), (2, 1.9), (3, 4.4), (5, 2.2))
    return 0.3 + 0.12 * sum(sin(2 * pi * k * s + phase) for k, phase in tones)


def _wander(s: float) -> float:
    """A chirp on a bend that never comes back."""
    return 0.3 * s**2 + 0.25 * s * sin(2.0 + 9.0 * float(s**1.5)) + 0.3 * exp(-3.0 * s)


DRIVES = (
    Drive("sine", _sine),
    Drive("triangle", _triangle, (1 / 3, 2 / 3)),
    Drive("step", _step, (0.4, 0.7), hold="zero"),
    Drive("multisine", _multisine),
    Drive("non_periodic", _wander),
)


def plant_values(stack: str, mechanics: Mechanics) -> dict[str, float]:
    """Return a named stack's values; for the single mass, both masses on springs in series."""
    p = stack_values(stack)
    if mechanics == "single_mass":
        k = 1 / (1 / p["k_P"] + 1 / p["k_B"])
        p |= {"m": p["m_P"] + p["m_B"], "k": k, "c": p["c_B"]}
        for name in ("m_P", "c_P", "k_P", "m_B", "c_B", "k_B"):
            del p[name]
    return p


#: Every stack with one voltage, another one for each, and every voltage.
ONCE = [(s, "cascade", d) for s, d in zip(sorted(psa.STACKS), DRIVES, strict=True)]
ONCE += [("P-885.51", "single_mass", DRIVES[0])]
AGREEMENTS = [*ONCE, *(("WYDS0808020", "single_mass", drive) for drive in DRIVES[1:])]


@pytest.mark.parametrize(
    ("stack", "mechanics", "drive"),
    slow_but(ONCE, AGREEMENTS),
    ids=[f"{stack}-{mechanics}-{drive.name}" for stack, mechanics, drive in AGREEMENTS],
)
def test_displacement_agrees_with_the_reference(
    stack: str, mechanics: Mechanics, drive: Drive
) -> None:
    p = plant_values(stack, mechanics)
    model = psa.compose(psa.BASE if mechanics == "cascade" else psa.SIMPLIFIED, p)
    size, force = p["u_rated"], FORCE * p["k_L"] * p["u_rated"]
    duration = max(SHORTEST, LAGS * p["tau"])
    t = np.linspace(0.0, duration, SAMPLES)
    samples = [size * drive.shape(k / (SAMPLES - 1)) for k in range(SAMPLES)]

    def voltage(time: float) -> float:
        return size * drive.shape(time / duration)

    def load(time: float) -> float:
        return force * sin(7.0 * time / duration) if drive.hold == "linear" else 0.0

    result = psa.simulate(
        model, t, samples, load_force=[load(s) for s in t],
        from_rest_at_zero=True, rtol=1e-8, hold=drive.hold,
    )  # fmt: skip
    every = slice(None, None, 60)
    true = reference.simulate(
        p, voltage, t[every], load_force=load, mechanics=mechanics,
        breakpoints=[b * duration for b in drive.breakpoints], rtol=1e-10,
    )  # fmt: skip
    error = np.abs(result.outputs["displacement"][every] - true.displacement).max()
    assert error < 1e-6 * np.ptp(true.displacement)
    for name, wanted in (
        ("velocity", true.velocity),
        ("charge", true.charge),
        ("blocked_force", true.blocked_force),
    ):
        difference = np.abs(result.outputs[name][every] - wanted).max()
        assert difference < 1e-5 * np.ptp(wanted), name


EFFECT = psa.EFFECTS["reciprocal_coupling"]
FASTEST = 1e-7


def reciprocal(name: str, gain: float, **changes: float) -> psa.Model:
    return stack(name, **changes).with_effect(EFFECT, {"reciprocal_gain": gain})


def plant(name: str, **changes: float) -> Stack:
    return plant_of(stack_values(name, **changes))


def driven(name: str, duration: float, samples: int) -> Run:
    """A plant under a step, a hold and a slower swing."""
    s = plant(name)
    time = time_grid(duration, duration / samples)
    phase = time / duration
    swing = 0.3 * np.sin(6.0 * np.pi * np.clip(phase - 0.4, 0.0, 0.5)) ** 2
    voltage = s.u_rated * np.where(phase > 0.0, 0.5 + swing, 0.0)
    return simulate_base(s, time, voltage, 8)


@pytest.mark.parametrize("gain", [0.0, 0.4, 1.0])
def test_the_equations_are_those_of_remark_1(gain: float) -> None:
    """At any state; at 1 the forces between the masses are equal and opposite."""
    generator = np.random.default_rng(8)
    for _ in range(5):
        model = random_model((EFFECT,), generator, gains=False)
        model = model.with_values({"reciprocal_gain": gain})
        point = random_point(model, generator)
        p = model.values
        rate = np.array(
            model.structure.f(point.time, point.x, point.u, model.parameter_vector())[0]
        ).ravel()
        z = dict(zip(model.state_names, point.x, strict=True))
        dz = dict(zip(model.state_names, rate, strict=True))
        pull = p["c_B"] * (z["v_x"] - z["v_y"]) + p["k_B"] * (z["x"] - z["y"])
        elastic = p["c_P"] * z["v_y"] + p["k_P"] * z["y"]
        size = abs(z["f_out"]) + abs(pull) + abs(elastic) + abs(point.u[1])
        wafers = p["m_P"] * dz["v_y"] + elastic - z["f_out"] - gain * pull
        tip = p["m_B"] * dz["v_x"] + pull - (1 - gain) * elastic - point.u[1]
        assert abs(wafers) < 1e-12 * size
        assert abs(tip) < 1e-12 * size
        assert (dz["y"], dz["x"]) == (z["v_y"], z["v_x"])
        if gain == 1.0:
            whole_stack = p["m_P"] * dz["v_y"] + p["m_B"] * dz["v_x"]
            assert whole_stack == pytest.approx(z["f_out"] - elastic + point.u[1], abs=1e-11 * size)


@pytest.mark.parametrize("name", PAPER_STACKS)
def test_a_step_is_that_of_two_masses_with_action_and_reaction(name: str) -> None:
    """With hysteresis, against matrices and an exponential; the cascade is far away."""
    run = driven(name, 2e-3, 2000)
    truth = two_masses(run)
    result, one_way = (
        psa.simulate(reciprocal(name, g), run.times, run.command, from_rest_at_zero=True, rtol=1e-8)
        for g in (1.0, 0.0)
    )
    size = np.ptp(truth)
    assert np.abs(result.displacement - truth).max() < 2e-5 * size
    assert np.abs(one_way.displacement - run.displacement).max() < 2e-5 * np.ptp(run.displacement)
    ratio = truth[-1] / run.displacement[-1]
    assert np.abs(truth - ratio * run.displacement).max() > 2e-3 * size


@pytest.mark.parametrize("gain", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", ["PTBS200", "P-885.51"])
def test_the_blocked_force_holds_the_output_at_zero(name: str, gain: float) -> None:
    """Applied against the output as a load, it keeps x at 0, also while the stack rings."""
    model = reciprocal(name, gain)
    time = time_grid(1e-3, FASTEST)
    voltage = 100.0 * (1.0 - np.cos(4e3 * np.pi * time))
    free = psa.simulate(model, time, voltage, from_rest_at_zero=True, rtol=1e-8)
    force = free.outputs["blocked_force"]
    held = psa.simulate(model, time, voltage, load_force=-force, from_rest_at_zero=True, rtol=1e-8)
    assert np.abs(held.displacement).max() < 1e-4 * np.ptp(free.displacement)
    same = held.outputs["blocked_force"]
    np.testing.assert_allclose(same, force, rtol=0, atol=1e-4 * np.ptp(force))
