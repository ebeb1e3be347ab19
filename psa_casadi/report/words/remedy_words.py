"""What now: how large a cause is for this device, what to do, and which file comes next."""

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from psa_casadi.diagnosis.held_out import StackBudget
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.diagnosis.result import Cause, Diagnosis, StackDiagnosis
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.stacks import STACKS
from psa_casadi.report.words.catalogue import TABLES, say
from psa_casadi.report.words.phrases import (
    Scale,
    added,
    handy_scale,
    in_display_unit,
    interval_digits,
    interval_text,
    listing,
    lowered,
    number,
    percent,
    plain,
    prefixed_scale,
    raised,
    scale_of,
    with_its_unit,
    with_unit,
    within,
)
from psa_casadi.report.words.verdict_words import since_reference

#: What can be done by the codes of remedies, and the record that shows an effect by its test.
DO: Mapping[str, str] = TABLES["remedy"]
RECORDS: Mapping[str, str] = TABLES["showing_record"]

#: Returns the scale of a length [m].
Length = Callable[[float], Scale]


def size_text(sizes: Sequence[Size], length: Length) -> str:
    """Return what the tests of one effect give, as a sentence without its full stop."""
    if not sizes:
        return ""
    first, scale = sizes[0], length(max(abs(s.value) for s in sizes))  # one unit in a sentence
    low, high = first.voltages or (0.0, 0.0)
    each = [_amount(s, scale) for s in sizes]
    values: dict[str, Any] = {}
    if first.test == "hold":
        times = [f"{s.at:g} s" if s.at < 60.0 else f"{s.at / 60.0:g} min" for s in sizes]
        by = [f"{text} in {time}" for text, time in zip(each, times, strict=True)]
        beyond = [time for s, time in zip(sizes, times, strict=True) if s.beyond_records]
        values = {"by": by, "beyond": beyond}
    elif first.test == "record":
        amounts = {(s.test, s.output): amount for s, amount in zip(sizes, each, strict=True)}
        still = {s.output for s in sizes if s.value == 0.0} if len(sizes) > 1 else set()
        moves = [
            f"the {plain(o)} by up to {a}"
            for (test, o), a in amounts.items()
            if test == "record" and o not in still
        ]
        values = {"moves": moves, "rms": [a for (test, _), a in amounts.items() if test == "rms"]}
    return say(f"size.{first.test}", sizes=sizes, each=each, low=low, high=high, **values)


def _amount(size: Size, length: Scale) -> str:
    """Return a figure with its interval, without its sign."""
    value = abs(size.value)
    in_metres = size.unit == "m" and size.output == "displacement"
    scale = length if in_metres or size.unit == "counts" else prefixed_scale(value, size.unit)
    if size.interval is None:
        return scale.text(value)
    ends = sorted(scale.factor * abs(v) for v in size.interval)
    return f"{scale.text(value, interval_digits(*ends))} ({interval_text(*ends)})"


#: The files of a base and an extended model where none was named, as the documentation calls them.
FILES = ("model.json", "extended.json")
#: Causes with a remedy, and rivals of each.
_CAUSES, _RIVALS = 3, 2


@dataclass(frozen=True)
class Advice:
    """What to do: a sentence for every cause, what else counts, and commands to type."""

    causes: tuple[str, ...]
    remarks: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()


def what_now(d: Diagnosis, model_file: str | None = None) -> Advice:
    """Return what to do after a diagnosis; `model_file` is where its model was written."""
    if d.verdict == "not_driven":
        return Advice((say("now.not_driven"),))
    stack = isinstance(d, StackDiagnosis)
    errors, noise = _sizes(d)
    commands, remarks = _commands(d, model_file)
    if d.verdict == "adequate" and d.doubt:
        return Advice((say("now.unconfirmed"),), remarks, commands[:1])
    if d.verdict == "adequate":
        since = since_reference(d)
        text = say("now.adequate", errors=errors, noise=noise, stack=stack, **since)
        return Advice((text,), remarks, commands)
    if not d.causes:
        if d.patch is not None and d.budget.unnamed is not None:
            share = percent(within(d.budget.unnamed.share))
            remarks = (say("now.patched", share=share), *remarks)
        return Advice((say("now.no_cause", errors=errors, stack=stack, d=d),), remarks, commands)
    if d.verdict == "partly_explained" and isinstance(d.budget, StackBudget):
        left = scale_of(d.experiments, d.budget.remains_rms_m).text(d.budget.remains_rms_m)
        remarks = (f"Without an explanation stays {left} rms above the noise.", *remarks)
    lines = tuple(_of_cause(c, lambda v: scale_of(d.experiments, v)) for c in d.causes[:_CAUSES])
    return Advice(lines, (*_rivals(d.causes), *remarks), commands)


