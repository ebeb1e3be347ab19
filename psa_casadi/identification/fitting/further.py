"""Columns beside the displacement that are fitted as outputs: current, charge, monitor and so on.

Every column has an offset in each record and factors for what it shows, the same in all records;
both are linear, so that they are projected out of the residual instead of being searched (variable
projection; Golub and Pereyra 1973, with the Jacobian of Kaufman 1975).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.component import Component
from psa_casadi.components.outputs import MONITOR, SECOND_SENSOR, STRAIN_GAUGE
from psa_casadi.identification.fitting.prediction import trace_record, traced_by_theta
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note
from psa_casadi.records.split import Experiment, Level
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.simulate import Way
from psa_casadi.units import FloatArray


@dataclass(frozen=True)
class Shown:
    """What a column of a record shows.

    `outputs` of the model, each with a factor; the first factor is that of `scale`, a parameter of
    the `sensor` that a model gets for the column, where it has one. `unit` is the SI unit. The
    model is taken to be right to the share `straight` of what is shown (rms): a smaller error says
    nothing of a stack.
    """

    unit: str
    outputs: tuple[str, ...]
    straight: float = 1e-3
    sensor: Component | None = None
    scale: str | None = None


#: The columns that are fitted, by name. The charge on a stack is that of its capacitance and, by
#: reciprocity, a share of the displacement; the current is its rate, which lags faster than the
#: sampling move most.
COLUMNS: Mapping[str, Shown] = {
    "monitor_voltage": Shown("V", ("monitor_voltage",), sensor=MONITOR, scale="monitor_scale"),
    "charge": Shown("C", ("charge", "displacement"), straight=1e-2),
    "current": Shown("A", ("current", "velocity"), straight=5e-2),
    "displacement_2": Shown("m", ("displacement_2",), sensor=SECOND_SENSOR, scale="sensor_2_scale"),
    "strain": Shown("1", ("strain",), sensor=STRAIN_GAUGE, scale="strain_scale"),
}


@dataclass(frozen=True, eq=False)
class Further:
    """The fit of one further column, in its SI unit; samples of all records that have it, stacked.

    `residuals` (n,) are measured minus predicted; `jacobian` (n, size) d prediction / d theta, both
    without what offsets and factors can follow: `basis` (n, k) is orthonormal. `factors` belong to
    the outputs, `level` weighted the column, `spread` is its rms about the offsets, `lengths` are
    the samples of each record.
    """

    column: str
    level: float
    spread: float
    residuals: FloatArray
    jacobian: FloatArray
    basis: FloatArray
    factors: FloatArray
    lengths: tuple[int, ...]

    def left_of(self, change: FloatArray) -> FloatArray:
        """Return what offsets and factors leave of a change of the prediction (n,)."""
        left: FloatArray = change - self.basis @ (self.basis.T @ change)
        return left

    @property
    def straight(self) -> float:
        """Rms error below which nothing is known of the column, in its unit."""
        return COLUMNS[self.column].straight * self.spread

    @property
    def notes(self) -> tuple[Note, ...]:
        """What is left of the column, and what is odd about it."""
        unit, share = COLUMNS[self.column].unit, 100.0 * self.rms / max(self.spread, 1e-300)
        named = "" if unit == "1" else f" {unit}"
        left = note("column", column=self.column, rms=self.rms, unit=named, share=share)
        return left, *self.turned

    @property
    def turned(self) -> tuple[Note, ...]:
        """Say so where a column falls while what it shows rises."""
        falls = COLUMNS[self.column].scale is None and self.factors[0] < 0.0
        return (note("turned_column", column=self.column),) if falls else ()

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def further_of(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    theta: FloatArray,
    *,
    way: Way,
) -> tuple[Further, ...]:
    """Return the fit of every further column at theta, at the used samples. Raises PsaError."""
    slopes = unknowns.slopes(theta)

    def one(task: tuple[int, str]) -> tuple[FloatArray, FloatArray]:
        index, output = task
        e = experiments[index]
        shown, by_theta, _ = traced_by_theta(
            model, e.record, unknowns, theta, index,
            stop=e.stop, way=way, slopes=slopes, output=output,
        )  # fmt: skip
        used = e.used[: e.stop]
        return shown[used], by_theta[used]

    found = []
    for level in experiments[0].further if experiments else ():
        records = with_column(experiments, level.column)
        tasks = [(k, output) for output in COLUMNS[level.column].outputs for k in records]
        runs, count = side_by_side(one, tasks), len(records)
        per_output = [runs[k : k + count] for k in range(0, len(runs), count)]
        given = [measured_in(experiments[k], level.column) for k in records]
        found.append(_projected(level, given, per_output))
    return tuple(found)


def _projected(
    level: Level,
    given: Sequence[FloatArray],
    shown: Sequence[Sequence[tuple[FloatArray, FloatArray]]],
) -> Further:
    """Return the fit of a column `given` per record by what outputs have `shown` of each record.

    Offsets and factors are projected out.
    """
    lengths = tuple(len(y) for y in given)
    centred = _centred(np.column_stack([np.concatenate([x for x, _ in o]) for o in shown]), lengths)
    target = _centred(np.concatenate(given), lengths)
    size = np.maximum(np.linalg.norm(centred, axis=0), 1e-300)
    factors = np.linalg.lstsq(centred / size, target, rcond=1e-10)[0] / size
    ones = np.zeros((len(target), len(lengths)))
    for k, last in enumerate(np.cumsum(lengths)):
        ones[last - lengths[k] : last, k] = 1.0 / np.sqrt(lengths[k])
    u, s, _ = np.linalg.svd(centred / size, full_matrices=False)
    basis = np.hstack([ones, u[:, s > 1e-10 * max(float(s[0]), 1e-300)]])
    moved = sum(f * np.vstack([j for _, j in own]) for f, own in zip(factors, shown, strict=True))
    return Further(
        column=level.column,
        level=level.value,
        spread=float(np.sqrt(np.mean(target**2))),
        residuals=target - basis @ (basis.T @ target),
        jacobian=moved - basis @ (basis.T @ moved),
        basis=basis,
        factors=factors,
        lengths=lengths,
    )


def with_column(experiments: Sequence[Experiment], column: str) -> list[int]:
    """Return the experiments that have a column and samples of it to fit."""
    return [
        k
        for k, e in enumerate(experiments)
        if getattr(e.record, column) is not None and e.used.any()
    ]


def measured_in(experiment: Experiment, column: str) -> FloatArray:
    """Return the used samples of a column (n,)."""
    values: FloatArray = getattr(experiment.record, column)[experiment.used]
    return values


def scaled(model: Model, found: Sequence[Further]) -> tuple[Model, tuple[Further, ...]]:
    """Return a model whose sensors have the scales that were found, and the factors beside it."""
    values, beside = {}, []
    for each in found:
        name, factors = COLUMNS[each.column].scale, each.factors
        if name is not None and factors[0] != 0.0:
            low, high = model.parameter(name).bounds
            values[name] = float(np.clip(factors[0] * model.values[name], low, high))
            factors = factors * model.values[name] / values[name]
        beside.append(replace(each, factors=factors))
    return model.with_values(values), tuple(beside)


def predicted_further(
    model: Model,
    experiments: Sequence[Experiment],
    unknowns: Unknowns,
    theta: FloatArray,
    fitted: Further,
    *,
    way: Way,
) -> dict[int, FloatArray]:
    """Return a further column of whole records (n,) as predicted, by the index of the record.

    Factors are those of the fit, offsets those of the known samples. Raises PsaError.
    """
    current = model.with_values(unknowns.values(theta))
    found = {}
    for k, e in enumerate(experiments):
        given: FloatArray | None = getattr(e.record, fitted.column)
        if given is None or not e.known.any():
            continue
        start = unknowns.start(theta, k)
        total = np.zeros(e.record.n)
        for factor, output in zip(fitted.factors, COLUMNS[fitted.column].outputs, strict=True):
            total += factor * trace_record(
                current, e.record, start, (),
                stop=e.record.n, way=way, by_start=False, outputs=(output,),
            ).y[:, 0]  # fmt: skip
        found[k] = total + np.mean((given - total)[e.known])
    return found


def _centred(values: FloatArray, lengths: Sequence[int]) -> FloatArray:
    """Return values (n,) or columns less their mean in every record."""
    parts = np.split(values, np.cumsum(lengths)[:-1])
    return np.concatenate([part - np.mean(part, axis=0) for part in parts])
