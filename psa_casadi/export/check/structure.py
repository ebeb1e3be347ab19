"""What modelDescription.xml claims about an FMU, measured on its binary."""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from psa_casadi.export.check.truth import Truth
from psa_casadi.export.common.variable_table import START_VOLTAGE
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, Instance

FloatArray = npt.NDArray[np.float64]
_POINTS = 3
#: Knowns and unknowns whose derivatives through a step are compared.
_MOST = 24
#: Difference that rounding may make, as a share of the nominal value.
_ROUNDING = 1e-12
#: A row whose entries are below this share of its unknown's value moves nothing; it is rounding.
_NOTHING = 1e-6


def random_point(fmu: Fmu, generator: np.random.Generator) -> dict[str, float]:
    """Return values of time, states, inputs and parameters; no gain is 0, all keep their bounds.

    Parameters stay so far inside that they can be moved by 1 % and differentiated.
    """
    point = {"time": float(generator.uniform(0.1, 1.0))}
    bounds = fmu.bounds
    for v in fmu.description.modelVariables:
        if v.variability == "tunable":
            start = float(v.start) or 0.1 * fmu.nominals[v.name]
            value = start * generator.uniform(0.95, 1.05)
            low, high = bounds[v.name]
            margin = min(0.02 * max(abs(value), fmu.nominals[v.name]), 0.25 * (high - low))
            point[v.name] = min(max(value, low + margin), high - margin)
    for name in (*fmu.states(), *fmu.names("input")):
        point[name] = float(fmu.nominals[name] * generator.uniform(-1.0, 1.0))
    return point


def evaluate(instance: Instance, point: dict[str, float], unknowns: list[str]) -> FloatArray:
    """Return unknowns at a point."""
    fmu = instance.fmu
    states = np.array([point[n] for n in fmu.states()])
    others = {n: v for n, v in point.items() if n not in fmu.states() and n != "time"}
    instance.derivatives(point["time"], states, others)
    return instance.get(unknowns)


def held_values(instance: Instance) -> list[FloatArray]:
    """Return the vector of the sampled states in a list; an empty list if there are none."""
    names = instance.fmu.sampled()
    return [instance.get(names)] if names else []


def sampled_starts(fmu: Fmu, generator: np.random.Generator) -> dict[str, float]:
    """Return values of the sampled states to start from, within their nominals."""
    return {n: float(fmu.nominals[n] * generator.uniform(-1.0, 1.0)) for n in fmu.sampled()}


def wrong_nominals(fmu: Fmu) -> Iterator[str]:
    """Nominal values are positive; those of the states are the same in description and binary."""
    for name, nominal in fmu.nominals.items():
        if not 0.0 < nominal < math.inf:
            yield f"'{name}' has the nominal value {nominal:g}"
    states = fmu.states()
    with fmu.start(MODEL_EXCHANGE) as instance:
        found = instance.vector("GetNominalsOfContinuousStates", len(states))
    for name, nominal in zip(states, found, strict=True):
        if nominal != fmu.nominals[name]:
            yield f"'{name}' has another nominal value in the binary, {nominal:g}"


def incomplete_dependencies(fmu: Fmu) -> Iterator[str]:
    """Whatever moves an output, derivative or indicator is listed, parameters included."""
    generator = np.random.default_rng(1)
    described = fmu.description
    entries = [*described.outputs, *described.derivatives, *described.initialUnknowns]
    entries += described.eventIndicators if fmu.version == 3 else []
    for entry in entries:
        if entry.dependencies is None:
            yield f"'{entry.variable.name}' lists no dependencies"
    unknowns = list(dict.fromkeys(e.variable.name for e in entries))
    found: dict[str, set[str]] = {name: set() for name in unknowns}
    starts = sampled_starts(fmu, np.random.default_rng(6))
    with fmu.start(MODEL_EXCHANGE, values=starts) as instance:
        for _ in range(_POINTS):
            point = random_point(fmu, generator)
            here = evaluate(instance, point, unknowns)
            for known in point:
                moved = {**point, known: point[known] * 1.01}
                changed = evaluate(instance, moved, unknowns) != here
                for name in np.array(unknowns)[changed]:
                    found[name].add(known)
    claims = [(e.variable.name, {d.name for d in e.dependencies or []}) for e in entries]
    missing = {(name, known) for name, claimed in claims for known in found[name] - claimed}
    for name, known in sorted(missing):
        yield f"'{name}' depends on '{known}', which its dependencies do not list"


def directional_error(fmu: Fmu) -> float:
    """Return the largest difference of directional derivatives from central differences.

    Relative to the size of each unknown's derivative in nominal units of the knowns.
    """
    generator = np.random.default_rng(2)
    unknowns = [u.variable.name for u in (*fmu.description.outputs, *fmu.description.derivatives)]
    unknowns += fmu.indicators()
    worst, starts = 0.0, sampled_starts(fmu, np.random.default_rng(6))
    with fmu.start(MODEL_EXCHANGE, values=starts) as instance:
        for _ in range(_POINTS):
            point = random_point(fmu, generator)
            knowns = [k for k in point if k != "time"]
            seeds = np.array([fmu.nominals[k] * generator.uniform(-1.0, 1.0) for k in knowns])
            step = 1e-6
            ends = []
            for sign in (1.0, -1.0):
                moved = {k: point[k] + sign * step * d for k, d in zip(knowns, seeds, strict=True)}
                ends.append(evaluate(instance, {**point, **moved}, unknowns))
            here = evaluate(instance, point, unknowns)
            exact = instance.directional(unknowns, knowns, seeds)
            difference = np.abs((ends[0] - ends[1]) / (2.0 * step) - exact)
            worst = max(worst, float(np.max(difference / (np.abs(exact) + np.abs(here) + 1e-300))))
    return worst


