"""The data tree of a posterior, by ArviZ's names: what is saved as netCDF."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.posterior.chains import Chains
from psa_casadi.posterior.packages import sampler_and_arviz
from psa_casadi.posterior.predictive import Predictive
from psa_casadi.posterior.task import Task
from psa_casadi.units import FloatArray
from psa_casadi.version import __version__

_RECORD = "record"


def columns_of_records(task: Task) -> tuple[str, ...]:
    """Return the name of each record's displacement in the tree."""
    if len(task.experiments) == 1:
        return ("displacement",)
    return tuple(f"displacement_{k + 1}" for k in range(len(task.experiments)))


def data_tree(
    task: Task, chains: Chains, theta: FloatArray, prior: Predictive, posterior: Predictive
) -> Any:
    """Return an `arviz.InferenceData` of all groups; `theta` is (chains, draws, size)."""
    _, arviz = sampler_and_arviz()
    own = {name: [_RECORD] for name in _per_record(task.unknowns)}
    columns = columns_of_records(task)
    times = {f"time_{c}": e.record.time for c, e in zip(columns, task.experiments, strict=True)}
    dims = {**own, "noise": [_RECORD], **{c: [f"time_{c}"] for c in columns}}
    seen = {c: measured(e.record) for c, e in zip(columns, task.experiments, strict=True)}
    applied = {
        f"voltage_{c}": e.record.voltage for c, e in zip(columns, task.experiments, strict=True)
    }
    tree = arviz.from_dict(
        posterior=quantities(task, theta),
        sample_stats=chains.statistics,
        prior=quantities(task, prior.theta[None]),
        posterior_predictive=_predicted(columns, posterior),
        prior_predictive=_predicted(columns, prior),
        observed_data=seen,
        constant_data=applied,
        coords={_RECORD: [e.record.name for e in task.experiments], **times},
        dims={**dims, **{f"voltage_{c}": [f"time_{c}"] for c in columns}},
    )
    told = _units(task.model, task.unknowns)
    for group in tree.groups():
        _describe(tree[group], told)
    tree.posterior.attrs["inference_library"] = "nutpie"
    tree.posterior.attrs["created_by"] = f"psa_casadi {__version__}"
    return tree


def quantities(task: Task, theta: FloatArray) -> dict[str, FloatArray]:
    """Return parameters, starts and offsets in SI units, each (chains, draws[, records])."""
    u, shape = task.unknowns, theta.shape[:2]
    flat = theta.reshape(-1, theta.shape[2])
    rows = [u.values(t) for t in flat]
    found = {n: np.array([r[n] for r in rows]).reshape(shape) for n in u.names}
    starts = [[u.start(t, k) for k in range(u.records)] for t in flat]
    for name in _states(u):
        own = [[s.get(name, np.nan) for s in each] for each in starts]
        found[f"start_{name}"] = np.array(own).reshape(*shape, u.records)
    offsets = [[u.offset(t, k) for k in range(u.records)] for t in flat]
    found["offset"] = np.array(offsets).reshape(*shape, u.records)
    return found


def _states(u: Unknowns) -> tuple[str, ...]:
    return tuple(dict.fromkeys(n for started in u.started for n in started))


def _per_record(u: Unknowns) -> tuple[str, ...]:
    return (*(f"start_{n}" for n in _states(u)), "offset")


def _predicted(columns: Sequence[str], found: Predictive) -> dict[str, FloatArray]:
    shown = {c: y[None] for c, y in zip(columns, found.displacement, strict=True)}
    return {**shown, "noise": np.stack(found.noise, axis=-1)[None]}


def _units(model: Model, u: Unknowns) -> dict[str, tuple[str, str]]:
    """Return unit and meaning of every variable."""
    told = {n: (model.parameter(n).unit, model.parameter(n).description) for n in u.names}
    states = {s.name: s for s in model.structure.states}
    for name in _states(u):
        meaning = f"Start of a record: {states[name].description}, as a deviation from rest"
        told[f"start_{name}"] = (states[name].unit, meaning)
    told["offset"] = ("m", "Offset of the displacement sensor in a record")
    told["noise"] = ("m", "Standard deviation of the noise of a record")
    return told


def _describe(group: Any, told: Mapping[str, tuple[str, str]]) -> None:
    for name in group.variables:
        unit, meaning = told.get(name, ("", ""))
        if name.startswith("displacement"):
            unit, meaning = "m", "Displacement"
        elif name.startswith("voltage"):
            unit, meaning = "V", "Voltage"
        elif name.startswith("time"):
            unit, meaning = "s", "Time"
        if unit:
            group[name].attrs |= {"units": unit, "long_name": meaning}