def _sizes(d: Diagnosis) -> tuple[str, str]:
    """Return the extended model's held-out error in every output, and the noise."""
    if isinstance(d, StackDiagnosis):
        scale = scale_of(d.experiments, d.extended_errors.holdout_rms_m)
        error = f"{scale.text(d.extended_errors.holdout_rms_m)} rms"
        return error, scale.text(d.noise_floor_rms_m)
    of = len(d.errors) > 1
    rows = [(e.extended, e.noise, e.unit, f" of {e.output}" * of) for e in d.errors]
    errors = [f"{with_its_unit(error, unit)} rms{name}" for error, _, unit, name in rows]
    return listing(errors), listing([with_its_unit(noise, unit) for _, noise, unit, _ in rows])


def _commands(d: Diagnosis, model_file: str | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the commands that take the model further, and remarks on its file."""
    stack = d if isinstance(d, StackDiagnosis) else None
    if not (stack or model_file or added(d)):
        return (), ()  # its equations are already there
    file = model_file or FILES[added(d)]
    if d.model.structure.foreign:
        around = d.causes and all(c.belongs_to in ("drive", "sensor") for c in d.causes)
        ssp = shlex.quote(str(PurePath(file).with_suffix(".ssp")))
        command = f"psa export ssp --model {shlex.quote(file)} -o {ssp}"
        return ((command,) if around and model_file else ()), ()
    fmu = shlex.quote(str(PurePath(file).with_suffix(".fmu")))
    model = f"--model {shlex.quote(file)}"
    commands = [f"psa export fmu {model} -o {fmu}"]
    outside = [c for c in d.causes if c.belongs_to in ("sensor", "environment")]
    usable = d.verdict in ("adequate", "cause_named", "partly_explained")
    if stack and usable and len(outside) < max(len(d.causes), 1):
        commands.append(f"psa design input {model} --target PATH.csv -o VOLTAGE.csv")
    open_ones = [c for c in d.causes if c.cannot_be_told_from]
    if stack and open_ones and stack.next_experiment.voltage_csv is None:
        first = open_ones[0]
        names = " ".join((first.effect, *first.cannot_be_told_from[:_RIVALS]))
        commands.append(
            f"psa design experiment {model} --record RECORD.csv --separate {names} -o NEXT.csv"
        )
    remarks = []
    if outside:
        names = listing([plain(c.effect) for c in outside])
        remarks.append(f"An exported plant leaves out {names}: correct the reading instead.")
    if model_file is None:
        remarks.append(say("now.unwritten", file=file))
    return tuple(commands), tuple(remarks)


def _of_cause(cause: Cause, length: Length) -> str:
    """Return how large a cause is and what to do about it."""
    size, do = size_text(cause.sizes, length), DO.get(cause.remedy, DO["extended_model"])
    against = f"{size}. Against it: {lowered(do)}" if size else lowered(do)
    return f"{raised(plain(cause.effect))}: {against}."


def _rivals(causes: Sequence[Cause]) -> list[str]:
    """Return what else to do where the data leave open what a cause is."""
    lines = []
    for cause in causes:
        known = [EFFECTS[n] for n in cause.cannot_be_told_from[:_RIVALS] if n in EFFECTS]
        each = [f"{plain(e.name)}: {lowered(DO[e.what_now.code])}" for e in known]
        if each:
            cause_effect = [EFFECTS[cause.effect]] if cause.effect in EFFECTS else []
            tests = dict.fromkeys(e.what_now.test for e in (*cause_effect, *known))
            decides = listing([RECORDS[t] for t in tests])
            lines.append(say("now.open", effect=cause.effect, each=each, decides=decides))
        elif cause.cannot_be_told_from:
            lines.append(say("now.open_place"))
    return list(dict.fromkeys(lines))


def effect_size(effect: Component, model: Model, sizes: Sequence[Size]) -> str:
    """Return how large an effect of a model is, with the size of its gain."""
    name = effect.gain or ""
    unit, (value,) = in_display_unit(model, name, model.values[name])
    gain = with_unit(number(value, 2), unit)
    size = size_text(sizes, handy_scale) or "its change is too small to observe in its test"
    stack = next((n for n in STACKS if re.sub(r"\W", "_", n) == model.name), "this model")
    return f"on {stack} with {name} = {gain}: {size}"


def effect_advice(effect: Component) -> tuple[str, str]:
    """Return what to do about an effect, and which record shows it."""
    return DO[effect.what_now.code], RECORDS[effect.what_now.test]
