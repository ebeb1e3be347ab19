"""The experiments that a model is fitted to: inputs, outputs, what is used and what is held out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note
from psa_casadi.records.record import Record
from psa_casadi.records.signals import Signals, stairs, unit_hint
from psa_casadi.records.split import divided, whole

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Run:
    """One experiment on a model.

    `time` (n,) [s] counts from the first sample; `inputs` (n, nu) and `outputs` (n, ny) are in the
    order of the model's, in its units, nan where an output was not measured; `used` and `held_out`
    (n,) are the samples that are fitted and those that judge. `noise` (ny,) is the noise of its
    outputs over what is usual in all experiments, 1 where nothing else is known.
    """

    signals: Signals
    time: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    used: BoolArray
    held_out: BoolArray
    noise: FloatArray

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.signals.name

    @cached_property
    def stop(self) -> int:
        """One past the last used sample: a fit need not simulate further; 0 without any."""
        return int(np.max(np.flatnonzero(self.used), initial=-1)) + 1

    @property
    def held_out_whole(self) -> bool:
        """Whether no sample is fitted; the first tenth, which is not judged, finds the start."""
        return bool(self.held_out.any() and not self.used.any())

    def of_beginning(self) -> "Run":
        """Return the experiment with the samples before the judged ones as those to fit."""
        return replace(self, used=np.arange(len(self.used)) < np.argmax(self.held_out))

    def fitted(self, output: int) -> BoolArray:
        """True where an output is measured and fitted, shape (n,)."""
        found: BoolArray = self.used & np.isfinite(self.outputs[:, output])
        return found

    def judged(self, output: int) -> BoolArray:
        """True where an output is measured and held out, shape (n,)."""
        found: BoolArray = self.held_out & np.isfinite(self.outputs[:, output])
        return found

    def errors(self, predicted: FloatArray) -> FloatArray:
        """Return measured minus predicted outputs (n, ny), over the experiment's share of noise."""
        return np.asarray((self.outputs - predicted) / self.noise)


def noise_share(runs: Sequence[Run], output: int) -> float:
    """Return the rms of an output's `noise` over the samples that judge, else over the fitted."""
    counts = [int(c.sum()) for c in counted(runs, output)]
    squares = [r.noise[output] ** 2 for r in runs]
    return float(np.sqrt(np.average(squares, weights=counts)))


def missed_rms(runs: Sequence[Run], predicted: Sequence[FloatArray], output: int) -> float:
    """Return the rms of measured minus predicted of an output, in its unit, over these samples."""
    rows = zip(runs, predicted, counted(runs, output), strict=True)
    errors = np.concatenate([(r.outputs - y)[c, output] for r, y, c in rows])
    return float(np.sqrt(np.mean(errors**2)))


def counted(runs: Sequence[Run], output: int) -> list[BoolArray]:
    """Return the samples of an output that judge, the fitted ones where none does."""
    judged = [r.judged(output) for r in runs]
    return judged if any(j.any() for j in judged) else [r.fitted(output) for r in runs]


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
    fitted = {s.sha256: s.name for s in given}
    for s in (*given, *holdout):
        _check(model, s, problems)
    for s in [s for s in holdout if s.sha256 in fitted]:
        problems.add(
            f"signals '{s.name}' of `holdout` are those of '{fitted[s.sha256]}', which is"
            " fitted; held-out samples must be others."
        )
    problems.raise_if_any()
    shadows = [[_shadow(model, s) for s in part] for part in (given, holdout)]
    experiments = divided(*shadows) if judged else tuple(whole(r) for r in shadows[0])
    both = zip((*given, *holdout), experiments, strict=True)
    runs = []
    for s, e in both:
        inputs = np.column_stack([np.empty((s.n, 0)), *(s.columns[n] for n in model.input_names)])
        outputs, noise = _outputs(model, s), np.ones(len(model.output_names))
        runs.append(Run(s, s.time - s.time[0], inputs, outputs, e.used, e.held_out, noise))
    return tuple(runs)


def varied(run: Run) -> int | None:
    """Return the input that moves most, over its own size; None where none does."""
    spans = [_moves(column) for column in run.inputs.T]
    return int(np.argmax(spans)) if spans and max(spans) > 0 else None


def told_of_columns(model: Model, runs: Sequence[Run]) -> tuple[Note, ...]:
    """Return which inputs look held between samples and are read as lines, which outputs lack."""
    lines = [r.signals for r in runs if r.signals.hold == "linear"]
    held = {n: tuple(s.name for s in lines if n in stairs(s, (n,))) for n in model.input_names}
    absent = [n for n in model.output_names if not any(n in r.signals.columns for r in runs)]
    return (
        *(note("stairs", input=n, records=records) for n, records in held.items() if records),
        *(note("no_column", output=n) for n in absent),
    )


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
            f" more; the model's are {model.output_names}.{unit_hint(s.columns)}"
        )


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
