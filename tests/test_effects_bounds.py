"""What holds for every plant effect: finite slopes, ordinary costs, no run-away, rest at a hold."""

import casadi as ca
import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.component import Component, Symbols
from psa_casadi.components import BASE, SIMPLIFIED
from psa_casadi.effects import EFFECTS
from psa_casadi.effects.strain import AGEING
from psa_casadi.model.compose import compose
from psa_casadi.scales import static_stiffness, stiffness_scale, stroke, stroke_scale
from psa_casadi.simulation.codegen import functions_of
from psa_casadi.simulation.simulate import simulate
from tests.effect_runs import (
    HYSTERESIS,
    driven,
    linear,
    ordinary,
    sine_and_steps,
)
from tests.random_models import random_model, random_point
from tests.stack_models import stack
from tests.tiers import slow

FloatArray = NDArray[np.float64]

PLANT = tuple(e for e in EFFECTS.values() if e.belongs_to == "plant")
#: Parameters of a curve's form.
ANGLES, WAVES = ("load_angle",), ("load_wave",)
every_effect = pytest.mark.parametrize("effect", PLANT, ids=lambda e: e.name)
every_base = pytest.mark.parametrize("base", [BASE, SIMPLIFIED], ids=["cascade", "single mass"])


def bounded(effect: Component) -> bool:
    """Whether the gain's bounds are within a thousand of its ordinary sizes."""
    model = ordinary(effect)
    gain = model.parameter(str(effect.gain))
    return max(map(abs, gain.bounds)) <= 1e3 * model.values[gain.name]


def has_room_in(base: tuple[Component, ...], effect: Component) -> bool:
    """Whether a base has what an effect needs."""
    return set(effect.needs) <= {c.name for c in base}


@every_base
def test_sizes_are_those_of_the_nominals(base: tuple[Component, ...]) -> None:
    values = compose(base).values
    assert static_stiffness(Symbols(values)) == pytest.approx(stiffness_scale(values))
    assert stroke(Symbols(values)) == pytest.approx(stroke_scale(values))


@every_effect
@every_base
def test_slopes_are_finite(effect: Component, base: tuple[Component, ...]) -> None:
    """At random points, at rest, and far away before time zero; with gain and without."""
    if not has_room_in(base, effect):
        pytest.skip(f"needs {effect.needs}")
    generator = np.random.default_rng(11)
    for gains in (False, True):
        model = random_model((effect,), generator, gains=gains, base=base)
        point = random_point(model, generator)
        for time, size in ((point.time, 1.0), (0.0, 0.0), (-5.0, 100.0)):
            p = ca.DM(model.parameter_vector())
            at = [ca.DM(time), ca.DM(size * point.x), ca.DM(size * point.u), p]
            for function in functions_of(model.structure, sensitivities=True).values():
                slopes = function.call(at)
                assert all(np.isfinite(np.array(part)).all() for part in slopes)


@every_effect
def test_ordinary_size_shows_and_costs_little(effect: Component) -> None:
    """Between 0.05 and 10 % of the range, at no more than 1.5 times the steps, at any probe.

    A further resonance costs the steps of its oscillation. A weight may be 0 beside others.
    """
    t, voltage = sine_and_steps()
    base = driven(stack("P-885.51"), t, voltage)
    grids = {n: grid for n, grid in effect.probe.items() if isinstance(grid, tuple)}
    grid = [{n: float(v)} for n, values in grids.items() for v in values]
    grid = [g for g in grid if any(g.values()) or not set(g) & set(effect.linear)]
    for values in grid or [{}]:
        found = driven(ordinary(effect, **values), t, voltage)
        change = np.abs(found.y[:, -1] - base.y[:, -1]).max() / np.ptp(base.y[:, -1])
        assert 5e-4 < change < 0.1, values
        assert effect.tone or found.steps <= 1.5 * base.steps, values


@pytest.mark.parametrize("effect", [e for e in PLANT if bounded(e)], ids=lambda e: e.name)
@pytest.mark.parametrize("end", [0, 1])
def test_no_gain_within_its_bounds_runs_away(effect: Component, end: int) -> None:
    """Within a thousand ordinary sizes: wider bounds say that stacks have no size in common."""
    t, voltage = sine_and_steps()
    bound = ordinary(effect).parameter(str(effect.gain)).bounds[end]
    grid = [{n: float(v)} for n, values in effect.probe.items() for v in values if n in ANGLES]
    waves = [{n: v} for n in WAVES for v in (-20.0, 20.0) if n in ordinary(effect).values]
    for shape in [{}, *grid, *waves]:
        model = ordinary(effect).with_values({str(effect.gain): bound, **shape})
        x = driven(model, t, voltage).y[:, -1]
        assert np.abs(x).max() < 3.0 * stroke_scale(model.values), shape


@pytest.mark.parametrize("effect", [e for e in PLANT if e is not AGEING], ids=lambda e: e.name)
@pytest.mark.parametrize(
    "base", [BASE, pytest.param(SIMPLIFIED, marks=slow)], ids=["cascade", "single mass"]
)
def test_a_held_voltage_holds_the_output(effect: Component, base: tuple[Component, ...]) -> None:
    """The start at 100 V is an equilibrium of the extended model; ageing alone goes on."""
    if not has_room_in(base, effect):
        pytest.skip(f"needs {effect.needs}")
    model = linear(effect, 0.3, base, **HYSTERESIS)
    x = simulate(model, np.arange(11) * 10.0, np.full(11, 100.0)).displacement
    assert x[0] > 0.3 * stroke_scale(model.values)
    assert np.ptp(x) < 1e-6 * x[0]
