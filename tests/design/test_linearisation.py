"""The observer, the feed-forward and the online identification, against independent plants."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import psa_casadi as psa
from psa_casadi import reference
from psa_casadi.common.units import FloatArray
from psa_casadi.examples.linearisation_trial import DriftingStack, Drive, ageing, driven, off_values
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu
from psa_casadi.export.modelica.package import modelica_text
from tests.export.modelica_runs import simulated
from tests.tiers import slow, slow_but

#: Parameters that the identification tracks, in its order.
TRACKED = ("A", "beta", "gamma", "delta", "n", "k_L", "offset")


class NumpyIdentification:
    """The recursion of the component, written from its equations: `step(u, x)`.

    `estimates` (7,) are A, beta, gamma, delta, n, k_L and offset in SI units, `f` [N] the force.
    """

    def __init__(self, values: Mapping[str, float]) -> None:
        v = self.v = dict(values)
        self.start = np.array([*(v[n] for n in TRACKED[:-1]), 0.0])
        bend, least = abs(v["beta"]) + abs(v["gamma"]) + 0.02 * v["k_L"], 0.02 * v["k_L"]
        size = [abs(v["A"]) + least, bend, bend, abs(v["delta"]) + least, 1.0, v["k_L"]]
        self.spread = v["spread"] * np.array([*size, 0.1 * v["k_L"] * v["u_rated"]])
        self.z, self.P = np.zeros(7), np.eye(7)
        self.s_f, self.s_l = np.zeros(5), np.zeros(5)
        self.last = self.f = self.lag_u = self.lag_f = 0.0

    @property
    def estimates(self) -> FloatArray:
        return np.asarray(self.start + self.spread * self.z, dtype=np.float64)

    def after(self, f: float, theta: FloatArray, u: float) -> float:
        """Return f_H after one step of Alexander's method from the last voltage to u."""
        v, T = self.v, self.v["period"]
        A, beta, gamma, delta, n = theta[:5]
        du = u - self.last
        sign = (du / T) / np.hypot(du / T, v["hold_rate"])

        def change(f: float) -> float:
            r = abs(f / v["h_ref"]) ** n
            free = A * du + delta * 0.5 * (u + self.last) * sign * T
            return float(free - (beta * du * sign * np.sign(f) + gamma * du) * r)

        share = 1.0 - 0.5**0.5

        def stage(known: float) -> float:
            at = known
            for _ in range(50):  # converges: the steps of these records are small
                at = known + share * change(at)
            return at

        return stage(f + (1.0 - share) * change(stage(f)))

    def slopes(self, theta: FloatArray, u: float) -> tuple[float, FloatArray]:
        """Return the derivatives of `after` by f and by A, beta, gamma, delta, n."""
        by = np.zeros(5)
        for j in range(5):
            step = np.zeros(7)
            step[j] = 1e-5 * self.spread[j]
            up, down = self.after(self.f, theta + step, u), self.after(self.f, theta - step, u)
            by[j] = (up - down) / (2.0 * step[j])
        h = 1e-5 * self.v["h_ref"]
        up, down = self.after(self.f + h, theta, u), self.after(self.f - h, theta, u)
        return (up - down) / (2.0 * h), by

    def step(self, u: float, x: float) -> None:
        """Take one sample."""
        v, T, theta = self.v, self.v["period"], self.estimates
        keep = np.exp(-T / v["lag"])
        held = (1.0 - keep) * v["lag"] / T
        old, new = held - keep, 1.0 - held
        by_f, by = self.slopes(theta, u)
        f, s_f = self.after(self.f, theta, u), by_f * self.s_f + by
        self.lag_u = keep * self.lag_u + old * self.last + new * u
        self.lag_f = keep * self.lag_f + old * self.f + new * f
        self.s_l = keep * self.s_l + old * self.s_f + new * s_f
        moving = abs(u - self.last) / T > v["standstill_rate"]
        self.last, self.f, self.s_f = u, f, s_f
        if moving:
            error = v["stiffness"] * x - (theta[5] * self.lag_u + self.lag_f + theta[6])
            self.correct(error)

    def correct(self, error: float) -> None:
        """Recursive least squares on the prediction, with forgetting bounded by the start."""
        v = self.v
        d = self.spread * np.array([*self.s_l, self.lag_u, 1.0])
        g = self.P @ d
        scale = d @ g + (v["noise"] * v["stiffness"]) ** 2
        step = g * error / scale
        step *= min(1.0, 0.05 / max(float(np.linalg.norm(step)), 1e-300))
        P = self.P - np.outer(g, g) / scale
        stretch = np.sqrt(1.0 + v["period"] / v["memory"] * (1.0 - np.diag(P)))
        self.P, self.z = P * np.outer(stretch, stretch), self.z + step
        self.f += float(self.s_f @ (self.spread * step)[:5])
        self.lag_f += float(self.s_l @ (self.spread * step)[:5])


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
    result = np.array([stack.step(u) for u in voltage.tolist()])
    span = float(np.ptp(expected.displacement))
    assert result == pytest.approx(expected.displacement, abs=2e-5 * span)


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
    result = np.array([observer.step(voltage(t)) for t in time.tolist()])
    assert np.abs(result - expected).max() < 1e-3 * float(np.ptp(expected))


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
        result, true = tracked.estimate.parameters[name], model.values[name]
        assert result == pytest.approx(true, rel=0.01), name


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
        plant, x, misfit = DriftingStack(model.values, period), 0.0, []
        for w in wanted.tolist():
            u = forward.step(w) if isinstance(forward, psa.FeedForward) else forward.step(w, x)
            x = plant.step(u)
            misfit.append(x - w)
        slope = float(np.abs(np.gradient(wanted, period)).max())
        assert np.abs(misfit).max() < 1.1 * values["lag"] * slope + 2e-5 * np.ptp(wanted)


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
    force, last, misfit = 0.0, 0.0, []
    for volts in np.interp(np.arange(9 * samples + 1) / samples, np.arange(10), turns):
        u = forward.step(float(per_volt * volts))

        def slope(_: float, f: FloatArray, du: float = u - last) -> FloatArray:
            bend = p["beta"] * abs(du) * np.sign(f) + p["gamma"] * du
            return np.asarray(p["A"] * du - bend * np.abs(f / p["h_ref"]) ** p["n"])

        force = float(solve_ivp(slope, (0.0, 1.0), [force], rtol=1e-9, atol=1e-6).y[0, -1])
        last = u
        misfit.append((p["k_L"] * u + force) / p["k_L"] - volts)
    assert np.abs(misfit).max() < limit * p["u_rated"]


