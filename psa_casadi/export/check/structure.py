"""What modelDescription.xml claims about an FMU, measured on its binary."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from psa_casadi.common.units import FloatArray
from psa_casadi.export.check.agreement import Truth
from psa_casadi.export.check.calls import WORDS
from psa_casadi.export.common.variable_table import INPUT_LINE, START_VOLTAGE
from psa_casadi.export.fmu.sources import fixed_step_of
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, Instance

_POINTS, _TOLERANCE = 4, 1e-10
#: Knowns and unknowns whose derivatives through a step are compared.
_MOST = 24
#: Difference that rounding may make, as a share of the nominal value.
_ROUNDING = 1e-12
#: A row whose entries are below this share of its unknown's value moves nothing; it is rounding.
_NOTHING = 1e-6
#: Parts of a step in which its line is followed by values that are held.
_PARTS = 50
#: Rise of the inputs over a step, in nominal values: small against the limits of a slew rate, else
#: large enough to leave a dead band.
_RISES = (1e-3, 1e-1)
#: Changes of states, over the rise, below which the inputs count as without effect.
_SMALL = 1e-5
#: Inputs at which an indicator is looked at, in nominal values.
_SIZES = (0.1, -0.1, 1.0, -1.0, 10.0, -10.0, 100.0, -100.0)
#: Of indicators, as shares of the largest value of the switch: error, and margin.
_EXACT, _MARGIN = 1e-9, 1e-2


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
    names = instance.fmu.state_elements
    states = np.array([point[n] for n in names])
    others = {n: v for n, v in point.items() if n not in names and n != "time"}
    instance.derivatives(point["time"], states, others)
    return instance.get(unknowns)


def _at_points(fmu: Fmu, seed: int) -> Iterator[tuple[Instance, dict[str, float]]]:
    """Yield an instance of model exchange with each of some random points, as time goes on.

    Its sampled states start within their nominals.
    """
    drawn = np.random.default_rng(seed)
    points = [random_point(fmu, drawn) for _ in range(_POINTS)]
    starts = {n: float(fmu.nominals[n] * drawn.uniform(-1.0, 1.0)) for n in fmu.sampled()}
    with fmu.start(MODEL_EXCHANGE, tolerance=_TOLERANCE, values=starts) as instance:
        for point in sorted(points, key=lambda p: p["time"]):
            yield instance, point


def _arguments(truth: Truth, point: dict[str, float], instance: Instance) -> list[Any]:
    """Return what the functions of the truth take at a point."""
    groups = (truth.state_names, truth.input_names, truth.parameter_names)
    vectors = [np.array([point[n] for n in names]) for names in groups]
    sampled = instance.fmu.sampled()
    return [point["time"], *vectors, *([instance.get(sampled)] if sampled else [])]


def wrong_nominals(fmu: Fmu) -> Iterator[str]:
    """Nominal values are positive; those of the states are the same in description and binary."""
    for name, nominal in fmu.nominals.items():
        if not 0.0 < nominal < math.inf:
            yield f"'{name}' has the nominal value {nominal:g}"
    states = fmu.states()
    with fmu.start(MODEL_EXCHANGE) as instance:
        result = instance.vector("GetNominalsOfContinuousStates", len(states))
    for name, nominal in zip(states, result, strict=True):
        if nominal != fmu.nominals[name]:
            yield f"'{name}' has another nominal value in the binary, {nominal:g}"


def incomplete_dependencies(fmu: Fmu) -> Iterator[str]:
    """Whatever moves an output, derivative or indicator is listed, parameters included."""
    described = fmu.description
    entries = [*described.outputs, *described.derivatives, *described.initialUnknowns]
    entries += described.eventIndicators if fmu.version == 3 else []
    for entry in entries:
        if entry.dependencies is None:
            yield f"'{entry.variable.name}' lists no dependencies"
    unknowns = list(dict.fromkeys(e.variable.name for e in entries))
    table: dict[str, set[str]] = {name: set() for name in unknowns}
    for instance, point in _at_points(fmu, 1):
        moved = {n: 1.01 * v for n, v in point.items()}
        for name, known in movements(instance, point, unknowns, moved):
            table[name].add(known)
    claims = [(e.variable.name, {d.name for d in e.dependencies or []}) for e in entries]
    missing = {(name, known) for name, claimed in claims for known in table[name] - claimed}
    for name, known in sorted(missing):
        yield f"'{name}' depends on '{known}', which its dependencies do not list"


def movements(
    instance: Instance,
    point: dict[str, float],
    unknowns: list[str],
    moved: Mapping[str, float],
    rounding: float = 0.0,
) -> Iterator[tuple[str, str]]:
    """Yield unknown and known where a known that is moved from a point moves an unknown."""
    here = evaluate(instance, point, unknowns)
    for known, value in moved.items():
        there = evaluate(instance, {**point, known: value}, unknowns)
        for name in np.array(unknowns)[np.abs(there - here) > rounding * np.abs(here)]:
            yield str(name), known


def directional_error(fmu: Fmu) -> float:
    """Return the largest difference of directional derivatives from central differences.

    Relative to the size of each unknown's derivative in nominal units of the knowns.
    """
    drawn, worst, unknowns = np.random.default_rng(2), 0.0, _differentiated(fmu)
    for instance, point in _at_points(fmu, 2):
        seed = {k: fmu.nominals[k] * drawn.uniform(-1.0, 1.0) for k in point if k != "time"}
        worst = max(worst, float(np.max(difference_error(instance, point, unknowns, seed, 1e-6))))
    return worst


def difference_error(
    instance: Instance,
    point: dict[str, float],
    unknowns: list[str],
    seed: Mapping[str, float],
    step: float,
) -> FloatArray:
    """Return how far directional derivatives (n,) along a seed are from central differences.

    Relative to the size of derivative and value; a difference is over `step` times the seed.
    """
    ends = []
    for way in (step, -step):
        moved = {k: point[k] + way * d for k, d in seed.items()}
        ends.append(evaluate(instance, {**point, **moved}, unknowns))
    here = evaluate(instance, point, unknowns)
    exact = instance.directional(unknowns, list(seed), list(seed.values()))
    difference = np.abs((ends[0] - ends[1]) / (2.0 * step) - exact)
    return np.asarray(difference / (np.abs(exact) + np.abs(here) + 1e-300))


def _differentiated(fmu: Fmu) -> list[str]:
    """Return the names of outputs, derivatives and event indicators."""
    listed = (*fmu.description.outputs, *fmu.description.derivatives)
    return [*(u.variable.name for u in listed), *fmu.indicators()]


def adjoint_error(fmu: Fmu) -> float:
    """Return the largest difference of adjoint from directional derivatives, FMI 3.0 only.

    Of the whole matrix at a point, by columns and by rows, and in co-simulation through a step,
    there for at most `_MOST` knowns and unknowns: the step is made again for each column, and for
    every few knowns of a row. Each row is in nominal units of the knowns, relative to its largest
    entry, or to the rounding of its unknown's value. Sampled states are held; a
    step into which an instant falls is not differentiated.
    """
    unknowns = _differentiated(fmu)
    point = random_point(fmu, np.random.default_rng(4))
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

    `here` are the values of the unknowns: entries far below them are rounding.
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
    for interface in fmu.interfaces():
        with fmu.start(interface) as instance:
            result = instance.get(list(truth.starts))
        others = [
            (name, there, value)
            for (name, value), there in zip(truth.starts.items(), result, strict=True)
            if abs(there - value) > _ROUNDING * (abs(value) + fmu.nominals[name])
        ]
        if others:
            name, there, value = next((o for o in others if o[0] == "voltage"), others[-1])
            yield (
                f"in {WORDS[interface]} '{name}' starts at {there:.6g}, the model at {value:.6g},"
                f" and {len(others) - 1} more values differ; compare with the model that was"
                " exported, with its --start-voltage and --history"
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
    unknowns, worst = [*(f"der({n})" for n in truth.state_names), *truth.output_names], 0.0
    for instance, point in _at_points(fmu, 3):
        result = evaluate(instance, point, unknowns)
        xdot, y = truth.f(*_arguments(truth, point, instance))
        expected = np.concatenate([np.array(xdot).ravel(), np.array(y).ravel()])
        size = np.abs(expected) + np.abs(result) + 1e-300
        worst = max(worst, float(np.max(np.abs(result - expected) / size)))
    return worst


def input_line_error(fmu: Fmu) -> float:
    """Return how far a step along the line is from where the inputs lead that follow it.

    As a share of what holding the inputs over that step changes, the larger one of two rises. Two
    values are set, a step apart; then the line through them goes on over the next step. The same
    is done by `_PARTS` short steps with values held that lie on it. What these leave, an instant
    of sampled states among them, is twice their difference from half as many at most, and is taken
    off. Inputs that move no state within a step leave nothing to compare: 0.
    """
    worst = 0.0
    for rise in _RISES:
        line, held = (_moved(fmu, value, rise, 1) for value in (1.0, 0.0))
        coarse, fine = (_moved(fmu, 0.0, rise, parts) for parts in (_PARTS // 2, _PARTS))
        change = float(np.max(np.abs(held - fine), initial=0.0))
        left = np.abs(line - fine) - 2.0 * np.abs(coarse - fine)
        if change > _SMALL * rise:
            worst = max(worst, float(np.max(left)) / change)
    return worst


def _moved(fmu: Fmu, line: float, rise: float, parts: int) -> FloatArray:
    """Return the states, in nominal values, after two steps; the second one in parts."""
    fixed, inputs = fixed_step_of(fmu.directory), fmu.names("input")
    size = fmu.step_size if fixed is None else _PARTS * fixed  # a part must be a multiple of it
    names = fmu.states() or fmu.sampled()
    sizes: FloatArray = np.array([fmu.nominals[n] for n in names])
    values = {INPUT_LINE.name: line}
    with fmu.start(CO_SIMULATION, tolerance=1e-9, values=values) as instance:
        instance.set({n: rise * fmu.nominals[n] for n in inputs})
        instance.step(0.0, size)
        for part in range(parts):
            along = (part + 0.5) / parts if parts > 1 else 0.0
            instance.set({n: rise * (2.0 + along) * fmu.nominals[n] for n in inputs})
            instance.step(size * (1.0 + part / parts), size / parts)
        return instance.get(names) / sizes


def event_indicators(fmu: Fmu) -> Iterator[str]:
    """As many as announced, equal to their variables, alive, and turned round by an event.

    One that follows an input at rest has both signs as the inputs go either way, from a tenth to
    many times their nominals. One that follows states, held values, parameters or time need not
    have both within reach; it must move with one of them. After an event none is negative, for an
    importer then waits for the next change of sign.
    """
    names, count = fmu.indicators(), fmu.indicator_count()
    if count != len(names):
        yield f"{count} event indicators are announced, {len(names)} variables switch.* repeat them"
    values, rest = [], np.zeros(len(fmu.states()))
    with fmu.start(MODEL_EXCHANGE, tolerance=_TOLERANCE) as instance:
        if fmu.version == 3:
            if instance.fmi.getNumberOfEventIndicators() != count:
                yield "the binary has another number of event indicators than the description"
            if instance.fmi.getNumberOfContinuousStates() != len(fmu.states()):
                yield "the binary has another number of states than the description"
            if [u.variable.name for u in fmu.description.eventIndicators] != names:
                yield "the event indicators of the description are not the variables switch.*"
        for size in _SIZES:
            inputs = {n: size * fmu.nominals[n] for n in fmu.names("input")}
            instance.derivatives(0.0, rest, inputs)
            values.append(instance.vector("GetEventIndicators", count))
            same = values[-1].tobytes() == instance.get(names).tobytes()
            if not same:
                yield "the event indicators differ from the variables that repeat them"
                break
    for name, z in zip(names, np.array(values).T if same else (), strict=False):
        if np.ptp(z) > 0.0 and not np.min(z) * np.max(z) < 0.0:
            yield f"'{name}' follows the inputs and does not change its sign when they turn"
    yield from dict.fromkeys(_dead_or_not_turned(fmu))


def _dead_or_not_turned(fmu: Fmu) -> Iterator[str]:
    """Yield the indicators that nothing moves, and those that an event leaves negative."""
    names, values = fmu.indicators(), []
    for instance, point in _at_points(fmu, 8):
        values.append(evaluate(instance, point, names))
        instance.require("EnterEventMode")
        instance.update_discrete_states()
        instance.require("EnterContinuousTimeMode")
        for name, z in zip(names, instance.get(names), strict=True):
            if not z >= 0.0:
                yield f"'{name}' stays negative after an event"
    for name, z in zip(names, np.array(values).T, strict=True):
        if not np.ptp(np.abs(z)) > 0.0:
            yield f"'{name}' moves with nothing"


def wrong_indicators(fmu: Fmu, truth: Truth) -> Iterator[str]:
    """Each event indicator is a switch of the model or its negative, plus a small fixed margin."""
    if fmu.indicators() != [f"switch.{name}" for name in truth.switch_names]:
        named = ", ".join(truth.switch_names) or "none"
        yield f"the event indicators are not those of the model: {named}"
        return
    result, expected = [], []
    for instance, point in _at_points(fmu, 5):
        result.append(evaluate(instance, point, fmu.indicators()))
        expected.append(np.array(truth.switches(*_arguments(truth, point, instance))).ravel())
    for name, z, switch in zip(
        fmu.indicators(), np.array(result).T, np.array(expected).T, strict=True
    ):
        size = float(np.max(np.abs(switch)))
        margins = [z - switch, z + switch]
        if not any(np.ptp(m) <= _EXACT * size and abs(m[0]) <= _MARGIN * size for m in margins):
            yield f"'{name}' is not the switch of the model"
