"""What now: how large a cause is for this device, what to do, and which file comes next."""

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

from psa_casadi.any_model.result import OdeDiagnosis, PortCause
from psa_casadi.component import Component
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.diagnosis.result import Cause, Diagnosis
from psa_casadi.effects import EFFECTS
from psa_casadi.model.compose import Model
from psa_casadi.model.stacks import STACKS
from psa_casadi.report.words.phrases import (
    handy_scale,
    listing,
    number,
    percent,
    plain,
    scale_of,
    shown_in,
    with_unit,
)
from psa_casadi.report.words.remedies import DO, RECORDS
from psa_casadi.report.words.size_words import Length, size_text
from psa_casadi.report.words.verdict_words import added, within
from psa_casadi.units import convert

#: The files of a base and an extended model where none was named, as the documentation calls them.
_FILES = ("model.json", "extended.json")
#: Causes whose remedies are told, and rivals of each.
_CAUSES, _RIVALS = 3, 2


@dataclass(frozen=True)
class Advice:
    """What to do: a sentence for every cause, what else counts, and commands to type."""

    causes: tuple[str, ...]
    beside: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()


def what_now(d: Diagnosis | OdeDiagnosis, model_file: str | None = None) -> Advice:
    """Return what to do after a diagnosis; `model_file` is where its model was written."""
    if isinstance(d, OdeDiagnosis):
        return _of_own(d)
    if d.verdict == "not_driven":
        return Advice((
            "See that both columns are of one run and of one axis, that the amplifier was on, and"
            " that units and sign are right.",
        ))  # fmt: skip
    scale = scale_of(d.experiments, d.extended_errors.holdout_rms_m)
    error, noise = scale.text(d.extended_errors.holdout_rms_m), scale.text(d.noise_floor_rms_m)
    commands, beside = _commands(d, model_file)
    if d.verdict == "adequate" and d.doubt:
        said = "Use the model within these records only: their held-out samples cannot confirm it."
        return Advice((said,), beside, commands[:1])
    if d.verdict == "adequate":
        said = (
            f"Use the model: it errs by {error} rms on samples that no fit has seen, at a noise of"
            f" {noise}. Other voltages, rates and durations than these are untested."
        )
        return Advice((said,), beside, commands)
    if not d.causes:
        return _unexplained(d, error, beside, commands)
    if d.verdict == "partly_explained" and d.budget is not None:
        left = scale_of(d.experiments, d.budget.remains_rms_m).text(d.budget.remains_rms_m)
        beside = (f"Without an explanation stays {left} rms above the noise.", *beside)
    lines = tuple(_of_cause(c, lambda v: scale_of(d.experiments, v)) for c in d.causes[:_CAUSES])
    return Advice(lines, (*_rivals(d.causes), *beside), commands)


def _unexplained(
    d: Diagnosis, error: str, beside: tuple[str, ...], commands: tuple[str, ...]
) -> Advice:
    """Return what to do without a name."""
    said = (
        f"Do not correct the device by a name: none is certain. Take {error} rms as the model's"
        " error, and measure the next record."
    )
    if d.patch is None or d.budget is None or d.budget.unnamed is None:
        return Advice((said,), beside, commands)
    share = percent(within(d.budget.unnamed.share))
    patched = (
        "To predict without a name, --patch patched.json writes the model with the unnamed"
        f" correction, which removes {share} of the error above the noise."
    )
    return Advice((said,), (patched, *beside), commands)


