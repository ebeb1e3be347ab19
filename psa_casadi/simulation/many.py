"""One record under many sets of parameters: in the lanes of a core's vectors, or on a GPU."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from psa_casadi.common.errors import InputError, quoted
from psa_casadi.common.units import FloatArray
from psa_casadi.model.compose import Model
from psa_casadi.model.variables import nominal_value
from psa_casadi.records.record import Record
from psa_casadi.simulation.device import Summary, device_module, run_on_device
from psa_casadi.simulation.exact.run import LANES, NotExact, Numbers, Task, run_sets
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.simulate import Way, output_of, record_inputs, trace
from psa_casadi.simulation.start import start_on, starts_on
from psa_casadi.simulation.stepper import SimulationError

ReductionName = Literal["range", "peak", "last", "misfit"]
_Reduce = Callable[[FloatArray], npt.ArrayLike]


class Reduction(NamedTuple):
    """One number [m]: of what was measured and a displacement, both (n,), or of a summary (m,)."""

    of_row: Callable[[FloatArray, FloatArray], npt.ArrayLike]
    of_summary: Callable[[Summary, int], FloatArray]


REDUCTIONS: dict[str, Reduction] = {
    "range": Reduction(lambda _, row: np.ptp(row), lambda s, _: s.largest - s.least),
    "peak": Reduction(
        lambda _, row: np.max(np.abs(row)),
        lambda s, _: np.maximum(np.abs(s.least), np.abs(s.largest)),
    ),
    "last": Reduction(lambda _, row: row[-1], lambda s, _: s.last),
    "misfit": Reduction(
        lambda meant, row: np.sqrt(np.mean((row - meant) ** 2)),
        lambda s, n: np.sqrt(s.squares / n),
    ),
}


Device = Literal["cpu", "cuda"]


def simulate_many(
    model: Model,
    sets: Sequence[Mapping[str, float]] | Mapping[str, npt.ArrayLike],
    record: Record,
    *,
    rtol: float = 1e-6,
    reduce: ReductionName | _Reduce | None = None,
    device: Device = "cpu",
) -> FloatArray:
    """Simulate a record of n samples under m sets of parameter values (SI units): (m, n) [m].

    Each set replaces values of the model: one mapping a set, or one mapping of names to the values
    (m,) that they have in all sets, which takes less time and memory. `rtol` is the tolerance of a
    step over the states' usual sizes; the displacement errs by a few times that of its range. A row
    has the same bits whatever the other sets are; it is nan from where its set cannot be simulated.
    Models and records that exact steps do not fit run in the stepper, one after the other.

    `reduce` makes of each displacement (n,) [m] what is kept of it, a number or an array of one
    shape, and the result is (m, *shape): memory then holds a few displacements at a time,
    where 10^4 sets of 10^4 samples take 0.8 GB. Several threads call it. By name there are "range",
    "peak" (the largest magnitude), "last" and "misfit" (root mean square of the distance from the
    record's displacement), all in metres.

    `device="cuda"` runs one set a thread of an NVIDIA GPU, in double precision and by the same
    equations (extra `gpu`). What `reduce` names is made there, so that no displacement leaves it;
    whole rows and other functions of them are for fewer sets. It takes models and records that
    exact steps fit.

    Raises InputError for an unknown parameter, a value out of bounds, values of unlike numbers, a
    model without output, a name that `reduce` does not know, a record without what it needs, or a
    missing GPU; MachineError where the GPU fails.
    """
    output = output_of(model)
    if output is None:
        raise InputError(["The model has no displacement; use `run` for models of other kinds."])
    if device not in get_args(Device):
        raise InputError(f"There is no device {device!r}; choose one of {get_args(Device)}.")
    if device == "cuda":
        device_module()  # raises before work starts
    named = REDUCTIONS.get(reduce) if isinstance(reduce, str) else None
    if isinstance(reduce, str) and named is None:
        raise InputError(
            f"There is no reduction {reduce!r}; choose one of {quoted(REDUCTIONS)}, or give a"
            " function of a displacement."
        )
    meant = record.displacement if reduce == "misfit" else np.zeros(record.n)
    if meant is None or (reduce == "misfit" and record.displacement_unit != "m"):
        raise InputError(
            f"reduce='misfit' needs the displacement of the record {record.name!r} in metres, and"
            " it has none; read it with its displacement column, or keep something else."
        )
    t, u = record.time - record.time[0], record_inputs(model, record, record.n)
    p = _columns(model, sets) if isinstance(sets, Mapping) else _rows(model, sets)
    task = Task(model.structure, output, t, u, meant, rtol)
    bounds = np.array([q.bounds for q in model.structure.parameters]).reshape(-1, 2, 1)
    outside = ~np.all((bounds[:, 0] <= p) & (p <= bounds[:, 1]), axis=0)
    for k in np.flatnonzero(outside)[:1]:
        _alone(model, p[:, k])  # raises
    of_row: _Reduce | None = None if isinstance(reduce, str) else reduce
    if device == "cuda":
        return _on_device(model, task, p, named, of_row)
    return _on_cores(model, task, p, partial(named.of_row, meant) if named else of_row)


def _alone(model: Model, p: FloatArray) -> Model:
    """Return the model with the values p (np,) of one set."""
    return model.with_values(dict(zip(model.parameter_names, p.tolist(), strict=True)))


def _rows(model: Model, sets: Sequence[Mapping[str, float]]) -> FloatArray:
    """Return parameters (np, m) of one mapping a set.

    It is `with_values` for each set, which takes three times as long.
    """
    names, known = model.parameter_names, model.values
    p = np.empty((len(sets), len(names)))
    for k, values in enumerate(sets):
        merged = {**known, **values}
        if len(merged) > len(known):
            model.with_values(values)  # raises
        p[k] = [merged[name] for name in names]
    return p.T


def _columns(model: Model, sets: Mapping[str, npt.ArrayLike]) -> FloatArray:
    """Return parameters (np, m) of one mapping of names to the values in all sets."""
    table = {name: np.atleast_1d(np.asarray(v, dtype=np.float64)) for name, v in sets.items()}
    lengths = {len(v) for v in table.values() if v.ndim == 1}
    if len(lengths) != 1 or any(v.ndim != 1 for v in table.values()):
        shapes = ", ".join(f"{name} {v.shape}" for name, v in table.items()) or "none"
        raise InputError(
            f"Every parameter needs one value for each set, in arrays of one length; there are:"
            f" {shapes}. A parameter that all sets share belongs into the model (`with_values`)."
        )
    model.with_values({name: model.values.get(name, 0.0) for name in table})  # raises
    count = lengths.pop()
    return np.array([
        table[name] if name in table else np.full(count, model.values[name])
        for name in model.parameter_names
    ])  # fmt: skip


def _numbers(model: Model, task: Task, p: FloatArray) -> Numbers:
    """Return parameters p (np, m) with the sizes and the starts of the states.

    A function that several states have as their size runs once.
    """
    nominals = [s.nominal for s in model.structure.states]
    unlike = list(dict.fromkeys(nominals))
    inputs = (dict(zip(model.parameter_names, row, strict=True)) for row in p.T.tolist())
    sizes = [[nominal_value(size, values) for size in unlike] for values in inputs]
    places = [unlike.index(size) for size in nominals]
    nominal = np.array(sizes).reshape(p.shape[1], len(unlike)).T[places]
    return Numbers(p, starts_on(model, p, nominal, task.t, task.u), nominal)


def _on_cores(model: Model, task: Task, p: FloatArray, reduce: _Reduce | None) -> FloatArray:
    """Run sets in lanes on all cores, or one by one in the stepper."""
    count, n = p.shape[1], len(task.t)
    whole = np.empty((count if reduce is None else 0, n))

    def kept(rows: FloatArray, which: range) -> list[FloatArray]:
        if reduce is not None:
            return [np.array(reduce(row), dtype=np.float64) for row in rows]  # no views of rows
        whole[which.start : which.stop] = rows
        return []

    def lanes(which: range) -> list[FloatArray]:
        part = Numbers(*(a[:, which.start : which.stop] for a in numbers))
        return kept(run_sets(task, part).T, which)

    def alone(which: range) -> list[FloatArray]:
        one = _alone(model, p[:, which.start])
        way = Way(task.tolerance, task.tolerance, stepped=True)
        try:
            x0 = start_on(one, task.t, task.u).x
            row = trace(one, task.t, task.u, x0, way=way, outputs=(task.output,)).y[:, 0]
        except SimulationError:
            row = np.full(n, np.nan)
        return kept(row[None], which)

    try:
        numbers = _numbers(model, task, p)
        rows = side_by_side(lanes, _parts(count, LANES))
    except NotExact:
        rows = side_by_side(alone, _parts(count, 1))
    return whole if reduce is None else np.array([row for group in rows for row in group])


def _on_device(
    model: Model, task: Task, p: FloatArray, named: Reduction | None, reduce: _Reduce | None
) -> FloatArray:
    """Run sets on a GPU, one a thread."""
    n = len(task.t)
    arrays: list[FloatArray] = [np.empty((0, n))] if named is None and reduce is None else []
    for summary, rows in run_on_device(
        task, partial(_parts, p.shape[1]),
        lambda which: _numbers(model, task, p[:, which.start : which.stop]), whole=named is None,
    ):  # fmt: skip
        if named is not None:
            arrays.append(named.of_summary(summary, n))
        elif rows is not None:
            arrays.append(rows if reduce is None else np.array([reduce(row) for row in rows]))
    return np.concatenate(arrays) if arrays else np.empty(0)


def _parts(count: int, size: int) -> list[range]:
    """Return the places 0 to count - 1 in groups of `size`, the last one shorter."""
    return [range(k, min(k + size, count)) for k in range(0, count, size)]
