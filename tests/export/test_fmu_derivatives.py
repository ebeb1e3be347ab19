"""Directional and adjoint derivatives, at a point and through a co-simulation step.

CasADi's importer must see the right Jacobians, also those by parameters. It takes the sparsity
from the dependencies in modelDescription.xml, and is silently wrong where one is missing.
"""

import math
import zipfile
from collections.abc import Mapping, Sequence
from ctypes import c_double, c_size_t
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.importer.fmu import (
    DISCARD,
    ERROR,
    MODEL_EXCHANGE,
    OK,
    Instance,
)
from psa_casadi.model.variables import nominal_value
from tests.export.fmi3_instances import Instance3, Update, loaded
from tests.export.fmu_models import exported, model_named
from tests.tiers import slow_but

MODELS = ["P-885.51", "PTBS200", "manipulator", "slow_creep"]
#: Central differences of eighth order: f'(x) h is the sum of c_k (f(x + k h) - f(x - k h))
EIGHTH = {1: 4.0 / 5.0, 2: -1.0 / 5.0, 3: 4.0 / 105.0, 4: -1.0 / 280.0}


@cache
def _names(name: str) -> dict[str, list[str]]:
    """Return the variables of a model by kind."""
    kinds: dict[str, list[str]] = {}
    for variable in variable_table(model_named(name).plant()):
        kinds.setdefault(variable.kind, []).append(variable.name)
    return kinds


@cache
def _point(name: str) -> dict[str, float]:
    """Return values of states, inputs and parameters in full motion, away from every kink."""
    random = np.random.default_rng(20)
    point, model = {}, model_named(name).plant()
    sizes = dict(zip(model.state_names, model.state_nominals(), strict=True))
    for v in variable_table(model):
        if v.kind == "parameter":
            point[v.name] = _inside(float(v.start or 0.0), *(v.bounds or (-math.inf, math.inf)))
        elif v.kind in ("state", "input"):
            point[v.name] = float(sizes.get(v.name, v.nominal) or 1.0) * random.uniform(0.3, 0.6)
    # the voltage rises; the hysteresis force grows from where it is, without passing zero
    point["u"] = 0.5 * point["voltage"]
    point["f_H"] = math.copysign(point["f_H"], point["A"])
    return point


def _inside(value: float, low: float, high: float) -> float:
    """Return a value that differences, of up to 2 %, do not take out of its bounds."""
    room = 0.02 * abs(value)
    return min(max(value, low + room), high - room)


def _scales(names: Sequence[str], name: str) -> FloatArray:
    point = _point(name)
    return np.array([abs(point.get(n, 1.0)) or 1.0 for n in names])


def _jacobian(
    instance: Instance, unknowns: Sequence[str], knowns: Sequence[str], *, backwards: bool = False
) -> FloatArray:
    """Return d unknowns / d knowns, one product for each column or each row."""
    if backwards:
        rows = np.eye(len(unknowns))
        return np.array([instance.adjoint(unknowns, knowns, list(row)) for row in rows])
    columns = np.eye(len(knowns))
    return np.array([instance.directional(unknowns, knowns, list(c)) for c in columns]).T


def _worst(result: FloatArray, truth: FloatArray, scales: FloatArray) -> float:
    """Return the largest difference, each row relative to its largest effect."""
    effects = np.abs(truth * scales)
    rows = np.maximum(effects.max(axis=1), 1e-300)
    return float((np.abs((result - truth) * scales) / rows[:, None]).max())


