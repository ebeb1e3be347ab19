"""Starting values of the linear part: against truths that the search never sees."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lsim

from psa_casadi.bench.records import loop_voltage, multisine_voltage, step_voltage
from psa_casadi.components import BASE
from psa_casadi.effects import EFFECTS
from psa_casadi.experiment import Record
from psa_casadi.identification.linear_response import (
    FloatArray,
    mechanics_poles,
    numerator_time,
    plays,
    respond,
    transfer,
)
from psa_casadi.identification.linear_start import LinearStart, arrangements, linear_start
from psa_casadi.identification.starting import starting_model
from psa_casadi.identification.vector_fitting import Response, vector_fit
from psa_casadi.model.compose import compose
from psa_casadi.model.stacks import STACKS
from psa_casadi.simulation.simulate import simulate

Values = Mapping[str, float]
PAPER = ("PTBS200", "WYDS0808020", "P-885.51")


def values_of(name: str) -> dict[str, float]:
    return {key: figure.value for key, figure in STACKS[name].values.items()}


def simulated(
    values: Values, time: FloatArray, voltage: FloatArray, effect: str = ""
) -> FloatArray:
    extra = [e for e in EFFECTS.values() if e.name == effect]
    gain = {str(e.gain): 0.04 for e in extra}
    model = compose((*BASE, *extra), {**values, **gain})
    return simulate(model, time, voltage, from_rest_at_zero=True, rtol=1e-7).displacement


def noisy(name: str, time: FloatArray, voltage: FloatArray, x: FloatArray, share: float) -> Record:
    noise = share * np.ptp(x) * np.random.default_rng(1).standard_normal(x.size)
    return Record(name, time, voltage, x + noise)


@cache
def step_of(name: str, effect: str = "") -> Record:
    values = values_of(name)
    time, voltage = step_voltage(values)
    return Record("step", time, voltage, simulated(values, time, voltage, effect))


def step(name: str, share: float, effect: str = "") -> Record:
    clean = step_of(name, effect)
    return noisy("step", clean.time, clean.voltage, np.asarray(clean.displacement), share)


def theta_of(v: Values) -> FloatArray:
    """ln (T, tau, a_P, q_P, a_B, q_B, r) of a stack."""
    times = [v["R_s"] * v["C_p"], v["tau"]]
    for part in "PB":
        times += [v[f"c_{part}"] / v[f"k_{part}"], v[f"m_{part}"] / v[f"k_{part}"]]
    return np.log([*times, v["k_P"] / v["k_B"]])


def errors(found: LinearStart | None, truth: Values, record: Record) -> list[float]:
    """Relative L2 error of every candidate's transfer function where the truth is above 1 %."""
    assert found is not None
    base = starting_model([record]).values
    f = np.geomspace(1.0 / record.duration, 0.25 / record.sample_time, 200)
    true = transfer(theta_of(truth), f)
    seen = np.abs(true) > 0.01
    missed = [
        transfer(theta_of({**base, **c.values}), f)[seen] - true[seen] for c in found.candidates
    ]
    return [float(np.linalg.norm(m) / np.linalg.norm(true[seen])) for m in missed]


def start(*records: Record) -> LinearStart | None:
    return linear_start(records, starting_model(records).values)


@pytest.mark.parametrize(("name", "share", "first"), [
    ("PTBS200", 1e-3, 0.03), ("WYDS0808020", 1e-3, 0.08), ("P-885.51", 1e-3, 0.08),
    ("PTBS200", 1e-2, 0.15), ("WYDS0808020", 1e-2, 0.12), ("P-885.51", 1e-2, 0.15),
])  # fmt: skip
def test_a_step_tells_the_transfer_function(name: str, share: float, first: float) -> None:
    record = step(name, share)
    found = start(record)
    missed = errors(found, values_of(name), record)
    assert found is not None
    assert missed[0] < first
    assert min(missed) < 0.06
    assert found.candidates[0].misfit == pytest.approx(share, rel=0.1)
    assert len(found.candidates) <= 4
    assert found.static_misfit > 5 * share


def test_a_ringing_step_tells_the_bonding_layers() -> None:
    """Wafers and bonding layers exchanged respond almost alike: both are among the candidates."""
    record, truth = step("PTBS200", 1e-3), values_of("PTBS200")
    found, k_B = start(record), starting_model([record]).values["k_B"]
    assert found is not None
    assert all({"m_P", "m_B"} <= set(c.told) for c in found.candidates)
    true = truth["m_B"] / truth["k_B"]
    right = [c for c in found.candidates if abs(c.values["m_B"] / k_B / true - 1.0) < 0.01]
    assert 0 < len(right) < len(found.candidates)
    damping = [c.values["c_B"] / k_B / (truth["c_B"] / truth["k_B"]) for c in right]
    assert damping == pytest.approx([1.0] * len(right), rel=0.05)


