"""One record under many sets of parameters: in the lanes of a core's vectors, on all cores."""

from collections.abc import Mapping, Sequence

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
) -> FloatArray:
    """Simulate a record under many sets of parameter values (SI units); returns (len(sets), n) [m].

    Each set replaces values of the model. `rtol` is the tolerance of a step over the states' usual
    sizes; the displacement errs by a few times that of its range. A row has the same bits whatever
    stands beside it; it is nan from where its set cannot be simulated. Models and records that
    exact steps do not fit run in the stepper, one after the other.

    Raises InputError for an unknown parameter, a value out of bounds, or a model without output.
    """
    output = output_of(model)
    if output is None:
        raise InputError(["The model has no displacement; use `run` for models of other kinds."])
    models = [model.with_values(values) for values in sets]
    t, u = record.time - record.time[0], record_inputs(model, record, record.n)

    def lanes(group: Sequence[Model]) -> FloatArray:
        p, x0, nominal = (
            np.array(rows).T
            for rows in (
                [m.parameter_vector() for m in group],
                [start_on(m, t, u).x for m in group],
                [m.state_nominals() for m in group],
            )
        )
        return run_sets(
            model.structure, t, u, p=p, x0=x0, nominal=nominal, tolerance=rtol, output=output
        ).T

    def alone(one: Model) -> FloatArray:
        try:
            x0, way = start_on(one, t, u).x, Way(rtol, rtol, stepped=True)
            return trace(one, t, u, x0, way=way, output=output).output
        except SimulationError:
            return np.full(record.n, np.nan)

    groups = [models[k : k + LANES] for k in range(0, len(models), LANES)]
    try:
        rows = side_by_side(lanes, groups)
    except NotExact:
        rows = [r[None] for r in side_by_side(alone, models)]
    return np.vstack(rows) if rows else np.empty((0, record.n))
