"""The experiments that a model is fitted to: inputs, outputs, what is used and what is held out."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record
from psa_casadi.records.signals import Signals, unit_hint
from psa_casadi.records.split import divided, whole

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Run:
    """One experiment on a model.

    `time` (n,) [s] counts from the first sample; `inputs` (n, nu) and `outputs` (n, ny) are in the
    order of the model's, in its units, nan where an output was not measured; `used` and `held_out`
    (n,) are the samples that are fitted and those that judge.
    """

    signals: Signals
    time: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    used: BoolArray
    held_out: BoolArray

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.signals.name

    @cached_property
    def stop(self) -> int:
        """One past the last used sample: a fit need not simulate further."""
        return int(np.flatnonzero(self.used)[-1]) + 1

    def fitted(self, output: int) -> BoolArray:
        """True where an output is measured and fitted, shape (n,)."""
        found: BoolArray = self.used & np.isfinite(self.outputs[:, output])
        return found

    def judged(self, output: int) -> BoolArray:
        """True where an output is measured and held out, shape (n,)."""
        found: BoolArray = self.held_out & np.isfinite(self.outputs[:, output])
        return found


def runs_of(
    model: Model,
    given: Sequence[Signals],
    holdout: Sequence[Signals] = (),
    *,
    judged: bool = True,
) -> tuple[Run, ...]:
    """Return the experiments of a model; some samples of them are held out if they are `judged`.

    Those of `holdout`, but for the tenth that finds their state; without such a record a quarter of
    every one in blocks, as `split` chooses them along the input that moves most.

    Raises InputError for inputs that are missing or have gaps, and where no output was measured.
    """
    problems = Problems()
    for s in (*given, *holdout):
        _check(model, s, problems)
    problems.raise_if_any()
    shadows = [[_shadow(model, s) for s in part] for part in (given, holdout)]
    experiments = divided(*shadows) if judged else tuple(whole(r) for r in shadows[0])
    both = zip((*given, *holdout), experiments, strict=True)
    return tuple(
        Run(s, s.time - s.time[0], _inputs(model, s), _outputs(model, s), e.used, e.held_out)
        for s, e in both
    )


def varied(run: Run) -> int | None:
    """Return the input that moves most, over its own size; None where none does."""
    spans = [_moves(column) for column in run.inputs.T]
    return int(np.argmax(spans)) if spans and max(spans) > 0 else None


def _check(model: Model, s: Signals, problems: Problems) -> None:
    for name in model.input_names:
        if name not in s.columns:
            problems.add(
                f"signals '{s.name}' lack the input '{name}' of the model '{model.name}'; they have"
                f" {sorted(s.columns)}. Name the column so.{unit_hint(s.columns)}"
            )
        elif not np.isfinite(s.columns[name]).all():
            problems.add(
                f"signals '{s.name}': the input '{name}' has missing samples; an input must be"
                " known throughout. Fill them, or cut the record there."
            )
    there = [n for n in model.output_names if n in s.columns]
    if not any(np.isfinite(s.columns[n]).sum() >= 8 for n in there):
        problems.add(
            f"signals '{s.name}' have no output of the model '{model.name}' with eight samples or"
            f" more; it shows {model.output_names}.{unit_hint(s.columns)}"
        )


def _inputs(model: Model, s: Signals) -> FloatArray:
    columns = [s.columns[n] for n in model.input_names]
    return np.column_stack([np.empty((s.n, 0)), *columns])


def _outputs(model: Model, s: Signals) -> FloatArray:
    missing = np.full(s.n, np.nan)
    return np.column_stack([s.columns.get(n, missing) for n in model.output_names])


def _shadow(model: Model, s: Signals) -> Record:
    """Return the record of one input and of what was measured, along which samples are held out."""
    moving = max(model.input_names, key=lambda n: _moves(s.columns[n]), default=None)
    there = np.isfinite(_outputs(model, s)).any(axis=1)
    return Record(
        name=s.name,
        time=s.time,
        voltage=np.zeros(s.n) if moving is None else s.columns[moving],
        displacement=np.where(there, 0.0, np.nan),
    )


def _moves(column: FloatArray) -> float:
    return float(np.ptp(column)) / max(float(np.max(np.abs(column))), 1e-300)


def measured_spans(runs: Sequence[Run]) -> FloatArray:
    """Return the range of every output over all experiments (ny,). Raises InputError at rest."""
    every = np.vstack([r.outputs[r.used] for r in runs])
    there = np.isfinite(every)
    low = np.min(np.where(there, every, np.inf), axis=0)
    high = np.max(np.where(there, every, -np.inf), axis=0)
    spans: FloatArray = np.where(there.any(axis=0), high - low, 0.0)
    if not np.any(spans > 0):
        raise InputError("No output moves in these records; there is nothing to fit.")
    return spans