def adjoint_error(fmu: Fmu) -> float:
    """Return the largest difference of adjoint from directional derivatives, FMI 3.0 only.

    Of the whole matrix at a point, by columns and by rows, and in co-simulation through a step,
    there for at most `_MOST` knowns and unknowns: the step is made again for each column, and for
    every few knowns of a row. Each row is in nominal units of the knowns, relative to its largest
    entry, or to what its unknown's value says is no more than rounding. Sampled states are held; a
    step into which an instant falls is not differentiated.
    """
    generator = np.random.default_rng(4)
    unknowns = [*fmu.names("output"), *(u.variable.name for u in fmu.description.derivatives)]
    unknowns += fmu.indicators()
    point = random_point(fmu, generator)
    knowns = [k for k in point if k != "time"]
    size = np.array([fmu.nominals[k] for k in knowns])
    with fmu.start(MODEL_EXCHANGE) as instance:
        here = evaluate(instance, point, unknowns)
        worst = transposed_error(instance, unknowns, knowns, size, here)
    with fmu.start(CO_SIMULATION) as instance:
        instance.set({n: point[n] for n in fmu.names("input")})
        instance.step(0.0, fmu.step_size)
        through = [] if fmu.sampled() else fmu.states()
        few, among = _some([*unknowns, *through]), _some(knowns)
        size = np.array([fmu.nominals[k] for k in among])
        here = np.array(instance.get(few))
        return max(worst, transposed_error(instance, few, among, size, here))


def transposed_error(
    instance: Instance, unknowns: list[str], knowns: list[str], size: FloatArray, here: FloatArray
) -> float:
    """Return the largest difference of the matrix by rows from the one by columns.

    `here` are the values of the unknowns: entries that are nothing beside them are rounding.
    """
    columns = [instance.directional(unknowns, knowns, c) for c in np.eye(len(knowns))]
    rows = [instance.adjoint(unknowns, knowns, r) for r in np.eye(len(unknowns))]
    forward, backward = np.array(columns).T * size, np.array(rows) * size
    largest = np.maximum(np.max(np.abs(backward), axis=1, initial=1e-300), _NOTHING * np.abs(here))
    return float(np.max(np.abs(forward - backward) / largest[:, None]))


def _some(names: list[str]) -> list[str]:
    """Return at most `_MOST` names, evenly among all."""
    places = np.linspace(0, len(names) - 1, min(len(names), _MOST)).astype(np.int64)
    return [names[k] for k in np.unique(places)]


def wrong_start(fmu: Fmu, truth: Truth) -> Iterator[str]:
    """An instance that nothing was set in starts where a simulation of the model does.

    That is at the start values of its states and inputs, with the outputs that follow from them.
    """
    kinds = {CO_SIMULATION: "co-simulation", MODEL_EXCHANGE: "model exchange"}
    for interface in fmu.interfaces():
        kind = kinds[interface]
        with fmu.start(interface) as instance:
            found = instance.get(list(truth.starts))
        others = [
            (name, there, value)
            for (name, value), there in zip(truth.starts.items(), found, strict=True)
            if abs(there - value) > _ROUNDING * (abs(value) + fmu.nominals[name])
        ]
        if others:
            name, there, value = next((o for o in others if o[0] == "voltage"), others[-1])
            yield (
                f"in {kind} '{name}' starts at {there:.6g}, the model at {value:.6g}, and"
                f" {len(others) - 1} more values differ; compare with the model that was exported,"
                " with its --start-voltage and --history"
            )


def settled_start_error(fmu: Fmu, truth: Truth) -> float:
    """Return how far states and voltage are from those of a start at another `start_voltage`.

    In usual sizes; they are those of the model settled there after a rise from 0 V.
    """
    names = list(truth.settled_starts or {})
    expected, size = np.array(list((truth.settled_starts or {}).values())).T
    worst = 0.0
    for interface in fmu.interfaces():
        values = {START_VOLTAGE: truth.start_voltage}
        with fmu.start(interface, values=values) as instance:
            error = np.abs(instance.get(names) - expected) / size
        worst = max(worst, float(np.max(error)))
    return worst


def equation_error(fmu: Fmu, truth: Truth) -> float:
    """Return the largest relative difference of derivatives and outputs from the model's."""
    generator = np.random.default_rng(3)
    unknowns = [*(f"der({n})" for n in truth.state_names), *truth.output_names]
    worst, starts = 0.0, sampled_starts(fmu, np.random.default_rng(6))
    with fmu.start(MODEL_EXCHANGE, values=starts) as instance:
        for _ in range(_POINTS):
            point = random_point(fmu, generator)
            found = evaluate(instance, point, unknowns)
            vectors = [
                np.array([point[n] for n in names])
                for names in (truth.state_names, truth.input_names, truth.parameter_names)
            ]
            xdot, y = truth.f(point["time"], *vectors, *held_values(instance))
            expected = np.concatenate([np.array(xdot).ravel(), np.array(y).ravel()])
            size = np.abs(expected) + np.abs(found) + 1e-300
            worst = max(worst, float(np.max(np.abs(found - expected) / size)))
    return worst