def test_what_cannot_be_differentiated_is_refused() -> None:
    name, one, value = MODELS[0], c_size_t(1), (c_double * 2)()
    with Instance3(loaded(name), MODEL_EXCHANGE) as instance:
        instance.start()
        for kind in ("Directional", "Adjoint"):
            for unknown, known, reason in (
                ("u", "voltage", "'u' is not calculated"),
                ("voltage", "u", "'voltage' is not calculated"),
                ("current", "charge", "'charge' is calculated and cannot be varied"),
            ):
                vectors = (instance.references([unknown]), one, instance.references([known]), one)
                status = instance.call(f"Get{kind}Derivative", *vectors, value, one, value, one)
                assert status == ERROR
                assert reason in instance.messages[-1]
            status = instance.call(f"Get{kind}Derivative", *vectors, value, c_size_t(2), value, one)
            assert status == ERROR
            assert "scalars" in instance.messages[-1]


def _stepped(
    name: str, values: Mapping[str, float], sizes: Sequence[float], tolerance: float
) -> Instance3:
    """Return an instance that has done steps of these sizes with inputs held; free it."""
    instance = Instance3(loaded(name)).start(values, tolerance=tolerance)
    time = 0.0
    for size in sizes:
        assert instance.try_step(time, size).status == OK
        time += size
    return instance


@pytest.mark.parametrize("name", slow_but(MODELS[:1], MODELS))
def test_step_sensitivity_is_that_of_the_numbers_returned(name: str) -> None:
    """Against differences of eighth order of whole steps from changed starts."""
    kinds, point = _names(name), _point(name)
    states, outputs = kinds["state"], kinds["output"]
    knowns = [*states, *kinds["input"], *kinds["parameter"]]
    size, columns, output_columns = [1e-5], [], []
    for known in knowns:
        step = 2e-3 * (abs(point[known]) or 1.0)
        slope, output_slope = np.zeros(len(states)), np.zeros(len(outputs))
        for k, weight in EIGHTH.items():
            for sign in (1.0, -1.0):
                changed = {**point, known: point[known] + sign * k * step}
                with _stepped(name, changed, size, 1e-10) as instance:
                    slope += sign * weight * instance.get(states) / step
                    output_slope += sign * weight * instance.get(outputs) / step
        columns.append(slope)
        output_columns.append(output_slope)
    scales = _scales(knowns, name)
    with _stepped(name, point, size, 1e-10) as instance:
        exact = _jacobian(instance, states, knowns)
        back = _jacobian(instance, states, knowns, backwards=True)
        # chained: outputs through the step
        at_end = _jacobian(instance, outputs, knowns)
        at_end[:, : len(states)] = 0.0
        whole = at_end + _jacobian(instance, outputs, states) @ exact
    assert _worst(exact, np.array(columns).T, scales) < 1e-9
    assert _worst(whole, np.array(output_columns).T, scales) < 1e-9
    assert _worst(back, exact, scales) < 1e-13


def test_sensitivities_of_steps_multiply() -> None:
    """d x2/d x0 = d x2/d x1 d x1/d x0, where the second step starts with the first one's slope."""
    name, point = MODELS[0], _point(MODELS[0])
    states = _names(name)["state"]
    with _stepped(name, point, [2e-5], 1e-8) as instance:
        first = _jacobian(instance, states, states)
        assert instance.try_step(2e-5, 3e-5).status == OK
        second = _jacobian(instance, states, states)
    with _stepped(name, point, [5e-5], 1e-8) as instance:
        both = _jacobian(instance, states, states)
    assert _worst(second @ first, both, _scales(states, name)) < 1e-6
    assert _worst(second, both, _scales(states, name)) > 1e-3


def test_unknown_step_sensitivity_is_refused_with_the_reason() -> None:
    name, one = MODELS[0], c_size_t(1)
    value = (2 * c_double)()

    def watcher(instance: Instance3, update: Update) -> None:
        if update.set_requested:
            instance.set({"voltage": 10.0})

    with Instance3(loaded(name), watcher=watcher) as instance:
        instance.start({"voltage": 50.0})
        assert instance.try_step(0.0, 1e-3).status == OK
        vectors = (instance.references(["u"]), one, instance.references(["C_p"]), one)
        rest = (value, one, value, one)
        assert instance.call("GetDirectionalDerivative", *vectors, *rest) == DISCARD
        assert "changed within it" in instance.messages[-1]
        instance.directional(["current"], ["u"], [1.0])
    with Instance3(loaded(name)) as instance:
        instance.start({"voltage": 1e300})
        assert instance.try_step(0.0, 1e-3).status == DISCARD
        assert instance.call("GetAdjointDerivative", *vectors, *rest) == DISCARD
        assert "that step failed" in instance.messages[-1]


