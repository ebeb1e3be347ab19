"""One run of an FMU over a record, in a process that may end with it.

Co-simulation is stepped here, as no importer known sets an input to its mean over a step: held at
its value at the beginning it is late by half a step. Model exchange with events is fmpy's.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import fmpy
import numpy as np

from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu, FmuError, Instance
from psa_casadi.export.importer.imported import opened
from psa_casadi.units import FloatArray

#: Relative tolerance of a run by model exchange; CVode's.
_TOLERANCE = 1e-7
#: Intervals that differ by this share are the same.
_SAME = 1e-6


@dataclass(frozen=True, eq=False)
class Run:
    """What an FMU is to do: values before its initialization, inputs u (n, nu) at times t (n,).

    `interface` is `CO_SIMULATION` or `MODEL_EXCHANGE`; between samples inputs are straight lines,
    or held (`hold` "zero").
    """

    file: str
    digest: str
    interface: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    values: Mapping[str, float]
    t: FloatArray
    u: FloatArray
    hold: str


def play(run: Run) -> FloatArray | str:
    """Return the outputs (n, ny) at the times of a run, or why there are none."""
    try:
        fmu = opened(Path(run.file), run.digest)
        return stepped(fmu, run) if run.interface == CO_SIMULATION else _integrated(fmu, run)
    except Exception as error:  # noqa: BLE001 - of an FMU and of fmpy, any
        return str(error) or type(error).__name__


def stepped(fmu: Fmu, run: Run) -> FloatArray:
    """Step a new instance over a run. Raises FmuError."""
    points, names = communication_points(fmu, run.t), run.inputs
    rates = bool(getattr(fmu.description.coSimulation, "canInterpolateInputs", False))
    lines = run.hold != "zero"
    at = _inputs(run, points)
    middle = _inputs(run, 0.5 * (points[:-1] + points[1:]))
    during = at[:-1] if rates and lines else middle
    begins = {**run.values, **dict(zip(names, at[0].tolist(), strict=True))}
    found = np.empty((len(points), len(run.outputs)))
    with fmu.start(CO_SIMULATION, values=begins, start_time=float(points[0])) as instance:
        found[0] = instance.get(run.outputs)
        for k, (begin, end) in enumerate(pairwise(points.tolist())):
            instance.set(dict(zip(names, during[k].tolist(), strict=True)))
            if rates and lines and names:
                slopes = (at[k + 1] - at[k]) / (end - begin)
                instance.set_rates(dict(zip(names, slopes.tolist(), strict=True)))
            _step(instance, begin, end - begin)
            instance.set(dict(zip(names, at[k + 1].tolist(), strict=True)))
            found[k + 1] = instance.get(run.outputs)
    columns = [np.interp(run.t, points, column) for column in found.T]
    return np.array(columns).reshape(len(run.outputs), len(run.t)).T


def _step(instance: Instance, begin: float, size: float) -> None:
    said = instance.fmi.doStep(begin, size)
    if said is not None and bool(said[1]):
        raise FmuError(f"the FMU ends the simulation at {begin + size:g} s")


def communication_points(fmu: Fmu, t: FloatArray) -> FloatArray:
    """Return the communication points of a run over times t (n,).

    They are the times, more where the FMU's default step is shorter; multiples of its internal
    step, or of one interval, where the FMU takes no other ones.
    """
    co, gaps = fmu.description.coSimulation, np.diff(t)
    if not len(gaps):
        return t
    said = getattr(fmu.description.defaultExperiment, "stepSize", None)
    most = float(said) if said else math.inf
    internal, middle = getattr(co, "fixedInternalStepSize", None), float(np.median(gaps))
    even = bool(np.ptp(gaps) <= _SAME * middle)
    if internal:
        size = float(internal) * max(1, math.floor(middle / float(internal) * (1 + _SAME)))
    elif co.canHandleVariableCommunicationStepSize:
        parts = np.ceil(gaps / most * (1 - _SAME)).astype(int).clip(1)
        inner = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(t, t[1:], parts)]  # noqa: B905
        return np.concatenate([*inner, t[-1:]])
    else:
        least = middle if even else float(np.min(gaps))
        size = least / math.ceil(least / most * (1 - _SAME) or 1)
    count = math.ceil((t[-1] - t[0]) / size * (1 - _SAME))
    return np.asarray(t[0] + size * np.arange(count + 1))


def _inputs(run: Run, times: FloatArray) -> FloatArray:
    """Return the inputs (m, nu) at times (m,)."""
    if run.hold == "zero":
        rows = np.searchsorted(run.t, times * (1 + 1e-12) + 1e-15, "right") - 1
        return np.asarray(run.u[rows.clip(0)])
    columns = [np.interp(times, run.t, column) for column in run.u.T]
    return np.array(columns).reshape(run.u.shape[1], len(times)).T


def _integrated(fmu: Fmu, run: Run) -> FloatArray:
    """Integrate model exchange over a run, with its events."""
    t, u = run.t, run.u
    if run.hold == "zero":  # a jump is two rows of one time
        t, u = np.repeat(t, 2)[1:], np.repeat(u, 2, axis=0)[:-1]
    found = fmpy.simulate_fmu(
        str(fmu.directory), validate=False, model_description=fmu.description,
        fmi_type="ModelExchange", start_time=float(t[0]), stop_time=float(t[-1]),
        output_interval=float(np.min(np.diff(run.t))), relative_tolerance=_TOLERANCE,
        record_events=False, start_values=_whole(fmu, run.values),
        output=list({fmu.elements[n].variable for n in run.outputs}),
        input=_table(fmu, run, t, u) if run.inputs else None,
    )  # fmt: skip
    shown = []
    for e in (fmu.elements[n] for n in run.outputs):
        column = found[e.variable].reshape(len(found), e.count)[:, e.place]
        shown.append(np.interp(run.t, found["time"], column.astype(float)))
    return np.array(shown).T


def _whole(fmu: Fmu, values: Mapping[str, float]) -> dict[str, float | list[float]]:
    """Return values of whole variables: elements of arrays that are not given keep their starts."""
    found: dict[str, float | list[float]] = {}
    for name, value in values.items():
        e = fmu.elements[name]
        whole = found.setdefault(e.variable, list(e.starts) if e.variable != name else value)
        if isinstance(whole, list):
            whole[e.place] = value
    return found


def _table(fmu: Fmu, run: Run, t: FloatArray, u: FloatArray) -> Any:
    """Return the inputs as fmpy takes them: a column for each variable, arrays whole."""
    constant = {n: v for n, v in run.values.items() if fmu.elements[n].variable != n}
    given = dict(zip(run.inputs, u.T, strict=True))
    elements = {e.variable: e for e in (fmu.elements[n] for n in run.inputs)}
    kinds = {"Boolean": bool, "Integer": np.int64}
    fields = [
        (name, kinds.get(e.type, float), *([(e.count,)] if e.count > 1 else []))
        for name, e in elements.items()
    ]
    table = np.zeros(len(t), dtype=[("time", float), *fields])
    table["time"] = t
    for name, e in elements.items():
        table[name] = e.starts if e.count > 1 else e.starts[0]
    for name, column in {**constant, **given}.items():
        e = fmu.elements[name]
        if e.variable in elements and e.count > 1:
            table[e.variable][:, e.place] = column
        elif e.variable in elements:
            table[e.variable] = column
    return table
