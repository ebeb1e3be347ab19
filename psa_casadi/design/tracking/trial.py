"""A voltage corrected by what one measured trial of it on the real stack showed."""

from dataclasses import dataclass

import numpy as np

from psa_casadi.design.tracking.inversion import correct
from psa_casadi.design.tracking.targets import (
    AmplifierLimits,
    Response,
    Target,
    TrackingError,
    demand_stack,
    error_of,
    held,
    respond,
)
from psa_casadi.errors import Problems
from psa_casadi.model.compose import Model
from psa_casadi.records import Record
from psa_casadi.units import FloatArray

#: Steps of a path that differ by more than this share of their median are not uniform.
_UNIFORM = 1e-3
#: Share of a step by which a trial may end before the path does.
_SHORT = 1.5
#: Least range of the measured displacement, over that of the path.
_MOVED = 0.05


@dataclass(frozen=True, eq=False)
class CorrectedInput:
    """A corrected voltage, and the trial it comes from.

    `played` (n,) [V] and `measured` (n,) [m] are the trial at the path's instants, `error` is the
    trial's; `response` is the model's to the corrected voltage, which knows nothing of the trial.
    """

    target: Target
    limits: AmplifierLimits
    played: FloatArray
    measured: FloatArray
    error: TrackingError
    response: Response


def corrected(
    model: Model, target: Target, record: Record, limits: AmplifierLimits | None = None
) -> CorrectedInput:
    """Return the voltage for a path, corrected by a record of an earlier voltage for it.

    The record's first sample counts as the path's; see `inversion.correct` for what is done. The
    voltage is cut by the limits.

    Raises InputError for a model that is no stack, a path whose instants are not uniform, a record
    that is too short for the path, has gaps or no scale, or shows no motion to speak of.
    """
    demand_stack(model)
    _check(target, record)
    time = record.time - record.time[0]
    played = np.interp(target.time, time, record.voltage)
    measured = np.interp(target.time, time, np.asarray(record.displacement, dtype=float))
    bounds = limits or AmplifierLimits()
    voltage = held(model, bounds, target.time, correct(model, target, played, measured))
    error = error_of(target, measured)
    response = respond(model, target.time, voltage)
    return CorrectedInput(target, bounds, played, measured, error, response)


def _check(target: Target, record: Record) -> None:
    problems, name = Problems(), record.source or record.name
    if np.ptp(np.diff(target.time)) > _UNIFORM * target.step:
        problems.add(
            "The path's instants are not uniform; resample it evenly, design the voltage for that,"
            " and measure the trial again."
        )
    if record.time[-1] - record.time[0] < target.time[-1] - _SHORT * target.step:
        problems.add(
            f"{name}: lasts {record.time[-1] - record.time[0]:.4g} s, the path"
            f" {target.time[-1]:.4g} s; record the whole path, from its first sample on."
        )
    shown = record.displacement
    if shown is None or record.displacement_unit != "m" or not np.isfinite(shown).all():
        problems.add(
            f"{name}: a trial needs a displacement in a unit of length at every sample; fill"
            " the gaps, or convert counts by the sensor's scale."
        )
    elif np.ptp(shown) < _MOVED * target.span:
        problems.add(
            f"{name}: the stack moved by {1e6 * np.ptp(shown):.3g} um, the path moves by"
            f" {1e6 * target.span:.3g} um; this is no trial of it, or in another unit."
        )
    problems.raise_if_any()
