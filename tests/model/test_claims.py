"""Every effect's claims, measured: one test for all entries of the table."""

import ctypes
import random
from functools import cache

import casadi as ca
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray, convert
from psa_casadi.model.component import READ_OFF, RECORD_DURATION
from psa_casadi.model.compose import Structure
from psa_casadi.model.variables import nominal_value
from psa_casadi.simulation.compiler import functions_of, generate_c, shared_library
from psa_casadi.simulation.simulate import input_samples
from tests.model.random_models import Point, random_model, random_point
from tests.tiers import slow, slow_but

ALL = tuple(psa.EFFECTS.values())
_draw = random.Random(20)  # pairs and triples: all of them would take too long
SETS = [
    *((e,) for e in ALL),
    *(tuple(_draw.sample(ALL, size)) for size in (2, 3) for _ in range(15)),
    ALL,
]
#: All effects at once take long to compile.
EVERY = pytest.param(ALL, marks=slow)
every_effect = pytest.mark.parametrize("effect", ALL, ids=lambda e: e.name)
#: What runs the compiled model is tried with every fourth effect in the quick tier.
each_in_turn = pytest.mark.parametrize("effect", slow_but(ALL[::4], ALL), ids=lambda e: e.name)


def name_of(effects: tuple[psa.Component, ...]) -> str:
    return "all" if effects == ALL else "+".join(e.name for e in effects) or "base"


#: The functions of model.h that the Python side compiles, visible from outside the library.
_EXPORTS = """\
#include "model.h"
#define FACE(name) __attribute__((visibility("default"))) int test_##name
#define POINT double t, const double *x, const double *u, const double *p
static double w[PSA_SZ_W];
FACE(ode)(POINT, double *a) { return psa_model_ode(t, x, u, p, a, w); }
FACE(jacobian)(POINT, double *a) { return psa_model_jacobian(t, x, u, p, a, w); }
FACE(outputs)(POINT, double *a) { return psa_model_outputs(t, x, u, p, a, w); }
FACE(switches)(POINT, double *a) { return psa_model_switches(t, x, u, p, a, w); }
FACE(sensitivity)(POINT, double *a, double *b) {
    return psa_model_sensitivity(t, x, u, p, a, b, w);
}
FACE(output_sensitivity)(POINT, double *a, double *b) {
    return psa_model_output_sensitivity(t, x, u, p, a, b, w);
}
"""


@cache
def compiled(structure: Structure) -> ctypes.CDLL:
    texts = generate_c(structure, sensitivities=True) | {"exports.c": _EXPORTS}
    return ctypes.CDLL(str(shared_library(texts, ["model_casadi.c"])))


def values_of(model: psa.Model, point: Point) -> list[FloatArray]:
    """Return x' and the outputs as CasADi evaluates them."""
    result = model.structure.f(point.time, point.x, point.u, model.parameter_vector())
    return [np.array(part).ravel() for part in result]


def c_values(model: psa.Model, name: str, point: Point, sizes: list[int]) -> list[FloatArray]:
    """Call one compiled function; its results have these sizes."""
    results = [np.full(size, np.nan) for size in sizes]
    arrays = (point.x, point.u, model.parameter_vector(), *results)
    function = getattr(compiled(model.structure), f"test_{name}")
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in arrays]
    assert function(ctypes.c_double(point.time), *pointers) == 0
    return results


def drive(
    model: psa.Model, samples: int, sample_time: float, start: float
) -> tuple[FloatArray, FloatArray]:
    """Return times and inputs that begin at rest; two tones make minor loops."""
    t = np.linspace(0.0, (samples - 1) * sample_time, samples)
    voltage = 40.0 * (1.0 - np.cos(6e3 * t)) + 20.0 * np.sin(15e3 * t) ** 2
    return start + t, inputs_of(model, t, voltage, 50.0 * np.sin(4e3 * t))