@pytest.mark.parametrize("name", PAPER)
def test_a_multisine_tells_it_in_spite_of_the_loop(name: str) -> None:
    values = values_of(name)
    time, voltage = multisine_voltage(values, seed=3)
    record = noisy("multisine", time, voltage, simulated(values, time, voltage), 1e-3)
    assert errors(start(record), values, record)[0] < 0.2


@pytest.mark.parametrize("share", [1e-3, 1e-2])
def test_slow_loops_show_no_dynamics(share: float) -> None:
    """Also where the shape of the loop is not that of play operators."""
    values = values_of("PTBS200")
    records = []
    for amplitude, frequency in ((0.3, 1.0), (1.0, 1.0), (0.3, 10.0), (1.0, 10.0)):
        time, voltage = loop_voltage(values, amplitude, frequency)
        records.append(noisy("loop", time, voltage, simulated(values, time, voltage), share))
    assert start(*records) is None
    with_step = start(*records, step("PTBS200", share))
    assert with_step is not None
    assert with_step.records == ("step",)


def test_without_displacement_or_motion_there_is_no_start() -> None:
    record = step("PTBS200", 1e-3)
    base = starting_model([record]).values
    assert linear_start([replace(record, displacement=None)], base) is None
    assert linear_start([replace(record, voltage=np.full(record.n, 5.0))], base) is None
    assert linear_start([record.slice(0, 10)], base) is None


@pytest.mark.parametrize("scale", [5.0, 40.0])
def test_no_size_is_built_in(scale: float) -> None:
    """Times, volts and metres in other units give the same candidates in those units."""
    record = step("WYDS0808020", 1e-3)
    assert record.displacement is not None
    other = Record("scaled", scale * record.time, 0.1 * record.voltage, 3.0 * record.displacement)
    base = starting_model([record]).values
    first, second = linear_start([record], base), linear_start([other], base)
    assert first is not None
    assert second is not None
    for a, b in zip(first.candidates, second.candidates, strict=True):
        assert b.misfit == pytest.approx(a.misfit, rel=1e-3)
        for key, value in a.values.items():
            power = {"m": 2, "k": 0}.get(key[0], 1)
            assert b.values[key] == pytest.approx(scale**power * value, rel=0.02), key


def test_gaps_offset_clock_and_polarity_do_not_matter() -> None:
    record = step("PTBS200", 1e-3)
    x = np.array(record.displacement)
    x[np.random.default_rng(0).uniform(size=x.size) < 0.2] = np.nan
    x[300:340] = np.nan
    other = Record("gaps", record.time + 7.0, record.voltage - 50.0, 3e-5 - x)
    assert errors(start(other), values_of("PTBS200"), other)[0] < 0.05


def test_irregular_samples_are_put_on_a_grid() -> None:
    values, rng = values_of("WYDS0808020"), np.random.default_rng(2)
    time = np.sort(step_of("WYDS0808020").duration * rng.random(4000))
    voltage: FloatArray = np.where(time > 0.05 * time[-1], 200.0, 0.0)
    record = noisy("random", time, voltage, simulated(values, time, voltage), 1e-3)
    assert errors(start(record), values, record)[0] < 0.06


def test_coarse_samples_tell_the_slower_part() -> None:
    """Eight samples a period of the ringing; the voltage rises from one sample to the next."""
    values = values_of("PTBS200")
    time, voltage = (x[::5] for x in step_voltage(values))
    record = noisy("coarse", time, voltage, simulated(values, time, voltage), 1e-3)
    assert errors(start(record), values, record)[0] < 0.08


def test_a_long_record_is_cut_to_what_is_fast_and_a_coarse_whole() -> None:
    values = values_of("WYDS0808020")
    time = np.linspace(0.0, 5e-3, 100_000)
    voltage = np.where(time < 1e-4, 0.0, 200.0)
    record = noisy("long", time, voltage, simulated(values, time, voltage), 1e-3)
    found = start(record)
    assert errors(found, values, record)[0] < 0.06
    assert found is not None
    assert set(found.records) == {"long, fastest part", "long, coarse"}


@pytest.mark.parametrize("effect", ["slow_creep", "structural_mode"])
def test_what_the_model_lacks_does_not_mislead(effect: str) -> None:
    record = step("PTBS200", 1e-3, effect)
    assert min(errors(start(record), values_of("PTBS200"), record)) < 0.15


@pytest.mark.parametrize("seed", range(6))
def test_stacks_of_any_speed(seed: int) -> None:
    """Resonances from 100 Hz to 300 kHz, light to heavy damping, k_P/k_B from 1.5 to 12."""
    values = random_stack(np.random.default_rng(seed))
    time, voltage = step_voltage(values)
    record = noisy("step", time, voltage, simulated(values, time, voltage), 1e-3)
    assert min(errors(start(record), values, record)) < 0.1