def _commands(d: Diagnosis, model_file: str | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the commands that take the model further, and what must be said of its file."""
    file = model_file or _FILES[added(d)]
    fmu = shlex.quote(str(PurePath(file).with_suffix(".fmu")))
    model = f"--model {shlex.quote(file)}"
    commands = [f"psa export fmu {model} -o {fmu}"]
    outside = [c for c in d.causes if not _in_plant(c)]
    if d.verdict in ("adequate", "cause_named", "partly_explained") and len(outside) < max(
        len(d.causes), 1
    ):
        commands.append(f"psa design input {model} --target PATH.csv -o VOLTAGE.csv")
    open_ones = [c for c in d.causes if c.cannot_be_told_from]
    if open_ones and d.next_experiment.voltage_csv is None:
        first = open_ones[0]
        names = " ".join((first.effect, *first.cannot_be_told_from[:_RIVALS]))
        commands.append(
            f"psa design experiment {model} --record RECORD.csv --separate {names} -o NEXT.csv"
        )
    said = []
    if outside:
        names = listing([plain(c.effect) for c in outside])
        said.append(f"An exported plant leaves out {names}: correct the reading instead.")
    if model_file is None:
        said.append(
            f"The commands read {file}: write it with -o {file}, in Python with"
            f' psa.save_model(result.model, "{file}").'
        )
    return tuple(commands), tuple(said)


def _in_plant(cause: Cause) -> bool:
    return cause.belongs_to not in ("sensor", "environment")


def _of_cause(cause: Cause | PortCause, length: Length) -> str:
    """Return how large a cause is and what to do about it."""
    size, do = size_text(cause.sizes, length), DO.get(cause.remedy, DO["extended_model"])
    against = f"{size}. Against it: {_lower(do)}" if size else _lower(do)
    return f"{plain(cause.effect).capitalize()}: {against}."


def _rivals(causes: Sequence[Cause]) -> list[str]:
    """Return what else to do where the data leave open what a cause is."""
    lines = []
    for cause in causes:
        known = [EFFECTS[n] for n in cause.cannot_be_told_from[:_RIVALS] if n in EFFECTS]
        each = [f"{plain(e.name)}: {_lower(DO[e.what_now.code])}" for e in known]
        if each:
            own = [EFFECTS[cause.effect]] if cause.effect in EFFECTS else []
            tests = dict.fromkeys(e.what_now.test for e in (*own, *known))
            shown = listing([RECORDS[t] for t in tests])
            lines.append(
                f"The record does not decide; in the place of {plain(cause.effect)} it may be"
                f" {'; or '.join(each)}. What decides: {shown}."
            )
    return lines


def _of_own(d: OdeDiagnosis) -> Advice:
    """Return what to do after the diagnosis of a model of one's own."""
    if d.verdict == "adequate":
        return Advice(("Use the model: what it misses cannot be told from noise.",))
    if not added(d):
        law = (
            f"Write the law of {d.correction.of} in {d.correction.port} into the equations, with"
            " its parameter free, and diagnose again."
            if d.correction is not None
            else "Record more of what may matter: another input, level or output."
        )
        return Advice((f"Do not correct the device by a name: none is certain. {law}",))
    lines = tuple(_of_cause(c, handy_scale) for c in d.causes[:_CAUSES])
    open_ones = [n for c in d.causes for n in c.cannot_be_told_from]
    beside = [
        "`result.model` is the extended model: psa.export_fmu(result.model, PATH) exports it."
    ]
    if open_ones:
        beside.insert(0, "The records do not decide: record another level, rate or output as well.")
    return Advice(lines, tuple(beside))


def effect_size(effect: Component, model: Model, sizes: Sequence[Size]) -> str:
    """Return how large an effect of a model is, with the size of its gain."""
    name = effect.gain or ""
    unit, display = shown_in(model, name)
    gain = with_unit(number(convert(model.values[name], unit, display), 2), display)
    size = size_text(sizes, handy_scale) or "it changes too little to be seen in its test"
    stack = next((n for n in STACKS if re.sub(r"\W", "_", n) == model.name), "this model")
    return f"on {stack} with {name} = {gain}: {size}"


def effect_advice(effect: Component) -> tuple[str, str]:
    """Return what to do about an effect, and which record shows it."""
    return DO[effect.what_now.code], RECORDS[effect.what_now.test]


def _lower(text: str) -> str:
    return f"{text[0].lower()}{text[1:]}"
