"""Starting values: of the linear part, of the hysteresis, and the linear response behind them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.signal import lsim

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.start.linear_response import (
    Response,
    mechanics_poles,
    numerator_time,
    plays,
    respond,
    vector_fit,
)
from psa_casadi.identification.start.ordinary import loop_start, starting_model
from psa_casadi.identification.start.starting_points import (
    LinearCandidate,
    arrangements,
    excerpts,
    linear_start,
)
from psa_casadi.model.stacks import STACKS
from psa_casadi.records import Record
from tests.identification.paper_cases import transfer
from tests.model.stack_models import PAPER_STACKS, stack_values
from tests.studies.benchmarks.coverage import quantities
from tests.studies.benchmarks.records import (
    clean_loops,
    loop_voltage,
    multisine_voltage,
    step_voltage,
    with_noise,
)
from tests.tiers import slow, slow_but

Values = Mapping[str, float]


def simulated(
    values: Values, time: FloatArray, voltage: FloatArray, effect: str = ""
) -> FloatArray:
    extra = [e for e in psa.EFFECTS.values() if e.name == effect]
    gain = {str(e.gain): 0.04 for e in extra}
    model = psa.compose((*psa.BASE, *extra), {**values, **gain})
    return psa.simulate(model, time, voltage, from_rest_at_zero=True, rtol=1e-7).displacement


def noisy(
    name: str, time: FloatArray, voltage: FloatArray, x: FloatArray, share: float
) -> psa.Record:
    noise = share * np.ptp(x) * np.random.default_rng(1).standard_normal(x.size)
    return psa.Record(name=name, time=time, voltage=voltage, displacement=x + noise)


@cache
def step_of(name: str, effect: str = "") -> psa.Record:
    values = stack_values(name)
    time, voltage = step_voltage(values)
    return psa.Record(
        name="step",
        time=time,
        voltage=voltage,
        displacement=simulated(values, time, voltage, effect),
    )


def step(name: str, share: float, effect: str = "") -> psa.Record:
    clean = step_of(name, effect)
    return noisy("step", clean.time, clean.voltage, np.asarray(clean.displacement), share)


def theta_of(v: Values) -> FloatArray:
    """ln (T, tau, a_P, q_P, a_B, q_B, r) of a stack."""
    times = [v["R_s"] * v["C_p"], v["tau"]]
    for part in "PB":
        times += [v[f"c_{part}"] / v[f"k_{part}"], v[f"m_{part}"] / v[f"k_{part}"]]
    return np.log([*times, v["k_P"] / v["k_B"]])


def errors(candidates: Sequence[LinearCandidate], truth: Values, record: psa.Record) -> list[float]:
    """Relative L2 error of every candidate's transfer function where the truth is above 1 %."""
    base = starting_model([record]).values
    f = np.geomspace(1.0 / record.duration, 0.25 / record.sample_time, 200)
    true = transfer(theta_of(truth), f)
    observed = np.abs(true) > 0.01
    items = [
        transfer(theta_of({**base, **c.values}), f)[observed] - true[observed] for c in candidates
    ]
    return [float(np.linalg.norm(m) / np.linalg.norm(true[observed])) for m in items]


def start(*records: psa.Record) -> tuple[LinearCandidate, ...]:
    return linear_start(records, starting_model(records).values)


#: The share of noise and the largest error of each stack's step.
STEP_ERRORS = [
    ("PTBS200", 1e-3, 0.03), ("WYDS0808020", 1e-3, 0.08), ("P-885.51", 1e-3, 0.08),
    ("PTBS200", 1e-2, 0.15), ("WYDS0808020", 1e-2, 0.12), ("P-885.51", 1e-2, 0.15),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "share", "first"), slow_but([STEP_ERRORS[0], STEP_ERRORS[-1]], STEP_ERRORS)
)
def test_a_step_determines_the_transfer_function(name: str, share: float, first: float) -> None:
    record = step(name, share)
    result = start(record)
    misfit = errors(result, stack_values(name), record)
    assert misfit[0] < first
    assert min(misfit) < 0.06
    assert result[0].misfit == pytest.approx(share, rel=0.1)
    assert len(result) <= 4


