"""The signatures of the plant's effects: each shows the figures that its equation promises."""

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.component import Component
from psa_casadi.components import BASE, SIMPLIFIED
from psa_casadi.effects.hysteresis import HYSTERESIS_MEMORY, RATE_DEPENDENT_HYSTERESIS
from psa_casadi.effects.mechanics import BACKLASH, LOAD_STIFFNESS, PRELOAD_LOSS
from psa_casadi.effects.strain import (
    AGEING,
    FIELD_DEPENDENT_GAIN,
    SATURATION_OF_STRAIN,
    SELF_HEATING,
)
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.scales import stiffness_scale, stroke_scale
from psa_casadi.simulation.simulate import simulate
from tests.effect_runs import (
    QUICK,
    driven,
    linear,
    third_harmonic,
    triangle,
)
from tests.plants.hysteresis_memory import play
from tests.stack_models import stack

FloatArray = NDArray[np.float64]

every_base = pytest.mark.parametrize("base", [BASE, SIMPLIFIED], ids=["cascade", "single mass"])


@pytest.mark.parametrize("peak", [120.0, 24.0])
def test_loop_width_follows_the_logarithm_of_rate(peak: float) -> None:
    """By rate_gain per decade to 10 %, at small and large loops; the stroke moves against it."""
    rates = np.array([0.05, 0.5, 5.0])

    def width_and_stroke(gain: float, frequency: float) -> tuple[float, float]:
        model = stack("P-885.51", **QUICK).with_effect(
            RATE_DEPENDENT_HYSTERESIS, {"rate_gain": gain, "rate_onset": 1e-3}
        )
        t, voltage = triangle(frequency, peak)
        found = driven(model, t, voltage)
        u, x = found.x[-401:, 0], found.y[-401:, -1]
        up = np.interp(peak / 2, u[:200], x[:200])
        down = np.interp(peak / 2, u[200:][::-1], x[200:][::-1])
        return float(down - up), float(np.ptp(x))

    shown = {g: np.log([width_and_stroke(g, f) for f in rates]) for g in (0.0, 0.05, -0.05)}
    for gain in (0.05, -0.05):
        width, reach = np.polyfit(np.log10(rates), shown[gain] - shown[0.0], 1)[0]
        assert width == pytest.approx(gain, rel=0.1)
        assert -0.5 < reach / gain < -0.05


@pytest.mark.parametrize("frequency", [0.05, 0.5])
def test_thresholds_that_grow_with_the_rate_widen_every_loop_alike(frequency: float) -> None:
    """By twice what 0.3 (c - 1) w of voltage does, from 2 w after a reversal on, nothing before."""
    values = {"rate_by_threshold": 1.0, "rate_threshold": 0.05, "rate_onset": 1e-3}
    widths = []
    for peak in (120.0, 48.0):
        model = linear(RATE_DEPENDENT_HYSTERESIS, 0.1).with_values(values)
        found = driven(model, *triangle(frequency, peak))
        u, x = found.x[-401:, 0] / 120.0, found.y[-401:, -1] / stroke_scale(model.values)
        behind = (x - x[200]) - (u - u[200])
        down, up = (
            np.interp(peak / 240.0, *pair)
            for pair in ((u[200:][::-1], x[200:][::-1]), (u[:200], x[:200]))
        )
        decades = np.log10(2.0 * peak * frequency / 120.0 / 1e-3)
        widths.append((down - up) / (2.0 * 0.3 * 0.05 * np.expm1(0.1 * decades)))
        assert np.ptp(behind[202:206]) < 0.05 * (down - up)
    assert widths == pytest.approx([1.0, 1.0], rel=0.02)


def test_rayleigh_gain_grows_with_amplitude() -> None:
    """Gain in proportion to the peak; third harmonic -8/(15 pi) of it, as its square."""
    peaks = np.array([30.0, 60.0, 120.0])
    gains = []
    for peak in peaks:
        t, voltage = triangle(1.0, peak, cycles=1)
        gains.append(np.ptp(driven(linear(FIELD_DEPENDENT_GAIN, 0.1), t, voltage).y[:, -1]) / peak)
    slope, start = np.polyfit(peaks / 120.0, gains, 1)
    assert slope / start == pytest.approx(0.1, rel=0.01)
    small, large = (third_harmonic(FIELD_DEPENDENT_GAIN, 0.1, peak) for peak in (50.0, 100.0))
    assert large[1] / small[1] == pytest.approx(4.0, rel=0.01)
    assert large[1] / large[0] == pytest.approx(
        -8 / (15 * np.pi) * 0.1 / (1.2 + 0.1 * 8 / (3 * np.pi)), rel=0.01
    )


