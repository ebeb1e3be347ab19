"""What an effect adds along a model's course is what a simulation with the effect adds."""

import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.model.ports import ports_of, with_ports
from psa_casadi.simulation.simulate import Way, input_samples, trace
from psa_casadi.simulation.start import start_for
from psa_casadi.simulation.tangent import answer, course_of, law_of, opened
from tests.any_model.own_models import oscillator

_WAY = Way(1e-8, 1e-8)


def _both(
    base: psa.Model, effect: psa.Component, t: FloatArray, u: FloatArray,
    output: str = "measured_displacement", *, step: float = 0.0,
) -> tuple[FloatArray, FloatArray, float]:  # fmt: skip
    """Return what an effect adds (n,) along the course and in a simulation, and the error."""
    model = base.with_effect(effect).with_values({effect.gain or "": step})
    law = law_of(model.structure, effect)
    assert law is not None
    start = {s.name: 0.0 for s in model.structure.states if s.memory}
    table = {n: v for n, v in start.items() if n in base.state_names}
    course = course_of(base, t, u, table, way=_WAY, hold="linear", outputs=[output])
    result = answer(
        opened(base, [law]), law, model, course, u, start,
        finite=step != 0.0, way=_WAY, outputs=[output],
    )  # fmt: skip
    begin = start_for(model, t, u, start)
    column = model.parameter_names.index(effect.gain or "")
    whole = trace(
        model, t, u, begin.x, way=_WAY, outputs=[output], unknowns=[effect.gain or ""],
        s0=begin.by_parameter[:, [column]],
    )  # fmt: skip
    simulated = whole.y[:, 0] if step else whole.sensitivity[:, 0, 0]
    return result.y[:, 0, 0], simulated, result.error


#: Of a current limit the derivative at 0 is 0.
_LAWS = [
    e for e in psa.EFFECTS.values()
    if not (e.inputs or e.needs_column or e.trial_starts or e.name == "current_limit")
    and law_of(psa.compose([*psa.BASE, e]).structure, e) is not None
]  # fmt: skip


def _drive() -> tuple[FloatArray, FloatArray]:
    t = np.linspace(0.0, 2.0, 2001)
    swing = np.sin(2 * np.pi * 1.7 * t) + 0.3 * np.sin(2 * np.pi * 11.0 * t)
    return t, input_samples(psa.compose(psa.BASE), t.size, {"voltage": 50.0 + 30.0 * swing})


def _shown(model: psa.Model, t: FloatArray, u: FloatArray) -> FloatArray:
    x0 = start_for(model, t, u, {}).x
    return trace(model, t, u, x0, way=_WAY, outputs=["measured_displacement"]).y[:, 0]


@pytest.mark.parametrize("effect", _LAWS, ids=lambda e: e.name)
def test_derivatives_along_the_course_are_those_of_the_whole_model(effect: psa.Component) -> None:
    t, u = _drive()
    added, simulated, error = _both(psa.compose(psa.BASE), effect, t, u)
    size = np.std(simulated)
    assert size > 0.0
    assert np.std(added - simulated) < max(4e-3, error) * size


def test_most_effects_of_the_table_need_no_simulation_of_their_own() -> None:
    names = {e.name for e in _LAWS}
    assert len(names) >= 16
    assert not names & {"backlash", "hysteresis_memory", "rate_independent_asymmetry"}


@pytest.mark.parametrize(
    ("name", "size"), [("charge_leakage", 0.3), ("sensor_lag", 6e-3), ("drive_lag", 6e-3)]
)
def test_finite_gains_are_those_of_the_whole_model(name: str, size: float) -> None:
    t, u = _drive()
    added, simulated, error = _both(psa.compose(psa.BASE), psa.EFFECTS[name], t, u, step=size)
    effect = np.std(simulated - _shown(psa.compose(psa.BASE), t, u))
    assert np.std(added - simulated) < max(5e-3, error) * effect


def test_steps_that_the_samples_do_not_show_raise_the_error() -> None:
    """Self-heating by the voltage's way within a sample, and a lag of a millisecond."""
    t = np.linspace(0.0, 2.0, 201)
    steps = 50.0 + 30.0 * np.sign(np.sin(2 * np.pi * 3.0 * t))
    u = input_samples(psa.compose(psa.BASE), t.size, {"voltage": steps})
    for name in ("self_heating", "drive_lag"):
        *_, error = _both(psa.compose(psa.BASE), psa.EFFECTS[name], t, u)
        assert error > 0.1


def test_an_effect_with_states_at_two_ports_of_any_model() -> None:
    model = oscillator()
    names = {p.balance: p for p in ports_of(model)}
    rate = next(p for b, p in names.items() if b.startswith("rate_"))
    output = next(p for b, p in names.items() if b.startswith("shown_"))

    def equations(s: psa.Symbols) -> psa.Equations:
        x = getattr(s, model.state_names[0])
        return psa.Equations(
            der={"warmth": x**2 - s.warmth / s.cooling},
            add={rate.balance: -s.softening * s.warmth * x, output.balance: s.softening * s.warmth},
        )

    effect = psa.Component(
        name="softening", description="it softens with what it has moved", source="a test",
        equations=equations, gain="softening",
        parameters=(
            psa.Parameter("softening", 0.0, "1", (-1e3, 1e3), "size", scale=1.0),
            psa.Parameter("cooling", 0.7, "s", (1e-3, 1e3), "time"),
        ),
        states=(psa.State("warmth", "1", "what it remembers", 1.0),),
    )  # fmt: skip
    t = np.linspace(0.0, 6.0, 3001)
    u = np.stack([np.sin(3.0 * t + k) for k in range(len(model.input_names))], axis=1)
    added, simulated, error = _both(with_ports(model), effect, t, u, model.output_names[0])
    assert np.std(added - simulated) < max(1e-3, error) * np.std(simulated) > 0.0