def inputs_of(model: psa.Model, t: FloatArray, voltage: FloatArray, load: FloatArray) -> FloatArray:
    """Return the samples of all inputs; a temperature climbs by three kelvin from its reference."""
    table = {"voltage": voltage, "load_force": load}
    if "temperature" in model.input_names:
        table["temperature"] = model.values["temperature_reference"] + 3.0 * t / t[-1]
    return input_samples(model, len(t), table)


def start_of(effect: psa.Component, model: psa.Model) -> FloatArray:
    """Return all states at 0, or at the first of the effect's trial starts."""
    start = np.zeros(len(model.state_names))
    for name, value in (effect.trial_starts[0] if effect.trial_starts else {}).items():
        start[model.state_names.index(name)] = value
    return start


@pytest.mark.parametrize("effects", SETS, ids=name_of)
def test_gain_0_is_the_base_exactly(effects: tuple[psa.Component, ...]) -> None:
    generator = np.random.default_rng(1)
    for _ in range(10):
        model = random_model(effects, generator, gains=False)
        base = model.without(e.name for e in effects)
        point = random_point(model, generator)
        nx, nu = len(base.state_names), len(base.input_names)
        assert model.state_names[:nx] == base.state_names
        assert model.input_names[:nu] == base.input_names
        rate, outputs = values_of(model, point)
        base_point = Point(point.time, point.x[:nx], point.u[:nu])
        base_rate, base_outputs = values_of(base, base_point)
        assert np.isfinite(rate).all()
        np.testing.assert_array_equal(rate[:nx], base_rate)
        np.testing.assert_array_equal(outputs, base_outputs)


@each_in_turn
def test_a_gain_changes_what_is_measured(effect: psa.Component) -> None:
    """At its ordinary size every effect shows: by more than 1e-4 of the stroke, and alone."""
    model = random_model((effect,), np.random.default_rng(3), gains=True)
    sizes = effect.finite_step or (1.0,)
    gain = model.parameter(str(effect.gain))
    step = sizes[-1] * gain.typical(model.values)
    t = np.linspace(0.0, 2.0, 4001)
    voltage = 50.0 * (1.0 - np.cos(2 * np.pi * t)) + 20.0 * (t > 0.7)
    u = inputs_of(model, t, voltage, np.zeros_like(t))
    start = start_of(effect, model)
    off, on = [
        psa.run(model.with_values({gain.name: g}), t, u, start).y[:, -1] for g in (0.0, step)
    ]
    assert np.abs(on - off).max() > 1e-4 * np.ptp(off)


@every_effect
def test_declaration_is_complete(effect: psa.Component) -> None:
    for text in (effect.description, effect.source, effect.looks_like, effect.equation_text):
        assert len(text) > 10
    assert effect.belongs_to in ("plant", "drive", "sensor", "environment")
    names = [p.name for p in effect.parameters]
    gain = next(p for p in effect.parameters if p.name == effect.gain)
    assert gain.value == 0.0
    assert gain.scale is not None
    assert gain.name in effect.equation_text or gain.name == effect.name
    for name, values in effect.probe.items():
        assert name in names
        assert name != effect.gain
        low, high = next(p.bounds for p in effect.parameters if p.name == name)
        if isinstance(values, str):
            assert values in (*READ_OFF, RECORD_DURATION)
        else:
            assert values
            assert all(low <= v <= high for v in values)


def _model_with(component: psa.Component) -> psa.Model:
    """Return a model that a component is in: a part, else a stack, with what may be added to it."""
    for part in psa.PARTS.values():
        if component.name in part.components and component not in psa.BASE:
            return psa.part_model(part.name)
    if component in psa.SIMPLIFIED and component not in psa.BASE:
        return psa.compose(psa.SIMPLIFIED)
    if component.name == "memory_spectrum":
        return psa.compose([component if c.name == "bouc_wen" else c for c in psa.BASE])
    added = [component] if component not in (*psa.BASE, *ALL) else []
    model = psa.compose([*psa.BASE, *ALL, *added])
    assert component in model.components
    return model