@pytest.mark.parametrize("ratio", [1.0, 0.6])
def test_a_zero_in_the_band_tells_the_stiffness_ratio(ratio: float) -> None:
    """Ringing wafers, overdamped bonding layers: b of eq. (11) is far from both a_P and a_B."""
    values = {**values_of("PTBS200"), "tau": 2e-5, "R_s": 5.0}
    values["k_P"] = ratio * values["k_B"]
    for part, omega, damping in (("P", 2e5, 0.05), ("B", 1e5, 1.2)):
        k = values[f"k_{part}"]
        values |= {f"m_{part}": k / omega**2, f"c_{part}": 2.0 * damping * k / omega}
    time, voltage = step_voltage(values)
    record = noisy("step", time, voltage, simulated(values, time, voltage), 5e-4)
    found = start(record)
    assert found is not None
    k_B = starting_model([record]).values["k_B"]
    told = [c.values["k_P"] / k_B for c in found.candidates if "k_P" in c.told]
    assert told
    assert min(abs(np.log(t / ratio)) for t in told) < 0.5


def random_stack(rng: np.random.Generator) -> dict[str, float]:
    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    slow = 2.0 * np.pi * between(100.0, 3e5)
    values = {**values_of("PTBS200"), "k_B": between(1e6, 5e8)}
    values["k_P"] = values["k_B"] * between(1.5, 12.0)
    for part, omega in (("P", slow * between(1.0, 4.0)), ("B", slow)):
        k, damping = values[f"k_{part}"], between(0.02, 2.0)
        values |= {f"m_{part}": k / omega**2, f"c_{part}": 2.0 * damping * k / omega}
    values["tau"] = max(between(0.1, 10.0) / slow, 1e-7)
    values["R_s"] = between(0.05, 5.0) / (slow * values["C_p"])
    return values


def test_the_response_is_exact_between_samples() -> None:
    theta = np.log([1e-5, 3e-5, 2e-7, 9e-12, 4e-6, 6e-11, 4.0])
    poles, b, h = np.append(mechanics_poles(theta), -1e5), numerator_time(theta), 1e-6
    x = np.concatenate([[0.0], np.cumsum(np.random.default_rng(1).standard_normal(2000))])
    gain = np.real(np.prod(-poles)) * b
    _, exact, _ = lsim(([-1.0 / b], poles, gain), x, h * np.arange(x.size))
    assert np.max(np.abs(respond(poles, b, x, h) - exact)) < 1e-9 * np.ptp(exact)
    f = np.geomspace(1e2, 1e6, 20)
    s = 2j * np.pi * f[:, None]
    direct = gain * (s[:, 0] + 1.0 / b) / np.prod(s - poles, axis=1)
    assert np.allclose(transfer(theta, f), direct, rtol=1e-9)


@pytest.mark.parametrize("q", [1e-10, 0.9999999e-10, 1.0000001e-10])
def test_equal_poles_are_no_singularity(q: float) -> None:
    """Two critically damped pairs at one place, beside pairs a hair apart: the same response."""
    x, h = np.minimum(np.arange(600) / 3.0, 1.0), 1e-6
    theta = np.log([2e-5, 4e-5, 2e-5, q, 2e-5, q, 5.0])
    apart = np.log([2e-5, 4e-5, 2.2e-5, 1e-10, 2e-5, 0.9e-10, 5.0])
    found, near = (respond(mechanics_poles(t), numerator_time(t), x, h) for t in (theta, apart))
    assert found[-1] == pytest.approx(1.0, abs=1e-4)
    assert np.max(np.abs(found - near)) < 0.05


def test_play_operators_follow_their_recursion() -> None:
    u = np.cumsum(np.random.default_rng(3).standard_normal(777))
    radii = np.array([0.5, 3.0, 20.0])
    state = np.full(3, u[0])
    for value, found in zip(u, plays(u, radii), strict=True):
        state = np.minimum(np.maximum(state, value - radii), value + radii)
        assert np.array_equal(found, state)


def test_vector_fitting_finds_the_poles() -> None:
    theta, h = np.log([1e-7, 5e-5, 1e-7, 1e-14, 6e-6, 6e-11, 5.0]), 1e-6
    w = np.where(np.arange(1500) < 10, 0.0, 1e-5)
    y = respond(mechanics_poles(theta), numerator_time(theta), w, h)
    y += 1e-8 * np.random.default_rng(0).standard_normal(w.size)
    poles = vector_fit([Response(h, w, y, np.ones(w.size, dtype=bool), 1e-8)], 3)
    tone = poles[poles.imag > 0][0]
    assert abs(tone) == pytest.approx(6e-11**-0.5, rel=0.01)
    assert -2.0 * tone.real / abs(tone) ** 2 == pytest.approx(6e-6, rel=0.1)
    assert poles[poles.imag == 0][0].real == pytest.approx(-2e4, rel=0.02)


def test_every_arrangement_holds_the_poles_it_is_given() -> None:
    given = np.array([-1e3, -8e3, -2e3 + 3e4j, -2e3 - 3e4j])
    for theta in arrangements(given, 1e-6):
        placed = np.append(mechanics_poles(theta), -np.exp(-theta[0]))
        for pole in given:
            assert np.min(np.abs(placed - pole)) < 1e-6 * abs(pole)
    assert len(arrangements(given, 1e-6)) > 2
