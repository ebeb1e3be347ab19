"""What modelDescription.xml claims about an FMU, measured on its binary."""

from collections.abc import Iterator
from ctypes import c_double, c_size_t

import numpy as np
import numpy.typing as npt

from psa_casadi.export.fmi2_functions import FUNCTIONS
from psa_casadi.export.fmu_instance import MODEL_EXCHANGE, Fmu, Instance
from psa_casadi.model.compose import Model

FloatArray = npt.NDArray[np.float64]
_POINTS = 3


def missing_functions(fmu: Fmu) -> Iterator[str]:
    """Every function of both interfaces is in the binary, as importers look them all up."""
    for name in FUNCTIONS:
        if not hasattr(fmu.library, "fmi2" + name):
            yield f"fmi2{name} is missing"


def undefined_units(fmu: Fmu) -> Iterator[str]:
    """Every Real variable has a unit, with a definition; so has its display unit."""
    defined = {u.name: {d.name for d in u.displayUnits} for u in fmu.description.unitDefinitions}
    for variable in fmu.description.modelVariables:
        if variable.type != "Real":
            continue
        if variable.unit not in defined:
            yield f"'{variable.name}' has the unit '{variable.unit}', which is not defined"
        elif variable.displayUnit and variable.displayUnit not in defined[variable.unit]:
            yield f"'{variable.name}' has the undefined display unit '{variable.displayUnit}'"


def _random_point(fmu: Fmu, generator: np.random.Generator) -> dict[str, float]:
    """Return values of time, states, inputs and parameters; no gain is 0, all keep their bounds."""
    point = {"time": float(generator.uniform(0.1, 1.0))}
    for v in fmu.description.modelVariables:
        if v.causality == "parameter":
            start = float(v.start) or 0.1 * fmu.nominals[v.name]
            value = start * generator.uniform(0.95, 1.05)
            point[v.name] = min(max(value, float(v.min or -np.inf)), float(v.max or np.inf))
    for name in (*fmu.states(), *fmu.names("input")):
        point[name] = float(fmu.nominals[name] * generator.uniform(-1.0, 1.0))
    return point


def _evaluate(instance: Instance, point: dict[str, float], unknowns: list[str]) -> FloatArray:
    """Return unknowns at a point."""
    fmu = instance.fmu
    states = np.array([point[n] for n in fmu.states()])
    others = {n: v for n, v in point.items() if n not in fmu.states() and n != "time"}
    instance.derivatives(point["time"], states, others)
    return instance.get(unknowns)


def incomplete_dependencies(fmu: Fmu) -> Iterator[str]:
    """Whatever moves an output or a derivative is among its dependencies, parameters included."""
    generator = np.random.default_rng(1)
    entries = [*fmu.description.outputs, *fmu.description.derivatives]
    claimed: dict[str, set[str]] = {}
    for entry in entries:
        if entry.dependencies is None:
            yield f"'{entry.variable.name}' lists no dependencies"
        claimed[entry.variable.name] = {d.name for d in entry.dependencies or []}
    unknowns = list(claimed)
    found: set[tuple[str, str]] = set()
    with fmu.start(MODEL_EXCHANGE) as instance:
        for _ in range(_POINTS):
            point = _random_point(fmu, generator)
            here = _evaluate(instance, point, unknowns)
            for known in point:
                moved = {**point, known: point[known] * 1.01}
                changed = _evaluate(instance, moved, unknowns) != here
                found |= {(u, known) for u, c in zip(unknowns, changed, strict=True) if c}
    for unknown, known in sorted(found):
        if known not in claimed[unknown]:
            yield f"'{unknown}' depends on '{known}', which its dependencies do not list"


def directional_error(fmu: Fmu) -> float:
    """Return the largest difference of directional derivatives from central differences.

    Relative to the size of each unknown's derivative in nominal units of the knowns.
    """
    generator = np.random.default_rng(2)
    unknowns = [u.variable.name for u in (*fmu.description.outputs, *fmu.description.derivatives)]
    worst = 0.0
    with fmu.start(MODEL_EXCHANGE) as instance:
        for _ in range(_POINTS):
            point = _random_point(fmu, generator)
            knowns = [k for k in point if k != "time"]
            seeds = np.array([fmu.nominals[k] * generator.uniform(-1.0, 1.0) for k in knowns])
            step = 1e-6
            ends = []
            for sign in (1.0, -1.0):
                moved = {k: point[k] + sign * step * d for k, d in zip(knowns, seeds, strict=True)}
                ends.append(_evaluate(instance, {**point, **moved}, unknowns))
            here = _evaluate(instance, point, unknowns)
            exact = _directional(instance, unknowns, knowns, seeds)
            difference = np.abs((ends[0] - ends[1]) / (2.0 * step) - exact)
            worst = max(worst, float(np.max(difference / (np.abs(exact) + np.abs(here) + 1e-300))))
    return worst


def _directional(
    instance: Instance, unknowns: list[str], knowns: list[str], seeds: FloatArray
) -> FloatArray:
    result = (c_double * len(unknowns))()
    instance.require(
        "GetDirectionalDerivative",
        instance.references(unknowns), c_size_t(len(unknowns)),
        instance.references(knowns), c_size_t(len(knowns)),
        (c_double * len(knowns))(*seeds), result,
    )  # fmt: skip
    return np.array(result)


def equation_error(fmu: Fmu, model: Model) -> float:
    """Return the largest relative difference of derivatives and outputs from the model's."""
    generator = np.random.default_rng(3)
    unknowns = [*(f"der({n})" for n in model.state_names), *model.output_names]
    worst = 0.0
    with fmu.start(MODEL_EXCHANGE) as instance:
        for _ in range(_POINTS):
            point = _random_point(fmu, generator)
            found = _evaluate(instance, point, unknowns)
            vectors = [
                np.array([point[n] for n in names])
                for names in (model.state_names, model.input_names, model.parameter_names)
            ]
            xdot, y = model.structure.f(point["time"], *vectors)
            expected = np.concatenate([np.array(xdot).ravel(), np.array(y).ravel()])
            size = np.abs(expected) + np.abs(found) + 1e-300
            worst = max(worst, float(np.max(np.abs(found - expected) / size)))
    return worst


def wrong_start_values(fmu: Fmu, model: Model) -> Iterator[str]:
    """The parameters' start values are the model's values."""
    starts = {v.name: v.start for v in fmu.description.modelVariables if v.causality == "parameter"}
    for name, value in model.values.items():
        if name not in starts:
            yield f"the parameter '{name}' of the model is not in the FMU"
        elif float(starts[name]) != value:
            yield f"'{name}' starts at {starts[name]}, the model has {value!r}"