@cache
def record() -> Drive:
    """Return a plain run of 0.4 s on the plant."""
    model = psa.stack_model(STACK)
    return driven(model, "none", model, np.arange(0.0, 0.4, PERIOD))


def test_recursion_is_recursive_least_squares_on_the_prediction() -> None:
    """The streaming object does what matrices and finite differences in NumPy do."""
    model = off_values(psa.stack_model(STACK), 0.1, 0)
    values, d = dict(psa.identifier_for(model, PERIOD, noise=NOISE).values), record()
    online = psa.OnlineIdentification(values)
    expected, rows = NumpyIdentification(values), []
    for u, x in zip(d.voltage.tolist(), d.displacement.tolist(), strict=True):
        force = online.step(u, x)
        expected.step(u, x)
        result = online.estimate.parameters
        mine = [*(result[name] for name in TRACKED), force]
        rows.append([mine, [*expected.estimates, expected.f]])
    both = np.array(rows)
    sizes = np.abs(both[:, 1]).max(axis=0)
    assert (np.abs(both[:, 0] - both[:, 1]) / sizes).max() < 1e-4
    assert np.ptp(both[:, 0, 0]) > 0.1  # A has moved


def test_standstill_teaches_nothing_and_winds_nothing_up() -> None:
    model = psa.stack_model(STACK)
    tuned = psa.identifier_for(model, PERIOD, noise=NOISE, memory=0.05)
    online, d = psa.OnlineIdentification(tuned.values), record()
    for u, x in zip(d.voltage.tolist(), d.displacement.tolist(), strict=True):
        online.step(u, x)
    before = online.estimate
    held, draw = d.voltage[-1], np.random.default_rng(1)
    for error in draw.normal(size=4000):
        online.step(float(held), float(d.displacement[-1] + 1e-7 * error))
    after = online.estimate
    assert after.parameters == before.parameters
    assert after.uncertainty == before.uncertainty


@pytest.mark.parametrize("fmi", slow_but([3], [2, 3]))
def test_fmu_gives_what_the_stream_gives(fmi: int, tmp_path: Path) -> None:
    model = psa.identifier_for(off_values(psa.stack_model(STACK), 0.1, 0), PERIOD, noise=NOISE)
    d, online = record(), psa.OnlineIdentification(model.values)
    names = [f"{name}_hat" for name in TRACKED] + ["hysteresis_force"]
    with (
        Fmu(psa.export_fmu(model, tmp_path / "online.fmu", fmi=fmi)) as fmu,
        fmu.start(CO_SIMULATION) as instance,
    ):
        for k in range(200):
            u, x = float(d.voltage[k]), float(d.displacement[k])
            force = online.step(u, x)
            instance.set({"voltage": u, "position": x})
            instance.step(k * PERIOD, PERIOD)
            result = online.estimate.parameters
            expected = [*(result[name] for name in TRACKED), force]
            assert instance.get(names) == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_modelica_block_gives_what_the_stream_gives() -> None:
    """Another compiler runs the exported block on another drive."""
    model = psa.identifier_for(off_values(psa.stack_model(STACK), 0.1, 0), PERIOD, noise=NOISE)
    wave = "60*(1 - cos(62.83185307179586*({})))"
    harness = f"""
    model Driven
      OnlineIdentification.Signal rls;
    equation
      rls.voltage = {wave.format("time")};
      rls.position = 1.4e-7*{wave.format("time - 1e-3")};
    end Driven;
    """
    result = simulated(modelica_text(model) + harness, "Driven", 0.03)
    online = psa.OnlineIdentification(model.values)
    for t in PERIOD * np.arange(61):
        u, x = (60.0 * (1.0 - np.cos(62.83185307179586 * (t - d))) for d in (0.0, 1e-3))
        force = online.step(float(u), 1.4e-7 * float(x))
    assert result["rls.hysteresis_force"][-1] == pytest.approx(force, rel=1e-8)
    for name, value in online.estimate.parameters.items():
        assert result[f"rls.{name}_hat"][-1] == pytest.approx(value, rel=1e-7), name