def test_saturation_flattens_both_branches() -> None:
    """1/sqrt(1 + g) at rated voltage; third harmonic of the other sign than Rayleigh's, g a^2/8."""
    full = []
    for gain in (0.0, 0.2):
        t, voltage = triangle(1.0, 120.0, cycles=1)
        full.append(np.ptp(driven(linear(SATURATION_OF_STRAIN, gain), t, voltage).y[:, -1]))
    assert full[1] / full[0] == pytest.approx(1 / np.sqrt(1.2), rel=1e-4)
    first, third = third_harmonic(SATURATION_OF_STRAIN, 0.02, 60.0)
    assert third / first == pytest.approx(0.02 / 8 * 0.25, rel=0.01)


@every_base
@pytest.mark.parametrize(("volt", "force"), [(120.0, 0.0), (60.0, 0.0), (0.0, 900.0)])
def test_load_hardens_with_displacement(
    base: tuple[Component, ...], volt: float, force: float
) -> None:
    """k x + h k_s x^3 / x_s^2 = the force that holds the linear stack there, whoever exerts it."""
    t = np.linspace(0.0, 1.0, 201)
    angle, gain = np.arctan(0.2), 0.05  # a pure cubic
    model, plain = (linear(LOAD_STIFFNESS, g, base, load_angle=angle) for g in (gain, 0.0))
    x, free = (
        driven(m, t, volt * np.minimum(t / 0.5, 1.0), force).y[-1, -1] for m in (model, plain)
    )
    p = model.values
    k = p["k_B"] if "k_B" in p else p["k"]
    k_s, x_s = stiffness_scale(p), stroke_scale(p)
    h = 20.0 * gain * np.sin(angle)
    share = h * (x / x_s) ** 3
    load = k_s * x_s * share / np.sqrt(1.0 + (2.0 * share) ** 2)  # levels off at 0.5 k_s x_s
    assert k * x + load == pytest.approx(k * free, rel=1e-5)
    assert x < 0.97 * free


@every_base
def test_contact_kinks_the_curve_at_one_displacement(base: tuple[Component, ...]) -> None:
    """Slope 1 below, k / (k + g k_s) above, meeting at contact_position of the stroke."""
    t, voltage = triangle(0.5, 120.0, cycles=1)
    touched, free = (
        driven(linear(PRELOAD_LOSS, g, base, contact_position=0.45), t, voltage).y[:, -1]
        for g in (0.25, 0.0)
    )
    p = linear(PRELOAD_LOSS, 0.25, base).values
    k, k_s = p["k_B"] if "k_B" in p else p["k"], stiffness_scale(p)
    x_c = 0.45 * stroke_scale(p)
    for branch in (slice(2, 199), slice(202, 399)):
        below, above = free[branch] < 0.9 * x_c, free[branch] > 1.1 * x_c
        lines = [np.polyfit(free[branch][w], touched[branch][w], 1) for w in (below, above)]
        assert lines[0][0] == pytest.approx(1.0, abs=2e-3)
        assert lines[1][0] == pytest.approx(k / (k + 0.25 * k_s), abs=2e-3)
        meeting = (lines[1][1] - lines[0][1]) / (lines[0][0] - lines[1][0])
        assert meeting == pytest.approx(x_c, rel=0.01)


@pytest.mark.parametrize(
    "weights",
    [{"play": (0.05, 0.02, 0.0)}, {"square": (0.04, 0.0, -0.01)}, {"cube": (0.03, -0.02, 0.0)},
     {"play": (-0.02, 0.0, 0.01), "square": (0.08, 0.03, 0.0), "cube": (-0.05, 0.0, 0.0)}],
    ids=["plays", "squares", "cubes", "all"],
)  # fmt: skip
def test_memory_is_a_sum_of_plays_their_squares_and_cubes(
    weights: dict[str, tuple[float, float, float]],
) -> None:
    """Of ideal plays with the same weights and thresholds, to the roundness of its stops."""
    values = {f"memory_{name}_{k}": 0.0 for name in ("play", "square", "cube") for k in range(3)}
    values |= {f"memory_{name}_{k}": w for name, row in weights.items() for k, w in enumerate(row)}
    plain = linear(HYSTERESIS_MEMORY, 0.0)
    model = plain.with_values({"memory_gain": 1.0, "memory_threshold": 0.02, **values})
    t = np.linspace(0.0, 60.0, 6001)
    voltage = 60.0 * (1.0 - np.cos(2 * np.pi * t / 20.0)) * (1.0 - t / 90.0)
    shown = driven(model, t, voltage).y[:, -1] - driven(plain, t, voltage).y[:, -1]
    rated, expected = model.values["u_rated"], np.zeros_like(t)
    for i, ratio in enumerate((1.0, 2.5, 6.0, 15.0)):
        p = play(voltage, 0.02 * ratio * rated)
        for power, name in enumerate(("play", "square", "cube"), 1):
            terms = np.cos(np.pi * np.arange(3) * (i + 0.5) / 4) * weights.get(name, (0.0,) * 3)
            expected += np.sum(terms) * (voltage**power - p**power) / rated ** (power - 1)
    expected *= model.values["k_L"] * static_compliance(model.values)
    assert np.sqrt(np.mean((shown - expected) ** 2)) < 0.05 * np.ptp(expected)


