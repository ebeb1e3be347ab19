"""The experiments that a model is fitted to: inputs, outputs, what is used and what is held out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError, Problems
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note
from psa_casadi.records.read.reading import signals_given
from psa_casadi.records.record import Record
from psa_casadi.records.signals import Hold, Signals, stairs
from psa_casadi.records.split import divided, whole
from psa_casadi.records.suspects import Suspects, suspects_of
from psa_casadi.units import convert, parse_unit, si_unit

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Run:
    """One experiment on a model.

    `time` (n,) [s] counts from the first sample; `inputs` (n, nu) and `outputs` (n, ny) are in the
    order of the model's, in its units, nan where an output was not measured; `used` and `held_out`
    (n,) are the samples that are fitted and those that judge. `noise` (ny,) is the noise of its
    outputs over what is usual in all experiments, 1 where nothing else is known. `suspects` are the
    samples of each output that its sensor has made; they are masked.
    """

    signals: Signals
    time: FloatArray
    inputs: FloatArray
    outputs: FloatArray
    used: BoolArray
    held_out: BoolArray
    noise: FloatArray
    suspects: tuple[Suspects, ...] = ()

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


def given_to(model: Model, records: Any, hold: Hold | None, first: int = 1) -> list[Signals]:
    """Return the records that a user gave to a model (`signals_given`). Raises InputError."""
    return signals_given(records, model.input_names, model.output_names, hold=hold, first=first)


def runs_of(
    model: Model,
    given: Sequence[Signals],
    holdout: Sequence[Signals] = (),
    *,
    judged: bool = True,
) -> tuple[Run, ...]:
    """Return the experiments of a model; some samples of them are held out if they are `judged`.

    Those of `holdout`, but for the tenth that finds their state; without such a record a quarter of
    every one in blocks, as `split` chooses them along the input that moves most. Columns are
    converted to the model's units; samples that an output's sensor has made are masked.

    Raises InputError for inputs that are missing or have gaps, for units that measure something
    else, and where no output was measured.
    """
    problems = Problems()
    fitted = {s.sha256: s.name for s in given}
    parts = [[_in_units(model, s, problems) for s in part] for part in (given, holdout)]
    for s in (s for part in parts for s in part):
        _check(model, s, problems)
    for s in [s for s in holdout if s.sha256 in fitted]:
        problems.add(
            f"signals '{s.name}' of `holdout` are those of '{fitted[s.sha256]}', which is"
            " fitted; held-out samples must be others."
        )
    problems.raise_if_any()
    runs = [[_run(model, s) for s in part] for part in parts]
    shadows = [[_shadow(run) for run in part] for part in runs]
    experiments = divided(*shadows) if judged else tuple(whole(r) for r in shadows[0])
    both = zip((r for part in runs for r in part), experiments, strict=True)
    return tuple(replace(r, used=e.used, held_out=e.held_out) for r, e in both)


def _run(model: Model, s: Signals) -> Run:
    """Return an experiment of which no sample is used yet."""
    inputs = {n: s.columns[n] for n in model.input_names}
    missing, none = np.full(s.n, np.nan), np.zeros(s.n, dtype=np.bool_)
    outputs = {o.name: s.columns.get(o.name, missing) for o in model.structure.outputs}
    found = tuple(
        suspects_of(o.name, outputs[o.name], o.unit, inputs) for o in model.structure.outputs
    )
    return Run(
        signals=s,
        time=s.time - s.time[0],
        inputs=np.column_stack([np.empty((s.n, 0)), *inputs.values()]),
        outputs=np.column_stack([np.where(f.mask, np.nan, outputs[f.names[0]]) for f in found]),
        used=none,
        held_out=none,
        noise=np.ones(len(found)),
        suspects=found,
    )


def varied(run: Run) -> int | None:
    """Return the input that moves most, over its own size; None where none does."""
    spans = [_moves(column) for column in run.inputs.T]
    return int(np.argmax(spans)) if spans and max(spans) > 0 else None


def told_of_columns(model: Model, runs: Sequence[Run]) -> tuple[Note, ...]:
    """Return which inputs look held between samples and are read as lines, which outputs lack.

    And what units were not stated, and which samples are masked.
    """
    lines = [r.signals for r in runs if r.signals.hold == "linear"]
    held = {n: tuple(s.name for s in lines if n in stairs(s, (n,))) for n in model.input_names}
    absent = [n for n in model.output_names if not any(n in r.signals.columns for r in runs)]
    stated = [n for n, unit in _units(model).items() if unit != "1"]
    units, masked = list[Note](), list[Note]()
    for r in runs:
        bare = tuple(n for n in stated if r.signals.units.get(n) == "")
        units += [note("no_unit", record=r.name, names=bare)] if bare else []
        for own in r.suspects:
            masked += own.notes(f"{own.names[0]} of {r.name}")
    return (
        *(note("stairs", input=n, records=records) for n, records in held.items() if records),
        *(note("no_column", output=n) for n in absent),
        *units,
        *masked,
    )


def _units(model: Model) -> dict[str, str]:
    inputs, outputs = model.structure.inputs, model.structure.outputs
    return {**{v.name: v.unit for v in inputs}, **{v.name: v.unit for v in outputs}}


def _in_units(model: Model, s: Signals, problems: Problems) -> Signals:
    """Return the same samples in the units of a model; where that states none, in SI units."""
    columns, units, where = dict(s.columns), dict(s.units), s.source or s.name
    for name, own in _units(model).items():
        unit = s.units.get(name)
        if not unit or name not in columns:
            continue
        try:
            read = parse_unit(unit)
            if own != "1" or read.dimension == parse_unit(own).dimension:
                columns[name], units[name] = convert(columns[name], unit, own), own
            elif read.ratio != 1 or read.offset:
                problems.add(
                    f"{where}: column '{name}' is in '{unit}', of which the model '{model.name}'"
                    f" states no unit; declare it, as psa.{_kind(model, name)}('{name}',"
                    f" '{si_unit(unit)}', ''), or give the column without a unit, in the model's."
                )
        except InputError as error:
            problems.add(
                f"{where}: column '{name}': {error} The model '{model.name}' has it in '{own}'."
            )
    return replace(s, columns=columns, units=units)


def _kind(model: Model, name: str) -> str:
    return "Input" if name in model.input_names else "Output"


def _check(model: Model, s: Signals, problems: Problems) -> None:
    for name in model.input_names:
        if name not in s.columns:
            problems.add(
                f"signals '{s.name}' lack the input '{name}' of the model '{model.name}'; they have"
                f" {sorted(s.columns)}. Name the column so."
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
            f" more; the model's are {model.output_names}."
        )


def _shadow(run: Run) -> Record:
    """Return the record of one input and of what was measured, along which samples are held out."""
    spans = [_moves(column) for column in run.inputs.T]
    there = np.isfinite(run.outputs).any(axis=1)
    return Record(
        name=run.name,
        time=run.signals.time,
        voltage=run.inputs[:, int(np.argmax(spans))] if spans else np.zeros(run.signals.n),
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
