"""The observer, the feed-forward and the online identification, against independent plants."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.examples.linearisation_trial import DriftingStack, ageing, driven, off_values
from psa_casadi.units import FloatArray
from tests.tiers import slow

STACK, PERIOD, NOISE = "P-885.51", 5e-4, 2e-8
#: The last part of a run of 2 s: 0.8 s, four of its periods.
LAST = slice(-1600, None)


def test_the_plant_is_the_reference() -> None:
    """The stack that is stepped sample by sample is the paper's model in plain SciPy."""
    values = psa.stack_model(STACK).values
    time = np.arange(0.0, 0.1, PERIOD)
    voltage = 60.0 * (1.0 - np.cos(2.0 * np.pi * 20.0 * time))
    expected = reference.simulate(
        values, reference.from_samples(time, voltage), time, breakpoints=time[1:-1].tolist(),
        rtol=1e-8,
    )  # fmt: skip
    stack = DriftingStack(values, PERIOD)
    found = np.array([stack.step(u) for u in voltage.tolist()])
    span = float(np.ptp(expected.displacement))
    assert found == pytest.approx(expected.displacement, abs=2e-5 * span)


def test_observer_gives_the_force_of_equation_8() -> None:
    model = psa.stack_model(STACK)
    p = model.values
    time = np.arange(0.0, 0.3, PERIOD)

    def voltage(t: float) -> float:
        return float(50.0 * (1.0 - np.cos(2.0 * np.pi * 10.0 * t)) * (1.0 - 0.8 * t))

    def rate(t: float, f: FloatArray) -> list[float]:
        h = 1e-7
        slope = (voltage(t + h) - voltage(t - h)) / (2.0 * h)
        sign = slope / np.hypot(slope, p["hold_rate"])
        r = abs(f[0] / p["h_ref"]) ** p["n"]
        bend = p["beta"] * slope * sign * np.sign(f[0]) * r + p["gamma"] * slope * r
        return [p["A"] * slope - bend + p["delta"] * voltage(t) * sign]

    expected = solve_ivp(rate, (0.0, time[-1]), [0.0], t_eval=time, rtol=1e-9, atol=1e-9,
                         max_step=1e-3).y[0]  # fmt: skip
    observer = psa.HysteresisObserver(psa.stack_values(model, PERIOD, at_electrodes=True))
    found = np.array([observer.step(voltage(t)) for t in time.tolist()])
    assert np.abs(found - expected).max() < 1e-3 * float(np.ptp(expected))


def test_feed_forward_makes_the_plant_linear() -> None:
    model, time = psa.stack_model(STACK), np.arange(0.0, 1.0, PERIOD)
    plain = driven(model, "none", model, time).nonlinearity()
    linear = driven(model, "feed-forward", model, time).nonlinearity()
    assert plain > 0.08
    assert linear < 2e-5


@pytest.mark.parametrize("seed", [0, 1])
def test_values_off_by_ten_percent_are_learnt(seed: int) -> None:
    model, time = psa.stack_model(STACK), np.arange(0.0, 2.0, PERIOD)
    known = off_values(model, 0.1, seed)
    fixed = driven(model, "feed-forward", known, time).nonlinearity(LAST)
    tracked = driven(model, "tracked", known, time)
    assert fixed > 3e-3
    assert tracked.nonlinearity(LAST) < 1e-4
    assert tracked.estimate is not None
    for name in ("A", "beta", "n", "k_L"):
        found, true = tracked.estimate.parameters[name], model.values[name]
        assert found == pytest.approx(true, rel=0.01), name


@slow
def test_an_ageing_stack_is_followed() -> None:
    model, time = psa.stack_model(STACK), np.arange(0.0, 6.0, PERIOD)
    drift = ageing(model, 6.0)
    figures = [
        driven(model, control, model, time, drift=drift).nonlinearity(slice(-2000, None))
        for control in ("feed-forward", "tracked")
    ]
    assert figures[0] > 0.02
    assert figures[1] < 0.2 * figures[0]


