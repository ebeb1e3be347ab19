"""What a diagnosis of any model says, with its error budget.

Shares are of the power above the noise, outputs over their noise, with the intervals of a stack's
budget (`psa_casadi.diagnosis.held_out`).
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.held_out import Removed, Share
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.diagnosis.result import Candidate, Estimate, Remaining, Verdict, told
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note, texts
from psa_casadi.records.split import Experiment, counted
from psa_casadi.shown import Reported, frame, with_units

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class OdeBudget:
    """Where the held-out error of the base model above the noise goes.

    `together` is what all causes remove, `causes` what each does beside the others (the model
    fitted again without it leaves so much more), `unnamed` what a free function would remove.
    """

    together: Share
    causes: tuple[Share, ...]
    unnamed: Share | None = None


def removed_from(
    experiments: Sequence[Experiment], base: Sequence[FloatArray], noise: Sequence[float]
) -> Removed:
    """Return what models remove of a base's held-out error in all channels.

    `base` are its predictions (n, channels) of all records, `noise` is the rms of each channel's
    noise in its unit.
    """
    return Removed(partial(_judged_errors, experiments), base, tuple(noise))


def _judged_errors(
    experiments: Sequence[Experiment], shown: Sequence[FloatArray]
) -> list[FloatArray]:
    """Return the errors (n, channels) where any channel is judged, else nan.

    A channel of which no sample is held out is judged by its fitted ones.
    """
    parts = []
    channels = range(len(experiments[0].channels))
    told = zip(*(counted(experiments, j) for j in channels), strict=True)
    for e, y, own in zip(experiments, shown, told, strict=True):
        which = np.column_stack(own)
        errors = np.column_stack([e.errors(j, y[:, j]) for j in channels])
        parts.append(np.where(which, errors, np.nan)[which.any(axis=1)])
    return parts


FORMAT = "psa_casadi.own_model_diagnosis/1"
#: What the document has of a correction.
_OF_CORRECTION = ("port", "of", "evidence", "share", "unit", "variable")


@dataclass(frozen=True)
class PortCause:
    """A named cause: the effect, the port where it sits, how sure, how large, what else it may be.

    `explained_share` is what it removes of the held-out error above the noise, beside the others.
    `remedy` is a code, `sizes` what the cause changes of every output within a record.
    """

    effect: str
    port: str
    belongs_to: str
    description: str
    confidence: float
    parameters: Mapping[str, Estimate]
    cannot_be_told_from: tuple[str, ...]
    explained_share: float
    remedy: str = ""
    sizes: tuple[Size, ...] = ()


@dataclass(frozen=True)
class OutputError:
    """The errors of one output in its unit: noise, and rms in held-out samples.

    Of the base and of the extended model; of the used samples where none is held out.
    """

    output: str
    unit: str
    noise: float
    base: float
    extended: float


@dataclass(frozen=True, eq=False)
class FreeFunction:
    """A function without a name `of` some variables, at a port, that would remove most of the rest.

    `share` of the base's held-out error above the noise; `evidence` is ln of its Bayes factor over
    the base. Along all records it adds `added` (n,) to the port's sum, in its `unit`; that follows
    the `variable`, of these the one that tells most of it, with the values `along` (n,).
    """

    port: str
    of: str
    evidence: float
    share: float
    unit: str
    variable: str
    variable_unit: str
    along: FloatArray
    added: FloatArray


@dataclass(frozen=True, eq=False, repr=False)
class OdeDiagnosis(Reported):
    """A diagnosis of any model: verdict, causes, the extended model, errors, and what remains.

    The words of the verdict are those of a stack's diagnosis. `base` and `extended` (n, ny) are the
    predictions of every experiment in full, in the order of `experiments`. `candidates` are all
    effects tried. `budget` says where the base's held-out error goes, with 95 % intervals. `missed`
    is what the base leaves, `remaining` what the extended model does. `free_function` says where
    one would remove most of what is left, None if nothing is; `correction` is that function.
    `remarks` are what else there is to say.
    """

    verdict: Verdict
    causes: tuple[PortCause, ...]
    candidates: tuple[Candidate, ...]
    errors: tuple[OutputError, ...]
    remaining: Remaining
    remarks: tuple[Note | str, ...]
    model: Model
    base_fit: Fit
    extended_fit: Fit
    experiments: tuple[Experiment, ...]
    base: tuple[FloatArray, ...]
    extended: tuple[FloatArray, ...]
    missed: Remaining
    budget: OdeBudget
    free_function: Note | None = None
    correction: FreeFunction | None = None

    @property
    def explained_share(self) -> float:
        """The share of the base's held-out error above the noise that all causes remove."""
        return self.budget.together.share

    @property
    def notes(self) -> tuple[str, ...]:
        """The remarks in sentences."""
        return texts(self.remarks)

    @property
    def unnamed(self) -> str:
        """Where a free function would remove most of what is left, "" if nothing is."""
        return "" if self.free_function is None else str(self.free_function)

    @property
    def moved(self) -> tuple[str, ...]:
        """What the base model's parameters became where the causes move them out of intervals."""
        before, after = self.base_fit.model.values, self.model.values
        return tuple(
            str(note("moved", name=n, estimate=(after[n], i.low, i.high), without=before[n],
                     unit=self.model.parameter(n).unit, causes=len(self.causes)))
            for n, i in self.model.provenance.intervals.items()
            if self.causes and n in before and not i.low <= before[n] <= i.high
        )  # fmt: skip

    def __repr__(self) -> str:
        """Return the verdict, the causes with their sizes, the errors and what remains."""
        return str(note("own_diagnosis", d=self))

    def to_dict(self) -> dict[str, Any]:
        """Return the diagnosis as plain lists and mappings."""
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "causes": [asdict(c) for c in self.causes],
            "candidates": [asdict(c) for c in self.candidates],
            "errors": [asdict(e) for e in self.errors],
            "missed": told(self.missed, "seen", "where"),
            "remaining": told(self.remaining, "seen", "where"),
            "unnamed": self.unnamed,
            "correction": None
            if self.correction is None
            else {n: getattr(self.correction, n) for n in _OF_CORRECTION},
            "budget": asdict(self.budget),
            "notes": list(self.notes),
            "values": dict(self.model.values),
            "records": [
                {"name": e.record.name, "sha256": e.record.sha256} for e in self.experiments
            ],
        }

    def to_json(self) -> str:
        """Return `to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"

    def to_frame(self) -> Any:
        """Return the samples as a pandas DataFrame: measured, base and extended by output.

        Names carry units: `speed [m/s]`, `speed_base [m/s]`, `speed_extended [m/s]`.
        """
        records = [e.record for e in self.experiments]
        columns: dict[str, Any] = {
            "record": np.repeat([r.name for r in records], [r.n for r in records]),
            "time": np.concatenate([r.time for r in records]),
            "held_out": np.concatenate([e.held_out for e in self.experiments]),
        }
        units = {"time": "s"}
        for k, (name, o) in enumerate(
            zip(self.model.output_names, self.model.structure.outputs, strict=True)
        ):
            units |= dict.fromkeys((name, f"{name}_base", f"{name}_extended"), o.unit)
            columns[name] = np.concatenate(
                [np.full(r.n, np.nan) if (y := r.column(name)) is None else y for r in records]
            )
            columns[f"{name}_base"] = np.concatenate([y[:, k] for y in self.base])
            columns[f"{name}_extended"] = np.concatenate([y[:, k] for y in self.extended])
        return frame(with_units(columns, units))
