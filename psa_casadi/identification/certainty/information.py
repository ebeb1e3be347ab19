"""What a record tells about parameters: Fisher information, its start and offset unknown."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.identification.fitting.fit import FIT_RTOL
from psa_casadi.identification.fitting.prediction import predict_record
from psa_casadi.identification.fitting.unknowns import (
    LINEAR_PRIOR,
    LOG_PRIOR,
    memory_prior,
    memory_sizes,
)
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.units import FloatArray


def sizes_of(model: Model, names: Sequence[str]) -> FloatArray:
    """Return the unit of change of each parameter (k,): its value where searched in ln, else usual.

    In these units a standard error above 0.5 means undetermined.
    """
    parameters = [model.parameter(n) for n in names]
    return np.array(
        [model.values[p.name] if p.log else p.typical(model.values) for p in parameters]
    )


def prior_information(model: Model, names: Sequence[str]) -> FloatArray:
    """Return what is known before any record (k, k): a parameter's order of magnitude."""
    widths = [LOG_PRIOR if model.parameter(n).log else LINEAR_PRIOR for n in names]
    return np.diag(1.0 / np.array(widths) ** 2)


def record_information(
    model: Model,
    record: Record,
    names: Sequence[str],
    sigma: float,
    *,
    start: Mapping[str, float] | None = None,
    start_sizes: Sequence[float] | None = None,
    used: npt.NDArray[np.bool_] | None = None,
    rtol: float = FIT_RTOL,
) -> FloatArray:
    """Return J^T (1 - Q Q^T) J / sigma^2 (k, k) for parameter changes in units of `sizes_of`.

    J is the derivative of the predicted displacement at the `used` samples, Q spans what the
    unknown initial states (memories at rest unless `start` and `start_sizes` name others, which a
    fit would estimate with their weak priors) and the sensor's offset can imitate; sigma [m] is the
    white noise. The record needs no displacement. A loose `rtol` would make information: errors of
    a large derivative look like a direction of their own. Raises SimulationError.
    """
    if start is None or start_sizes is None:
        start, start_sizes = (
            dict.fromkeys(memory_sizes(model), 0.0),
            [*memory_sizes(model).values()],
        )
    _, by_parameter, by_start = predict_record(
        model, record, start, names, stop=record.n, rtol=rtol
    )
    chosen = slice(None) if used is None else used
    wanted = by_parameter[chosen] * sizes_of(model, names) / sigma
    nuisance = by_start[chosen] * np.array(start_sizes) / sigma
    count = len(start)
    priors = {s.name: memory_prior(s) for s in model.structure.states}
    held = np.vstack([nuisance, np.diag([1.0 / priors[n] for n in start])])
    offset = np.append(np.ones(len(wanted)), np.zeros(count))
    basis, _ = np.linalg.qr(np.column_stack([offset, held]))
    padded = np.vstack([wanted, np.zeros((count, len(names)))])
    left = padded - basis @ (basis.T @ padded)
    information: FloatArray = left.T @ left
    return information


def standard_errors(information: FloatArray) -> FloatArray:
    """Return the standard errors (k,) that an information matrix stands for."""
    return np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
