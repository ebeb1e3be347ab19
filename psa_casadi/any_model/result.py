"""What a diagnosis of any model says, as frozen records."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.budget import OdeBudget
from psa_casadi.any_model.fit import OdeFit
from psa_casadi.any_model.runs import Run
from psa_casadi.diagnosis.remedy.size import Size
from psa_casadi.diagnosis.result import Candidate, Estimate, Remaining, Verdict
from psa_casadi.model.compose import Model
from psa_casadi.shown import Reported, frame, with_units

FloatArray = npt.NDArray[np.float64]
FORMAT = "psa_casadi.own_model_diagnosis/1"

_SAID: dict[Verdict, str] = {
    "adequate": "what the model leaves cannot be distinguished from noise",
    "cause_named": "{} named, and nothing else is left",
    "partly_explained": "{} named, and more is left",
    "ambiguous": "a cause is found that these records cannot tell from others",
    "unexplained": "something is missing that no effect of the table explains",
}


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

    def to_dict(self) -> dict[str, Any]:
        """Return its entry in the document, without the arrays."""
        names = ("port", "of", "evidence", "share", "unit", "variable")
        return {n: getattr(self, n) for n in names}


@dataclass(frozen=True, eq=False, repr=False)
class OdeDiagnosis(Reported):
    """A diagnosis of any model: verdict, causes, the extended model, errors, and what remains.

    The words of the verdict are those of a stack's diagnosis. `base` and `extended` (n, ny) are the
    predictions of every experiment in full, in the order of `runs`. `candidates` are all effects
    tried. `budget` says where the base's held-out error goes, with 95 % intervals. `missed` is what
    the base leaves, `remaining` what the extended model does. `unnamed` says where a free function
    would remove most of what is left, "" if nothing is; `correction` is that function.
    """

    verdict: Verdict
    causes: tuple[PortCause, ...]
    candidates: tuple[Candidate, ...]
    errors: tuple[OutputError, ...]
    remaining: Remaining
    notes: tuple[str, ...]
    model: Model
    base_fit: OdeFit
    extended_fit: OdeFit
    runs: tuple[Run, ...]
    base: tuple[FloatArray, ...]
    extended: tuple[FloatArray, ...]
    missed: Remaining
    budget: OdeBudget
    unnamed: str = ""
    correction: FreeFunction | None = None

    @property
    def explained_share(self) -> float:
        """The share of the base's held-out error above the noise that all causes remove."""
        return self.budget.together.share

    @property
    def moved(self) -> tuple[str, ...]:
        """What the base model's parameters became where the causes move them out of intervals."""
        before, after = self.base_fit.model.values, self.model.values
        told = self.model.provenance.intervals
        return tuple(
            f"{n} = {_told(after[n], i.low, i.high)}{_after(self.model.parameter(n).unit)}, without"
            f" the cause{'s' * (len(self.causes) > 1)} {before[n]:.4g}"
            for n, i in told.items()
            if self.causes and n in before and not i.low <= before[n] <= i.high
        )

    def __repr__(self) -> str:
        """Return the verdict, the causes with their sizes, the errors and what remains."""
        several = len(self.causes) > 1
        named = f"{len(self.causes)} causes are" if several else "a cause is"
        lines = [f"{self.verdict}: {_SAID[self.verdict].format(named)}"]
        for c, removed in zip(self.causes, self.budget.causes, strict=True):
            lines.append(
                f"  {c.effect} ({c.confidence:.0%} sure), {c.description}; it removes"
                f" {removed.text} of the held-out error above the noise"
            )
            lines += [
                f"    {n} = {_told(e.value, *e.interval)}{_after(e.unit)}"
                for n, e in c.parameters.items()
            ]
            if c.cannot_be_told_from:
                lines.append(f"    may as well be {', '.join(c.cannot_be_told_from)}")
        if several:
            lines.append(f"  together they remove {self.budget.together.text} of it")
        for o in self.errors:
            unit = _after(o.unit)
            lines.append(
                f"  {o.output}: held-out rms {o.base:.3g}{unit} of the base,"
                f" {o.extended:.3g}{unit} of the extended model, noise {o.noise:.3g}{unit}"
            )
        lines += [f"  {line}" for line in self.moved]
        lines += [
            f"  {self.remaining.where}",
            *(f"  {n}" for n in (*self.notes, self.unnamed) if n),
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the diagnosis as plain lists and mappings."""
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "causes": [asdict(c) for c in self.causes],
            "candidates": [asdict(c) for c in self.candidates],
            "errors": [asdict(e) for e in self.errors],
            "missed": asdict(self.missed),
            "remaining": asdict(self.remaining),
            "unnamed": self.unnamed,
            "correction": None if self.correction is None else self.correction.to_dict(),
            "budget": asdict(self.budget),
            "notes": list(self.notes),
            "values": dict(self.model.values),
            "records": [{"name": r.name, "sha256": r.signals.sha256} for r in self.runs],
        }

    def to_json(self) -> str:
        """Return `to_dict` as JSON text."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"

    def to_frame(self) -> Any:
        """Return the samples as a pandas DataFrame: measured, base and extended by output.

        Names carry units: `speed [m/s]`, `speed_base [m/s]`, `speed_extended [m/s]`.
        """
        columns: dict[str, Any] = {
            "record": np.repeat([r.name for r in self.runs], [len(r.time) for r in self.runs]),
            "time": np.concatenate([r.signals.time for r in self.runs]),
            "held_out": np.concatenate([r.held_out for r in self.runs]),
        }
        units = {"time": "s"}
        for k, (name, o) in enumerate(
            zip(self.model.output_names, self.model.structure.outputs, strict=True)
        ):
            units |= dict.fromkeys((name, f"{name}_base", f"{name}_extended"), o.unit)
            columns[name] = np.concatenate([r.outputs[:, k] for r in self.runs])
            columns[f"{name}_base"] = np.concatenate([y[:, k] for y in self.base])
            columns[f"{name}_extended"] = np.concatenate([y[:, k] for y in self.extended])
        return frame(with_units(columns, units))


def _after(unit: str) -> str:
    return "" if unit in ("", "1") else f" {unit}"


def _told(value: float, low: float, high: float) -> str:
    """Return a value with its interval, in as many digits as tell them apart, four at least."""
    half = max(high - value, value - low)
    digits = 4
    if 0.0 < half < abs(value):
        digits = max(4, min(9, 1 + int(np.ceil(np.log10(abs(value) / half)))))
    return f"{value:.{digits}g} ({low:.{digits}g} to {high:.{digits}g})"