def test_what_is_no_stack_is_refused() -> None:
    with pytest.raises(psa.InputError, match="no stack"):
        psa.stack_values(psa.part_model("flexure_stage"), PERIOD)
    model = psa.stack_model(STACK)
    with pytest.raises(psa.InputError, match="does not exceed gamma"):
        psa.stack_values(model.with_values({"gamma": model.values["beta"]}), PERIOD)
    with pytest.raises(psa.InputError, match="noise"):
        psa.identifier_for(model, PERIOD, noise=0.0)


def test_a_wanted_motion_in_metres_is_where_the_stack_goes() -> None:
    """The independent plant follows a slow raster in metres but for its lag and its creep."""
    model, period = psa.stack_model(STACK).with_values({"delta": 0.0}), 2e-3
    values = psa.stack_values(model, period)
    time = np.arange(0.0, 4.0, period)
    wanted = 4e-6 * (1.0 - np.cos(np.pi * time)) * (1.0 - 0.15 * time)
    for forward in (psa.FeedForward(values), psa.AdaptiveFeedForward(
        psa.identifier_for(model, period, noise=NOISE).values)):  # fmt: skip
        plant, x, missed = DriftingStack(model.values, period), 0.0, []
        for w in wanted.tolist():
            u = forward.step(w) if isinstance(forward, psa.FeedForward) else forward.step(w, x)
            x = plant.step(u)
            missed.append(x - w)
        slope = float(np.abs(np.gradient(wanted, period)).max())
        assert np.abs(missed).max() < 1.1 * values["lag"] * slope + 2e-5 * np.ptp(wanted)


def test_volts_are_no_motion() -> None:
    model = psa.stack_model(STACK)
    forward = psa.FeedForward(psa.stack_values(model, PERIOD))
    before = forward.step(2e-6)
    for wrong in (50.0, float("nan"), float("inf"), -1e-3):
        with pytest.raises(psa.InputError, match=r"step_voltage"):
            forward.step(wrong)
    assert forward.kept["u_last"] == before
    adaptive = psa.AdaptiveFeedForward(psa.identifier_for(model, PERIOD, noise=NOISE).values)
    with pytest.raises(psa.InputError, match=r"stroke is \d+(\.\d+)? um"):
        adaptive.step(20.0, 0.0)


@pytest.mark.parametrize("name", psa.STACKS)
@pytest.mark.parametrize(("samples", "limit"), [(1, 0.035), (10, 0.0025)])
def test_jumps_across_the_range_are_followed(name: str, samples: int, limit: float) -> None:
    """Equation (8), solved finely along each jump, is what the voltage is corrected for."""
    p = (model := psa.stack_model(name).with_values({"delta": 0.0})).values
    forward = psa.FeedForward(psa.stack_values(model, PERIOD, at_electrodes=True))
    per_volt = p["k_L"] * (1.0 / p["k_P"] + 1.0 / p["k_B"])
    turns = p["u_rated"] * np.array([0.0, 1.0, 0.0, 0.8, 0.8, -0.2, 1.0, 1.0, 0.5, 0.5])
    force, last, missed = 0.0, 0.0, []
    for volts in np.interp(np.arange(9 * samples + 1) / samples, np.arange(10), turns):
        u = forward.step(float(per_volt * volts))

        def slope(_: float, f: FloatArray, du: float = u - last) -> FloatArray:
            bend = p["beta"] * abs(du) * np.sign(f) + p["gamma"] * du
            return np.asarray(p["A"] * du - bend * np.abs(f / p["h_ref"]) ** p["n"])

        force = float(solve_ivp(slope, (0.0, 1.0), [force], rtol=1e-9, atol=1e-6).y[0, -1])
        last = u
        missed.append((p["k_L"] * u + force) / p["k_L"] - volts)
    assert np.abs(missed).max() < limit * p["u_rated"]
