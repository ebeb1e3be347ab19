"""One record under many sets of parameters: in the lanes of a core's vectors, on all cores."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.simulation.exact.run import LANES, NotExact, run_sets
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.start import start_on
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.simulation.ways import Way, output_of, trace

FloatArray = npt.NDArray[np.float64]


def simulate_many(
    model: Model,
    sets: Sequence[Mapping[str, float]],
    record: Record,
    *,
    rtol: float = 1e-6,
    reduce: Callable[[FloatArray], npt.ArrayLike] | None = None,
) -> FloatArray:
    """Simulate a record under many sets of parameter values (SI units); returns (len(sets), n) [m].

    Each set replaces values of the model. `rtol` is the tolerance of a step over the states' usual
    sizes; the displacement errs by a few times that of its range. A row has the same bits whatever
    stands beside it; it is nan from where its set cannot be simulated. Models and records that
    exact steps do not fit run in the stepper, one after the other.

    `reduce` makes of each displacement (n,) [m] what is kept of it, a number or an array of one
    shape, and the result is (len(sets), *shape): memory then holds a few displacements at a time,
    where 10^4 sets of 10^4 samples take 0.8 GB. Several threads call it.

    Raises InputError for an unknown parameter, a value out of bounds, or a model without output.
    """
    output = output_of(model)
    if output is None:
        raise InputError(["The model has no displacement; use `run` for models of other kinds."])
    for values in sets:
        model.with_values(values)  # mistakes are told before work begins
    t, u = record.time - record.time[0], record_inputs(model, record, record.n)
    whole = np.empty((len(sets) if reduce is None else 0, record.n))

    def kept(rows: FloatArray, which: range) -> list[FloatArray]:
        if reduce is not None:
            return [np.array(reduce(row), dtype=np.float64) for row in rows]  # no views of rows
        whole[which.start : which.stop] = rows
        return []

    def lanes(which: range) -> list[FloatArray]:
        group = [model.with_values(sets[k]) for k in which]
        p, x0, nominal = (
            np.array(rows).T
            for rows in (
                [m.parameter_vector() for m in group],
                [start_on(m, t, u).x for m in group],
                [m.state_nominals() for m in group],
            )
        )
        found = run_sets(
            model.structure, t, u, p=p, x0=x0, nominal=nominal, tolerance=rtol, output=output
        )
        return kept(found.T, which)

    def alone(which: range) -> list[FloatArray]:
        one = model.with_values(sets[which.start])
        try:
            x0, way = start_on(one, t, u).x, Way(rtol, rtol, stepped=True)
            row = trace(one, t, u, x0, way=way, output=output).output
        except SimulationError:
            row = np.full(record.n, np.nan)
        return kept(row[None], which)

    try:
        rows = side_by_side(lanes, _parts(len(sets), LANES))
    except NotExact:
        rows = side_by_side(alone, _parts(len(sets), 1))
    return whole if reduce is None else np.array([row for group in rows for row in group])


def _parts(count: int, size: int) -> list[range]:
    """Return the places 0 to count - 1 in groups of `size`, the last one shorter."""
    return [range(k, min(k + size, count)) for k in range(0, count, size)]