def test_a_ringing_step_determines_the_bonding_layers() -> None:
    """Wafers and bonding layers exchanged respond almost equally: both are among the candidates."""
    record, truth = step("PTBS200", 1e-3), stack_values("PTBS200")
    result, k_B = start(record), starting_model([record]).values["k_B"]
    assert result
    assert all({"m_P", "m_B"} <= set(c.determined) for c in result)
    true = truth["m_B"] / truth["k_B"]
    right = [c for c in result if abs(c.values["m_B"] / k_B / true - 1.0) < 0.01]
    assert 0 < len(right) < len(result)
    damping = [c.values["c_B"] / k_B / (truth["c_B"] / truth["k_B"]) for c in right]
    assert damping == pytest.approx([1.0] * len(right), rel=0.05)


@pytest.mark.parametrize("name", slow_but(["PTBS200"], PAPER_STACKS))
def test_a_multisine_determines_it_in_spite_of_the_loop(name: str) -> None:
    values = stack_values(name)
    time, voltage = multisine_voltage(values, seed=3)
    record = noisy("multisine", time, voltage, simulated(values, time, voltage), 1e-3)
    assert errors(start(record), values, record)[0] < 0.2


@pytest.mark.parametrize("share", slow_but([1e-3], [1e-3, 1e-2]))
def test_slow_loops_show_no_dynamics(share: float) -> None:
    """Also where the shape of the loop is not that of play operators."""
    values = stack_values("PTBS200")
    records = []
    for amplitude, frequency in ((0.3, 1.0), (1.0, 1.0), (0.3, 10.0), (1.0, 10.0)):
        time, voltage = loop_voltage(values, amplitude, frequency)
        records.append(noisy("loop", time, voltage, simulated(values, time, voltage), share))
    assert start(*records) == ()
    with_step = [*records, step("PTBS200", share)]
    assert start(*with_step)
    assert [e.name for e in excerpts(with_step)] == ["step"]


def test_without_displacement_or_motion_there_is_no_start() -> None:
    record = step("PTBS200", 1e-3)
    base = starting_model([record]).values
    assert linear_start([replace(record, displacement=None)], base) == ()
    assert linear_start([replace(record, voltage=np.full(record.n, 5.0))], base) == ()
    assert linear_start([record.slice(0, 10)], base) == ()


@slow
@pytest.mark.parametrize("scale", slow_but([40.0], [5.0, 40.0]))
def test_no_size_is_built_in(scale: float) -> None:
    """Times, volts and metres in other units give the same candidates in those units."""
    record = step("WYDS0808020", 1e-3)
    assert record.displacement is not None
    other = psa.Record(
        name="scaled",
        time=scale * record.time,
        voltage=0.1 * record.voltage,
        displacement=3.0 * record.displacement,
    )
    base = starting_model([record]).values
    first, second = linear_start([record], base), linear_start([other], base)
    assert first
    for a, b in zip(first, second, strict=True):
        assert b.misfit == pytest.approx(a.misfit, rel=1e-3)
        for key, value in a.values.items():
            power = {"m": 2, "k": 0}.get(key[0], 1)
            assert b.values[key] == pytest.approx(scale**power * value, rel=0.02), key


def test_gaps_offset_clock_and_polarity_do_not_matter() -> None:
    record = step("PTBS200", 1e-3)
    x = np.array(record.displacement)
    x[np.random.default_rng(0).uniform(size=x.size) < 0.2] = np.nan
    x[300:340] = np.nan
    other = psa.Record(
        name="gaps", time=record.time + 7.0, voltage=record.voltage - 50.0, displacement=3e-5 - x
    )
    assert errors(start(other), stack_values("PTBS200"), other)[0] < 0.05


@slow
def test_irregular_samples_are_put_on_a_grid() -> None:
    values, rng = stack_values("WYDS0808020"), np.random.default_rng(2)
    time = np.sort(step_of("WYDS0808020").duration * rng.random(4000))
    voltage: FloatArray = np.where(time > 0.05 * time[-1], 200.0, 0.0)
    record = noisy("random", time, voltage, simulated(values, time, voltage), 1e-3)
    assert errors(start(record), values, record)[0] < 0.06