@pytest.mark.parametrize("component", [*psa.COMPONENTS.values(), *ALL], ids=lambda c: c.name)
def test_variables_have_units_bounds_and_sizes(component: psa.Component) -> None:
    model = _model_with(component)
    for parameter in component.parameters:
        low, high = parameter.bounds
        assert low <= parameter.value <= high
        assert low > 0.0 or not parameter.log
        assert parameter.typical(model.values) > 0.0
    sizes = dict(zip(model.state_names, model.state_nominals(), strict=True))
    assert all(0.0 < sizes[s.name] < 1e6 for s in component.states)
    held = [nominal_value(s.nominal, model.values) for s in component.sampled]
    assert all(0.0 < size < 1e6 for size in held)
    signals: list[psa.Input | psa.Output] = [*component.inputs, *component.outputs]
    assert all(0.0 < nominal_value(v.nominal, model.values) < 1e6 for v in signals)
    variables: list[psa.Parameter | psa.State | psa.Input | psa.Output] = [*component.parameters]
    variables += [*component.states, *component.sampled, *signals]
    for variable in variables:
        assert len(variable.description) > 3
        unit = variable.display_unit or variable.unit
        assert convert(1.0, variable.unit, unit) > 0.0


@pytest.mark.parametrize("effects", [(), EVERY], ids=name_of)
def test_c_value_is_the_casadi_value(effects: tuple[psa.Component, ...]) -> None:
    generator = np.random.default_rng(4)
    for gains in (True, True, True, False):
        model = random_model(effects, generator, gains=gains)
        point = random_point(model, generator)
        functions = functions_of(model.structure, sensitivities=True)
        at = [ca.DM(v) for v in (point.time, point.x, point.u, model.parameter_vector())]
        rate, outputs = model.structure.f.call(at)
        for name, function in functions.items():
            plain = {"psa_ode": [rate], "psa_outputs": [outputs]}
            expected = plain.get(name) or function.call(at)
            wanted = [np.array(e).ravel(order="F") for e in expected]
            sizes = [w.size for w in wanted]
            arrays = c_values(model, name.removeprefix("psa_"), point, sizes)
            for ours, theirs in zip(arrays, wanted, strict=True):
                np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=0, err_msg=name)


@each_in_turn
def test_sensitivities_are_differences_of_runs(effect: psa.Component) -> None:
    """Steps that end at a reversal move with the parameters; their lengths count as constant."""
    model = random_model((effect,), np.random.default_rng(6), gains=True)
    unknowns = [*(p.name for p in effect.parameters), "k_L", "A", "beta", "gamma", "tau", "k_B"]
    t, u = drive(model, 4001, 5e-7, 5.0)
    start = start_of(effect, model)
    # what delays the voltage moves its reversals, where delta u sgn(u') jumps
    allowed = 5e-3 if effect.belongs_to == "drive" else 5e-4
    # thresholds that follow the rate fall within microseconds at a reversal
    rtol = 1e-9 if effect.name == "rate_dependent_hysteresis" else 1e-8
    exact = psa.run(model, t, u, start, rtol=rtol, unknowns=unknowns).sensitivity[:, -1]
    for column, name in enumerate(unknowns):
        # a tone turns many times; a small gain would drown in the stepper's error
        share = 3e-6 if name == effect.tone else 3e-2 if name == effect.gain else 3e-4
        step = share * model.parameter(name).typical(model.values)
        moved = [{**model.values, name: model.values[name] + h} for h in (step, -step)]
        ends = [psa.run(model, t, u, start, rtol=rtol, values=values).y for values in moved]
        result = (ends[0][:, -1] - ends[1][:, -1]) / (2 * step)
        size = np.abs(exact[:, column]).max()
        assert size > 0.0, name
        np.testing.assert_allclose(
            result, exact[:, column], rtol=0, atol=allowed * size, err_msg=name
        )