def imported(name: str, fmi: int, directory: Path, **options: Any) -> ca.Function:
    """Return f(x, u, p) -> (ode, y) of an FMU as CasADi imports it."""
    with zipfile.ZipFile(exported(name, fmi)) as archive:
        archive.extractall(directory)
    builder = ca.DaeBuilder("stack", str(directory))
    return builder.create("f", ["x", "u", "p"], ["ode", "y"], options)


def symbolic(model: psa.Model) -> ca.Function:
    """Return the same f of the model itself."""
    sizes = (len(model.state_names), len(model.input_names), len(model.parameter_names))
    x, u, p = (ca.MX.sym(n, size) for n, size in zip("xup", sizes, strict=True))
    return ca.Function("rates", [x, u, p], list(model.structure.f(0.0, x, u, p)))


def a_point(model: psa.Model) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return states, inputs and parameters of ordinary size, none of them 0."""
    generator = np.random.default_rng(4)
    x = model.state_nominals() * generator.uniform(0.1, 1.0, len(model.state_names))
    sizes = np.array([nominal_value(i.nominal, model.values) for i in model.structure.inputs])
    return x, sizes * generator.uniform(0.2, 1.0, len(sizes)), model.parameter_vector()


def blocks(f: ca.Function, model: psa.Model) -> dict[str, FloatArray]:
    """Return d(ode, y)/d(x), /d(u), /d(p) at the point, block by block."""
    result = f.jacobian()(*a_point(model), 0, 0)
    names = ("ode by x", "ode by u", "ode by p", "y by x", "y by u", "y by p")
    return {n: np.array(ca.densify(block)) for n, block in zip(names, result, strict=True)}


def by_expression(f: ca.Function, model: psa.Model) -> FloatArray:
    """Return the whole Jacobian of an expression that calls f; CasADi chooses the mode."""
    point = a_point(model)
    symbols = [ca.MX.sym(n, len(v)) for n, v in zip("xup", point, strict=True)]
    whole = ca.densify(ca.jacobian(ca.vertcat(*f(*symbols)), ca.vertcat(*symbols)))
    return np.array(ca.Function("j", symbols, [whole])(*point))


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize(
    "name", slow_but(["P-885.51"], ["P-885.51", "slow_creep", "single_mass", "flexure"])
)
def test_jacobians(name: str, fmi: int, tmp_path: Path) -> None:
    model = model_named(name).plant()
    expected, result = (blocks(f, model) for f in (symbolic(model), imported(name, fmi, tmp_path)))
    assert set(result) == set(expected)
    for block, entries in expected.items():
        assert block == "y by u" or np.any(entries), block
        assert result[block] == pytest.approx(entries, rel=1e-10, abs=0.0), block


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_jacobians_forwards_and_backwards(weight: float, fmi: int, tmp_path: Path) -> None:
    """Forwards by directional derivatives, backwards (of FMI 3) by adjoint derivatives."""
    model = model_named("P-885.51").plant()
    # one seed at a time: CasADi 3.8.2 mixes up the results of several adjoint seeds
    f = imported("P-885.51", fmi, tmp_path, ad_weight=weight, max_num_dir=1)
    expected = by_expression(symbolic(model), model)
    for columns in np.split(expected, [7, 9], axis=1):
        assert np.count_nonzero(columns) > 3
    assert by_expression(f, model) == pytest.approx(expected, rel=1e-10, abs=0.0)