@pytest.mark.parametrize("between", [False, True])
def test_coarse_samples_determine_the_slower_part(between: bool) -> None:
    """Eight samples a period of the ringing; the jump is a ramp of one sample, or within it."""
    values = stack_values("PTBS200")
    fine = step_of("PTBS200")
    time, voltage = fine.time[::5], fine.voltage[::5]
    ramp = simulated(values, time, voltage)
    x = np.asarray(fine.displacement)[::5] if between else ramp
    record = noisy("coarse", time, voltage, x, 1e-3)
    assert errors(start(record), values, record)[0] < 0.1


@slow
def test_a_long_record_is_cut_to_what_is_fast_and_a_coarse_whole() -> None:
    values = stack_values("WYDS0808020")
    time = np.linspace(0.0, 5e-3, 100_000)
    voltage = np.where(time < 1e-4, 0.0, 200.0)
    record = noisy("long", time, voltage, simulated(values, time, voltage), 1e-3)
    assert errors(start(record), values, record)[0] < 0.06
    assert {e.name for e in excerpts([record])} == {"long, fastest part", "long, coarse"}


@pytest.mark.parametrize("effect", slow_but(["slow_creep"], ["slow_creep", "structural_mode"]))
def test_what_the_model_lacks_does_not_mislead(effect: str) -> None:
    record = step("PTBS200", 1e-3, effect)
    assert min(errors(start(record), stack_values("PTBS200"), record)) < 0.15


@pytest.mark.parametrize("seed", slow_but([1], range(4)))
def test_stacks_of_any_speed(seed: int) -> None:
    """Resonances from 100 Hz to 300 kHz, light to heavy damping, k_P/k_B from 1.5 to 12."""
    values = random_stack(np.random.default_rng(seed))
    time, voltage = step_voltage(values)
    record = noisy("step", time, voltage, simulated(values, time, voltage), 1e-3)
    assert min(errors(start(record), values, record)) < 0.1


@pytest.mark.parametrize("ratio", slow_but([0.6], [1.0, 0.6]))
def test_a_zero_in_the_band_determines_the_stiffness_ratio(ratio: float) -> None:
    """Ringing wafers, overdamped bonding layers: b of eq. (11) is far from both a_P and a_B."""
    values = {**stack_values("PTBS200"), "tau": 2e-5, "R_s": 5.0}
    values["k_P"] = ratio * values["k_B"]
    for part, omega, damping in (("P", 2e5, 0.05), ("B", 1e5, 1.2)):
        k = values[f"k_{part}"]
        values |= {f"m_{part}": k / omega**2, f"c_{part}": 2.0 * damping * k / omega}
    time, voltage = step_voltage(values)
    record = noisy("step", time, voltage, simulated(values, time, voltage), 5e-4)
    k_B = starting_model([record]).values["k_B"]
    ratios = [c.values["k_P"] / k_B for c in start(record) if "k_P" in c.determined]
    assert ratios
    assert min(abs(np.log(t / ratio)) for t in ratios) < 0.5


def random_stack(rng: np.random.Generator) -> dict[str, float]:
    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    slow = 2.0 * np.pi * between(100.0, 3e5)
    values = {**stack_values("PTBS200"), "k_B": between(1e6, 5e8)}
    values["k_P"] = values["k_B"] * between(1.5, 12.0)
    for part, omega in (("P", slow * between(1.0, 4.0)), ("B", slow)):
        k, damping = values[f"k_{part}"], between(0.02, 2.0)
        values |= {f"m_{part}": k / omega**2, f"c_{part}": 2.0 * damping * k / omega}
    values["tau"] = max(between(0.1, 10.0) / slow, 1e-7)
    values["R_s"] = between(0.05, 5.0) / (slow * values["C_p"])
    return values


BENDS = ("beta", "gamma", "delta")


@cache
def loops(name: str) -> list[Record]:
    return clean_loops(stack_values(name))


def loop_errors(name: str, records: list[Record]) -> dict[str, float]:
    """Return errors of the identifiable quantities: k, A and the bends over k + A, and n."""
    p = stack_values(name)
    model = starting_model(records, p["k_B"])
    values = loop_start(model, records)
    assert values is not None
    size = static_compliance(p) * p["h_ref"]
    true, value = quantities(p, size), quantities({**model.values, **values}, size)
    over = true["k_L"] + true["A"]
    shares = {n: (value[n] - true[n]) / over for n in ("k_L", "A", *BENDS)}
    return {**shares, "n": value["n"] - true["n"]}


