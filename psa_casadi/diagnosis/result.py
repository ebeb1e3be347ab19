"""The result of a diagnosis of any model, and what a stack's adds to it; DIAGNOSIS.json."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, Self

import numpy as np

from psa_casadi.common.display import Reported, frame, made, with_units
from psa_casadi.common.notes import Note, note, texts
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.corrections import Correction, Estimate, Family, FreeFunction, Patch
from psa_casadi.diagnosis.held_out import Budget, Errors, Gain, StackBudget
from psa_casadi.diagnosis.misfit import Misfit
from psa_casadi.diagnosis.noise import NoiseFloor
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.compose import Model
from psa_casadi.records.noise_kinds import NoiseFound, notes_of
from psa_casadi.records.split import Experiment

Verdict = Literal[
    "adequate", "cause_named", "partly_explained", "ambiguous", "unexplained", "not_driven"
]

#: The formats of a stack's DIAGNOSIS.json, and of any other model's.
FORMAT, ANY_MODEL = "psa_casadi.diagnosis/1", "psa_casadi.own_model_diagnosis/1"
#: What remains is noise.
NOISE = note("noise_only")


@dataclass(frozen=True)
class Cause:
    """A named cause: where it sits, how sure, how large, and what else it may be.

    `explained_share` is what it removes of the held-out error above the noise, with the others in
    the model. `remedy` is the code of what to do about it, `sizes` what it changes in the tests
    that the effect declares. Of any model, `port` is where it adds to the equations. `families` are
    the places and kinds that it may be of, the most probable first; `confidence` counts what is not
    listed.
    """

    effect: str
    belongs_to: str
    confidence: float
    parameters: Mapping[str, Estimate]
    cannot_be_told_from: tuple[str, ...]
    explained_share: float
    remedy: str = ""
    sizes: tuple[Size, ...] = ()
    port: str = ""
    description: str = ""
    families: tuple[Family, ...] = ()


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


@dataclass(frozen=True)
class Candidate:
    """An effect that was tried: share of the excess it explains, and its evidence over the base.

    `evidence` is ln of the Bayes factor, held-out blocks included; estimated from the screening of
    fitted samples where nothing was `fitted`, and of effects that bend the same curve that of the
    best one; `probability` that of being the cause, on condition that one effect of the table is.
    """

    effect: str
    explained_share: float
    evidence: float
    fitted: bool
    probability: float = 0.0


@dataclass(frozen=True)
class BlindSpot:
    """An effect of practical size that the records could not show."""

    effect: str
    smallest_detectable_gain: float
    unit: str
    reason: Note | str

    @property
    def why(self) -> str:
        """The reason as a sentence."""
        return str(self.reason)


@dataclass(frozen=True)
class Remaining:
    """What is left: whether it is noise, and what shows in it where it is not."""

    white: bool
    p_value: float
    finding: Note | str = NOISE

    @property
    def where(self) -> str:
        """What shows, as a sentence."""
        return str(self.finding)


@dataclass(frozen=True)
class NextExperiment:
    """The experiment that would distinguish the rivals.

    `voltage_csv` is the file with the voltage to play, where one was written; `reasons` say what it
    is good for; `chance` is for each rival the probability that it is then named, if it is the one.
    """

    voltage_csv: str | None
    separates: tuple[str, ...]
    reasons: tuple[Note | str, ...]
    chance: Mapping[str, float] = field(default_factory=dict)

    @property
    def why(self) -> str:
        """The reasons in sentences."""
        return " ".join(texts(self.reasons))


@dataclass(frozen=True, eq=False)
class Contender:
    """An effect that may be the cause: its fit, and ln of the Bayes factor over the base."""

    effect: str
    fit: Fit
    evidence: float


@dataclass(frozen=True, eq=False)
class Alternative:
    """The extended model with another effect `instead` of an indistinguishable `cause`.

    One of the two belongs to the plant, the other to sensor or environment. `rms_ratio` is the
    residual's rms over that of the extended model; the displacements of the two exported plants
    differ on the records by at most `plant_differs_m`, in % of the largest range
    `plant_differs_percent`.
    """

    cause: str
    instead: str
    model: Model
    rms_ratio: float
    plant_differs_m: float
    plant_differs_percent: float

    def to_dict(self) -> dict[str, Any]:
        """Return its entry in DIAGNOSIS.json."""
        names = ("cause", "instead", "rms_ratio", "plant_differs_m", "plant_differs_percent")
        return {n: getattr(self, n) for n in names}


@dataclass(frozen=True)
class Decision:
    """What a further column decided: what is named with it and without it, and the outcome.

    An `output` is fitted, with `noise` and held-out errors `base_rms` and `extended_rms` in its SI
    `unit`; an `input` drives the model, and has none. `named` and `named_without` hold the named
    sets with their probabilities, `ruled_out` what is only in the latter; `evidence` is what the
    column adds to ln of the Bayes factor of the extended model over the base.
    """

    column: str
    role: Literal["output", "input"]
    unit: str
    noise: float | None
    base_rms: float | None
    extended_rms: float | None
    named: Mapping[str, float]
    named_without: Mapping[str, float]
    ruled_out: tuple[str, ...]
    evidence: float
    outcome: Note

    @property
    def sentence(self) -> str:
        """The outcome as a sentence."""
        return str(self.outcome)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Diagnosis(Reported):
    """A diagnosis of any model: verdict, causes, the base and the extended model, what remains.

    `base_fit` and `extended_fit` are equal where nothing was added. `base` and `extended` (n, ny)
    are the predictions of every record in full, in the order of `experiments`. `candidates` are all
    effects tried, `errors` those of every measured output. `base_remaining` is what the base
    leaves, `remaining` what the extended model does. `budget` states where the base's held-out
    error goes, `patch` is the unnamed correction that removes most of what the named causes leave,
    `families` are the places and kinds that this may be of.
    `doubted` states why held-out samples cannot confirm a cause, None where they can; `remarks` are
    all other notes. `noise_kinds` are those in what the extended model leaves of every output.
    """

    verdict: Verdict
    causes: tuple[Cause, ...]
    candidates: tuple[Candidate, ...]
    errors: tuple[OutputError, ...] = ()
    base_remaining: Remaining = Remaining(True, 1.0)
    remaining: Remaining
    remarks: tuple[Note | str, ...]
    experiments: tuple[Experiment, ...]
    base_fit: Fit
    extended_fit: Fit
    base: tuple[FloatArray, ...]
    extended: tuple[FloatArray, ...]
    model: Model
    doubted: Note | None = None
    budget: Budget
    patch: Correction | None = None
    families: tuple[Family, ...] = ()
    noise_kinds: tuple[NoiseFound, ...] = ()

    def with_noise(self, noise: Sequence[NoiseFound], remarks: Sequence[Note | str]) -> Self:
        """Return it with the noise that its extended model leaves, and with further `remarks`.

        A reading that jumps a few times and stays there is no noise: nothing is `adequate` then.
        """
        notes = notes_of(noise)
        jumps = [t for t in notes if t.values["kind"] == "steps"]
        result = replace(self, remarks=(*self.remarks, *remarks, *notes), noise_kinds=tuple(noise))
        if not jumps or self.verdict != "adequate":
            return result
        left = Remaining(False, self.base_remaining.p_value, jumps[0])
        return replace(result, verdict="unexplained", base_remaining=left, remaining=left)

    @property
    def doubt(self) -> str:
        """Why held-out samples cannot confirm a cause, "" where they can."""
        return "" if self.doubted is None else str(self.doubted)

    @property
    def notes(self) -> tuple[str, ...]:
        """The remarks in sentences."""
        return texts(self.remarks)

    @property
    def kept(self) -> tuple[str, ...]:
        """Effects that the extended model holds and that are not named as causes."""
        return unnamed_causes(self.budget, self.causes)

    @property
    def explained_share(self) -> float:
        """The share of the base's held-out error above the noise that all causes remove."""
        return self.budget.together.share

    @property
    def correction(self) -> FreeFunction | None:
        """The unnamed correction, where it is a free function of any model."""
        return self.patch if isinstance(self.patch, FreeFunction) else None

    @property
    def unnamed(self) -> str:
        """Where an unnamed correction would remove most of what is left, "" if none does."""
        if self.patch is None:
            return ""
        return str(note("would_remove", what=self.patch.label, share=self.patch.share))

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

    def predictions(self, channel: int) -> tuple[Sequence[FloatArray], Sequence[FloatArray]]:
        """Return what base and extended model predict of a channel along every record (n,)."""
        (output,) = self.experiments[0].channels[channel].outputs
        k = self.model.output_names.index(output)
        base, extended = ([y[:, k] for y in model] for model in (self.base, self.extended))
        return base, extended

    def __repr__(self) -> str:
        """Return the verdict, the causes with their sizes, the errors and what remains."""
        return str(made("diagnosis_text", self))

    def to_frame(self) -> Any:
        """Return the samples as a pandas DataFrame: measured, base and extended by output.

        Names carry units: `speed [m/s]`, `speed_base [m/s]`, `speed_extended [m/s]`.
        """
        columns, units = self._about_records(), {"time": "s"}
        records = [e.record for e in self.experiments]
        for k, o in enumerate(self.model.structure.outputs):
            units |= dict.fromkeys((o.name, f"{o.name}_base", f"{o.name}_extended"), o.unit)
            columns[o.name] = np.concatenate(
                [np.full(r.n, np.nan) if (y := r.column(o.name)) is None else y for r in records]
            )
            columns[f"{o.name}_base"] = np.concatenate([y[:, k] for y in self.base])
            columns[f"{o.name}_extended"] = np.concatenate([y[:, k] for y in self.extended])
        return frame(with_units(columns, units))

    def _about_records(self) -> dict[str, Any]:
        records = [e.record for e in self.experiments]
        return {
            "record": np.repeat([r.name for r in records], [r.n for r in records]),
            "time": np.concatenate([r.time for r in records]),
            "held_out": np.concatenate([e.held_out for e in self.experiments]),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the content of DIAGNOSIS.json."""
        correction = self.correction
        return {
            "format": ANY_MODEL,
            **self._common(),
            "errors": [asdict(e) for e in self.errors],
            "correction": None if correction is None else correction.to_dict(),
        }

    def _common(self) -> dict[str, Any]:
        """Return what the file of every diagnosis has."""
        return {
            "verdict": self.verdict,
            "doubt": self.doubt,
            "causes": [asdict(c) for c in self.causes],
            "candidates": [asdict(c) for c in self.candidates],
            "budget": asdict(self.budget),
            "missed": with_text(self.base_remaining, "finding", "where"),
            "remaining": with_text(self.remaining, "finding", "where"),
            "unnamed": self.unnamed,
            "families": [asdict(f) for f in self.families],
            "notes": list(self.notes),
            "noise_kinds": [asdict(n) for n in self.noise_kinds],
            "values": dict(self.model.values),
            "records": [
                {"name": e.record.name, "sha256": e.record.sha256} for e in self.experiments
            ],
        }

    def to_json(self) -> str:
        """Return the text of DIAGNOSIS.json."""
        return json.dumps(self.to_dict(), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class StackDiagnosis(Diagnosis):
    """A diagnosis of a stack, whose one output is its displacement.

    `base` and `extended` (n,) are its predictions [m]. `noise` is the floor of every record;
    `misfit` and `remainder` are what base and extended model get wrong in it, for records with
    enough samples. `contenders` are the fitted rivals of an ambiguous verdict. `alternatives` are
    models for causes of which the records do not show whether an exported plant holds them.
    `columns` say what each further column of the records decided.
    """

    noise_floor_rms_m: float
    base_errors: Errors
    extended_errors: Errors
    gain: Gain
    blind_to: tuple[BlindSpot, ...]
    next_experiment: NextExperiment
    noise: tuple[NoiseFloor, ...] = ()
    misfit: tuple[Misfit, ...] = ()
    remainder: tuple[Misfit, ...] = ()
    contenders: tuple[Contender, ...] = ()
    budget: StackBudget
    patch: Patch | None = None
    alternatives: tuple[Alternative, ...] = ()
    columns: tuple[Decision, ...] = ()

    __repr__ = Reported.__repr__

    def predictions(self, channel: int) -> tuple[Sequence[FloatArray], Sequence[FloatArray]]:
        """Return what base and extended model predict of the displacement, channel 0 [m]."""
        return self.base, self.extended

    def to_frame(self) -> Any:
        """Return the samples as a pandas DataFrame: `time [s]`, `measured [m]`, `base [m]`, ..."""
        columns = self._about_records()
        held_out, records = columns.pop("held_out"), [e.record for e in self.experiments]
        columns |= {
            "voltage": np.concatenate([r.voltage for r in records]),
            "measured": np.concatenate([r.measured for r in records]),
            "base": np.concatenate(self.base),
            "extended": np.concatenate(self.extended),
            "held_out": held_out,
        }
        length = records[0].displacement_unit
        units = {"time": "s", "voltage": "V"} | dict.fromkeys(
            ("measured", "base", "extended"), length
        )
        return frame(with_units(columns, units))

    def to_dict(self) -> dict[str, Any]:
        """Return the content of DIAGNOSIS.json."""
        return {
            "format": FORMAT,
            **self._common(),
            "errors": {
                "noise_floor_rms_m": self.noise_floor_rms_m,
                "base": asdict(self.base_errors),
                "extended": asdict(self.extended_errors),
            },
            "gain": asdict(self.gain),
            "patch": None if self.patch is None else self.patch.to_dict(),
            "alternatives": [a.to_dict() for a in self.alternatives],
            "columns": [with_text(c, "outcome", "sentence") for c in self.columns],
            "blind_to": [with_text(b, "reason", "why") for b in self.blind_to],
            "next_experiment": with_text(self.next_experiment, "reasons", "why"),
            "noise": [
                {"record": n.record, "rms": n.level, "source": n.source, "sentence": n.sentence}
                for n in self.noise
            ],
            "misfit": [_misfit(m) for m in self.misfit],
            "remainder": [_misfit(m) for m in self.remainder],
        }


def with_text(part: Any, code: str, text: str) -> dict[str, Any]:
    """Return a part of a result for a file: the sentence in the place of its code."""
    return {
        text if n == code else n: getattr(part, text) if n == code else v
        for n, v in asdict(part).items()
    }


def unnamed_causes(budget: Budget | None, causes: tuple[Cause, ...]) -> tuple[str, ...]:
    """Return the causes in an error budget that are not named."""
    named = {c.effect for c in causes}
    held = () if budget is None else budget.causes
    return tuple(c.what for c in held if c.what not in named)


class DiagnosisInterrupted(KeyboardInterrupt):
    """A keyboard interrupt ended a diagnosis; `model` is the best so far, marked as interrupted.

    Its effects, if it has any, were not judged. `str(error)` states what the model is.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        effects = ", ".join(c.name for c in model.effects)
        what = f"the base model with {effects}, not judged" if effects else "the base model"
        super().__init__(f"the best fit so far is {what}; its values are not final")


def _misfit(m: Misfit) -> dict[str, Any]:
    """Return what shows in one record's residual: shares of its power above the noise."""
    return {
        "record": m.record,
        "rms": m.rms,
        "excess": m.excess,
        "views": {v.name: v.share for v in m.views},
        "sentences": list(m.sentences),
    }
