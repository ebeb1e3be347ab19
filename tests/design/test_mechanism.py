"""The design of prestress mechanisms: closed forms, goals and limits."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import expm

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.design.mechanism.loop import (
    Mounting,
    bandwidth,
    mechanical_poles,
    mechanics_of,
    step_response,
)
from psa_casadi.design.mechanism.mechanism import Limits, MechanismDesign, mounted_model, root_locus

STACK = "PTBS200"
#: A mechanism of 60 g, 900 N.s/m, 8 N/um: enough to move every pole of the stack.
HEAVY = Mounting(0.06, 900.0, 8e6)


def assembled(p: Mapping[str, float], m: Mounting, acts_on: str, g: float = 0.0) -> FloatArray:
    """Return the state matrix of (y, y', x, x') of a mounted stack, from the forces on each mass.

    The mechanism's force m x'' + c x' + k x is taken off the wafers, or off the output mass, whose
    x'' is then divided by m_B + m. `g` is the share of the reaction on the wafers.
    """
    elastic = np.array([p["k_P"], p["c_P"], 0.0, 0.0])
    pull = np.array([-p["k_B"], -p["c_B"], p["k_B"], p["c_B"]])
    spring = np.array([0.0, 0.0, m.stiffness, m.damping])
    mass = p["m_B"] + (m.mass if acts_on == "tip" else 0.0)
    x_force = (1.0 - g) * elastic - pull - (spring if acts_on == "tip" else 0.0)
    a_x = x_force / mass
    held = m.mass * a_x + spring if acts_on == "wafers" else np.zeros(4)
    a_y = (-elastic + g * pull - held) / p["m_P"]
    return np.array([[0.0, 1.0, 0.0, 0.0], a_y, [0.0, 0.0, 0.0, 1.0], a_x])


@pytest.mark.parametrize("acts_on", ["wafers", "tip"])
@pytest.mark.parametrize("mounted", [0.0, 1.0])
def test_a_mounted_stack_is_the_two_equations_with_the_mechanism(
    acts_on: str, mounted: float
) -> None:
    design = replace(designed(damping=0.5), mounting=HEAVY, acts_on=acts_on)
    model = mounted_model(psa.stack_model(STACK), design).with_values({"mounted": mounted})
    s = model.structure
    rows = [model.state_names.index(n) for n in ("y", "v_y", "x", "v_x")]
    zero, u = np.zeros(len(s.states)), [i.start for i in s.inputs]
    result = np.array(s.slopes(0.0, zero, u, model.parameter_vector())[0])[np.ix_(rows, rows)]
    wanted = assembled(model.values, HEAVY if mounted else Mounting(0.0, 0.0, 0.0), acts_on)
    np.testing.assert_allclose(result, wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())


def test_a_load_on_the_mass_that_the_mechanism_pushes_on_is_refused() -> None:
    model = psa.stack_model(STACK).with_effect(psa.EFFECTS["load_stiffness"])
    design = designed(damping=0.5)
    assert "prestress_on_wafers" in [c.name for c in mounted_model(model, design).components]
    with pytest.raises(psa.InputError, match="push on the same mass"):
        mounted_model(model, replace(design, acts_on="tip"))


@cache
def designed(**wanted: float) -> MechanismDesign:
    """Return the design for the stack of these tests, within ordinary limits."""
    return psa.design_mechanism(psa.stack_model(STACK), limits=Limits(0.1), starts=3, **wanted)  # type: ignore[arg-type]


@pytest.mark.parametrize("acts_on", ["wafers", "tip"])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_closed_loop_poles_are_those_of_the_assembled_masses(acts_on: str, share: float) -> None:
    model = psa.stack_model(STACK)
    if share:
        model = model.with_effect(psa.EFFECTS["reciprocal_coupling"], {"reciprocal_gain": share})
    spectrum = mechanical_poles(mechanics_of(model, acts_on), HEAVY)
    expected = np.linalg.eigvals(assembled(model.values, HEAVY, acts_on, share))
    order = np.lexsort((expected.imag, np.round(np.abs(expected), 3)))
    mine = np.lexsort((spectrum.imag, np.round(np.abs(spectrum), 3)))
    assert spectrum[mine] == pytest.approx(expected[order], rel=1e-8)


def test_step_response_is_the_matrix_exponential_of_the_whole_chain() -> None:
    p = psa.stack_model(STACK).values
    A = np.zeros((6, 6))
    A[0, 0] = -1.0 / (p["R_s"] * p["C_p"])
    A[1, :2] = np.array([p["k_L"], -1.0]) / p["tau"]
    A[2:, 2:] = assembled(p, HEAVY, "wafers")
    A[3, 1] = 1.0 / p["m_P"]
    B = np.zeros(6)
    B[0] = p["u_rated"] / (p["R_s"] * p["C_p"])
    final = -np.linalg.solve(A, B)
    time = np.linspace(0.0, 1e-3, 41)
    states = np.array([final - expm(A * t) @ final for t in time])
    response = step_response(mechanics_of(psa.stack_model(STACK)), HEAVY, time)
    assert response.displacement == pytest.approx(states[:, 4], abs=1e-8 * final[4])
    speeds = (A @ states.T).T + B
    force = HEAVY.mass * speeds[:, 5] + HEAVY.damping * states[:, 5]
    force += HEAVY.stiffness * states[:, 4]
    assert response.force == pytest.approx(force, abs=1e-6 * np.abs(force).max())


def test_bandwidth_is_where_the_response_has_fallen_by_3_db() -> None:
    p = psa.stack_model(STACK).values
    A = assembled(p, HEAVY, "wafers")
    B, C = np.array([0.0, 1.0 / p["m_P"], 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 0.0])

    def size(f: float) -> float:
        return float(abs(C @ np.linalg.solve(2j * np.pi * f * np.eye(4) - A, B)))

    value = bandwidth(mechanics_of(psa.stack_model(STACK)), HEAVY)
    assert size(value) == pytest.approx(size(0.0) / np.sqrt(2.0), rel=1e-6)
    assert all(size(f) > size(value) for f in np.linspace(0.0, 0.999 * value, 200))


def test_wanted_damping_is_reached_within_the_limits() -> None:
    d = designed(damping=0.7)
    p = psa.stack_model(STACK).values
    poles = np.linalg.eigvals(assembled(p, d.mounting, "wafers"))
    ratio = float((-poles.real / np.abs(poles)).min())
    assert d.attained
    assert ratio == pytest.approx(d.reached.damping, rel=1e-6)
    assert ratio >= 0.7 * (1.0 - 1e-4)
    static = 1.0 / (1.0 / p["k_P"] + 1.0 / p["k_B"])
    lost = d.mounting.stiffness / (static + d.mounting.stiffness)
    assert d.reached.stroke_loss == pytest.approx(lost, rel=1e-9)
    assert lost <= 0.1 + 1e-9
    assert d.lag_pole == pytest.approx(-1.0 / p["tau"])


def test_no_neighbour_within_the_limits_is_damped_enough_and_wider() -> None:
    """The design for a damping has the largest bandwidth: random neighbours do not beat it."""
    d = designed(damping=0.7)
    m, draw = d.mounting, np.random.default_rng(0)
    beaten = 0
    for spread in (0.01, 0.1, 1.0):
        for _ in range(400):
            a, b, c = np.exp(spread * draw.normal(size=3))
            other = Mounting(a * m.mass, b * m.damping, min(c * m.stiffness, m.stiffness))
            poles = mechanical_poles(d.mechanics, other)
            damped = float((-poles.real / np.abs(poles)).min()) >= d.reached.damping - 1e-6
            beaten += damped and bandwidth(d.mechanics, other) > 1.001 * d.reached.bandwidth
    assert beaten == 0


def test_force_limit_holds_and_an_unreachable_goal_is_reported() -> None:
    d = psa.design_mechanism(
        psa.stack_model(STACK), damping=0.7, limits=Limits(force=300.0), starts=1
    )
    time = np.linspace(0.0, 2e-3, 40001)
    peak = float(np.abs(step_response(d.mechanics, d.mounting, time).force).max())
    assert peak <= 300.0
    assert peak > 0.98 * 300.0
    assert not d.attained
    assert "force" in d.binding
    assert 0.03 < d.reached.damping < 0.7


def test_bandwidth_and_poles_as_goals() -> None:
    d = designed(bandwidth=5000.0)
    assert d.attained
    assert d.reached.bandwidth >= 5000.0 * (1.0 - 1e-3)
    assert d.reached.damping > 5.0 * d.free.damping
    wanted = mechanical_poles(mechanics_of(psa.stack_model(STACK)), HEAVY)
    again = psa.design_mechanism(
        psa.stack_model(STACK), poles=tuple(complex(p) for p in wanted), starts=2
    )
    assert again.attained
    assert again.mounting.mass == pytest.approx(HEAVY.mass, rel=1e-3)
    assert again.mounting.damping == pytest.approx(HEAVY.damping, rel=1e-3)
    assert again.mounting.stiffness == pytest.approx(HEAVY.stiffness, rel=1e-3)


def test_root_locus_runs_from_the_free_stack_to_the_design() -> None:
    d = designed(damping=0.7)
    branches = root_locus(d, np.linspace(0.0, 1.0, 400))
    assert np.sort_complex(branches[0]) == pytest.approx(np.sort_complex(d.free_poles), rel=1e-9)
    assert np.sort_complex(branches[-1]) == pytest.approx(np.sort_complex(d.poles), rel=1e-9)


def test_bad_wishes_are_all_reported_at_once() -> None:
    with pytest.raises(psa.InputError) as caught:
        psa.design_mechanism(
            psa.stack_model(STACK), damping=1.5, poles=(1.0 + 2.0j,),
            limits=Limits(stroke_loss=1.2, force=-1.0, mass=(2.0, 1.0)),
        )  # fmt: skip
    text = str(caught.value)
    for part in ("damping ratio 1.5", "leave one", "conjugate", "1.2", "-1 N", "mass"):
        assert part in text
    with pytest.raises(psa.InputError, match="two masses"):
        psa.design_mechanism(psa.mechanism_model(designed(damping=0.7)), damping=0.7)