@pytest.mark.parametrize("name", slow_but(["P-885.51"], STACKS))
def test_loops_with_noise_determine_the_hysteresis(name: str) -> None:
    result = loop_errors(name, with_noise(loops(name), 1e-3, seed=2))
    assert all(abs(e) < 0.03 for e in result.values()), result


def test_noise_of_one_per_cent_and_missing_samples_still_leave_a_good_start() -> None:
    """The logarithms of (31) and (34) have no samples left there."""
    spoiled = []
    for r in with_noise(loops("P-885.51"), 1e-2, seed=5):
        y = np.array(r.displacement)
        y[200:230] = np.nan
        spoiled.append(replace(r, displacement=y))
    result = loop_errors("P-885.51", spoiled)
    assert all(abs(e) < 0.3 for e in result.values()), result
    assert abs(result["k_L"] + result["A"]) < 0.03


@slow
def test_loops_that_start_amid_a_period_determine_it_too() -> None:
    cut = [replace_from(r, 300) for r in with_noise(loops("PTBS200"), 1e-3, seed=1)]
    result = loop_errors("PTBS200", cut)
    assert all(abs(e) < 0.1 for e in result.values()), result


def replace_from(r: Record, first: int) -> Record:
    y = np.array(r.displacement)
    return Record(
        name=r.name, time=r.time[first:], voltage=r.voltage[first:], displacement=y[first:]
    )


def test_nothing_is_read_where_nothing_turns_or_moves() -> None:
    p = stack_values("P-885.51")
    t, v = step_voltage(p)
    step = Record(name="step", time=t, voltage=v, displacement=1e-7 * v)
    assert loop_start(starting_model([step]), [step]) is None
    still = replace_from(loops("P-885.51")[0], 0)
    still = replace(still, displacement=np.full(still.n, 1e-6))
    assert loop_start(starting_model(loops("P-885.51")), [still]) is None


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
    """Two critically damped pairs at one place, against pairs a hair apart: the same response."""
    x, h = np.minimum(np.arange(600) / 3.0, 1.0), 1e-6
    theta = np.log([2e-5, 4e-5, 2e-5, q, 2e-5, q, 5.0])
    apart = np.log([2e-5, 4e-5, 2.2e-5, 1e-10, 2e-5, 0.9e-10, 5.0])
    result, near = (respond(mechanics_poles(t), numerator_time(t), x, h) for t in (theta, apart))
    assert result[-1] == pytest.approx(1.0, abs=1e-4)
    assert np.max(np.abs(result - near)) < 0.05


def test_play_operators_follow_their_recursion() -> None:
    u = np.cumsum(np.random.default_rng(3).standard_normal(777))
    radii = np.array([0.5, 3.0, 20.0])
    state = np.full(3, u[0])
    for value, result in zip(u, plays(u, radii), strict=True):
        state = np.minimum(np.maximum(state, value - radii), value + radii)
        assert np.array_equal(result, state)


def test_vector_fitting_finds_the_poles() -> None:
    theta, h = np.log([1e-7, 5e-5, 1e-7, 1e-14, 6e-6, 6e-11, 5.0]), 1e-6
    w = np.where(np.arange(1500) < 10, 0.0, 1e-5)
    y = respond(mechanics_poles(theta), numerator_time(theta), w, h)
    y += 1e-8 * np.random.default_rng(0).standard_normal(w.size)
    poles = vector_fit(Response(h, w, y, np.ones(w.size, dtype=bool), 1e-8), 3)
    tone = poles[poles.imag > 0][0]
    assert abs(tone) == pytest.approx(6e-11**-0.5, rel=0.01)
    assert -2.0 * tone.real / abs(tone) ** 2 == pytest.approx(6e-6, rel=0.1)
    assert poles[poles.imag == 0][0].real == pytest.approx(-2e4, rel=0.02)


def test_every_arrangement_holds_the_required_poles() -> None:
    inputs = np.array([-1e3, -8e3, -2e3 + 3e4j, -2e3 - 3e4j])
    for theta in arrangements(inputs, 1e-6):
        placed = np.append(mechanics_poles(theta), -np.exp(-theta[0]))
        for pole in inputs:
            assert np.min(np.abs(placed - pole)) < 1e-6 * abs(pole)
    assert len(arrangements(inputs, 1e-6)) > 2