@pytest.mark.parametrize("peak", [30.0, 120.0])
def test_backlash_dwells_over_the_gap(peak: float) -> None:
    """Whatever the amplitude: none of the first w of motion, 4 w of the first 6 w get through."""
    model = linear(BACKLASH, 1.0, backlash_width=0.01)
    w = 0.01 * stroke_scale(model.values)
    t, voltage = triangle(1.0, peak)
    found = driven(model, t, voltage)
    tip, shown = found.x[:, model.state_names.index("x")], found.y[:, -1]
    for first, sign in ((600, -1.0), (800, 1.0)):  # the last downward and the last upward branch
        moved = sign * (tip[first : first + 200] - tip[first])
        through = sign * (shown[first : first + 200] - shown[first])
        crossed = [float(np.interp(d * w, moved, through)) / w for d in (0.9, 2.0, 6.0)]
        assert crossed[0] < 0.01
        assert crossed[1] < 0.2
        assert crossed[2] == pytest.approx(4.0, abs=0.02)


def test_backlash_does_not_creep_at_a_hold() -> None:
    """Stopped in the middle of the gap after a reversal, the output stays there for 1000 s."""
    t = np.array([0.0, 1.0, 1.01, *np.linspace(1.1, 1000.0, 50)])
    voltage = np.interp(t, [0.0, 1.0, 1.01], [0.0, 60.0, 58.8])
    model = linear(BACKLASH, 1.0, backlash_width=0.01)
    found = driven(model, t, voltage)
    w = 0.01 * stroke_scale(model.values)
    assert abs(found.x[-1, -1]) < 0.8 * w
    assert np.ptp(found.y[3:, -1]) < 1e-6 * w


def test_self_heating_climbs_and_recovers() -> None:
    """By the area of the loop while it is driven; back with heating_time at a hold.

    What is lost is the loop's work less what the hysteresis stores, A f_H u' - (f_H^2/2)'.
    """
    cooling = 0.8
    t = np.arange(6001) / 1000.0
    voltage = np.where(t < 3.0, 60.0 * (1.0 - np.cos(2 * np.pi * 20.0 * t)), 60.0)
    model = stack("P-885.51", **{**QUICK, "delta": 0.0, "gamma": 0.0}).with_effect(
        SELF_HEATING, {"heating_gain": 0.02, "heating_time": cooling}
    )
    found = driven(model, t, voltage)
    states = dict(zip(model.state_names, found.x.T, strict=True))
    p = model.values
    h, u, a = states["f_H"], states["u"], p["A"]
    share = p["beta"] * p["h_ref"] * p["u_rated"]  # what makes one unit of heat, times |A|
    lost = 0.5 * (h[1:] + h[:-1]) * np.diff(u) * a - 0.5 * np.diff(h**2)
    fading = np.exp(-(t[3000] - 0.5 * (t[1:3001] + t[:3000])) / cooling)
    wanted = float(lost[:3000] @ fading) / share
    assert states["heat"][3000] == pytest.approx(wanted, rel=0.03)
    cold = driven(model.with_values({"heating_gain": 0.0}), t, voltage).y[:, -1]
    excess = (found.y[3100:, -1] - cold[3100:]) / cold[3100:]
    assert excess[0] == pytest.approx(0.02 * states["heat"][3100], rel=1e-3)
    rate = np.polyfit(t[3100:5000], np.log(excess[:1900]), 1)[0]
    assert -1.0 / rate == pytest.approx(cooling, rel=0.01)


def test_ageing_is_a_straight_line_in_log_time() -> None:
    """Of ageing_gain of the gain per decade, and nothing before time zero."""
    t = np.concatenate([[-20.0, -10.0, 0.0], np.geomspace(0.01, 100.0, 60)])
    model = linear(AGEING, 0.02, ageing_time=1e-3)
    x = simulate(model, t, np.full(t.size, 80.0)).displacement
    fresh = simulate(model.with_values({"ageing_gain": 0.0}), t, np.full(t.size, 80.0)).displacement
    lost = 1.0 - x / fresh
    assert np.abs(lost[:3]).max() < 1e-7
    slope = np.polyfit(np.log10(t[20:]), lost[20:], 1)[0]
    assert slope == pytest.approx(0.02, rel=1e-3)
    np.testing.assert_allclose(lost[20:], 0.02 * np.log10(1 + t[20:] / 1e-3), rtol=1e-4)
