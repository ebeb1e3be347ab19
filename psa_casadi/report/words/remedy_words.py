"""What now: how large a cause is for this device, what to do, and which file comes next."""

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

from psa_casadi.diagnosis.held_out import StackBudget
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.diagnosis.result import Cause, Diagnosis, StackDiagnosis
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.stacks import STACKS
from psa_casadi.report.words.phrases import (
    Scale,
    added,
    handy_scale,
    in_display_unit,
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
)
from psa_casadi.report.words.verdict_words import within

_FEED_FORWARD = "correct the voltage by the extended model (feed-forward)"

#: What can be done. Those below the comment are the kinds of effects of any other model.
DO: Mapping[str, str] = {
    "extended_model": "Use the extended model in the place of the base",
    "wait_or_feed_forward": (
        f"Wait until it has died out, close a loop around a position sensor, or {_FEED_FORWARD}"
    ),
    "undo_hysteresis": (
        f"Approach every position from the same side, {_FEED_FORWARD} or by a hysteresis"
        " compensator, drive the charge instead of the voltage, or close a loop"
    ),
    "undo_curve": f"Use less of the range, {_FEED_FORWARD}, or close a loop",
    "control_charge": (
        "Give the amplifier the current that the larger capacitance takes, or drive the charge"
    ),
    "avoid_resonance": (
        "Keep the drive below that frequency (longer edges, a notch filter), or stiffen or damp"
        " what rings"
    ),
    "undo_load_curve": (
        "Find what the output works against (guide, disc spring, contact) and make it linear, or"
        f" {_FEED_FORWARD}"
    ),
    "preload": (
        "Preload or clamp the joint so that it keeps its contact, or stay on one side of where it"
        " is lost"
    ),
    "cool": f"Drive slower or less far, let it rest between fast runs, cool it, or {_FEED_FORWARD}",
    "identify_again": "Identify the gain again from time to time, or close a loop",
    "more_current": "Use longer edges, or an amplifier that delivers more current",
    "stay_below_level": "Stay below the level, or use an amplifier that puts out more voltage",
    "better_drive": "Drive slower, use an amplifier with more bandwidth, or let the model lead",
    "measure_voltage": (
        "Record the voltage at the stack in the place of the command, calibrate the amplifier, or"
        f" {_FEED_FORWARD}"
    ),
    "hold_charge": (
        "Give the charge drive a longer time constant, control the voltage in slow motion, or close"
        " a loop"
    ),
    "align_clocks": (
        "Shift the reading's time by the delay, or sample both channels by one clock; in a loop the"
        " delay costs phase"
    ),
    "faster_sensor": "Give the sensor more bandwidth, or take the lag off the reading",
    "calibrate_sensor": "Calibrate the sensor against a better one, and correct its reading",
    "zero_again": "Let the sensor warm up, and take its zero before and after every run",
    "shield": (
        "Shield and ground the sensor's cable, average over whole periods, or filter that frequency"
    ),
    "steady_surroundings": (
        "Keep the temperature steady, start when the set-up has warmed up, or record the"
        " temperature and correct by it"
    ),
    # any model but a stack
    "lag": "Drive slower, use a faster device there, or keep the lag in the model",
    "delay": "Shift the time of that signal, sample by one clock, or keep the delay in the model",
    "bend": "Calibrate that signal and correct it by the curve, or keep the curve in the model",
    "saturation": "Stay below the level, or use a device there that reaches further",
    "dead_zone": "Jump over the zone when the sign changes, or make up the play or the threshold",
    "gain": "Calibrate that signal, check its unit, or keep the gain in the model",
    "backlash": "Preload what plays, approach from one side, or keep the backlash in the model",
    "zero": "Take the zero before every run",
    "drift": "Let the sensor warm up, and take its zero before and after every run",
    "constant": "Look for a weight, a leak or the offset of an input, and put it into the equation",
    "loss": "Put the further loss into the equation, or look for what rubs, leaks or cools",
    "friction": "Lubricate or preload what rubs, overcome it by the input, or keep it in the model",
    "drag": "Put the quadratic loss into the equation",
    "curve": "Put the law into the equation in the place of a constant stiffness or conductance",
    "change": "Put the dependence into the equation in the place of a constant",
    "stop": "Stay clear of the stop, or keep it in the model",
    "hysteresis": "Approach from the same side, correct by the extended model, or close a loop",
}

#: The record that shows an effect, by the test that measures it.
RECORDS: Mapping[str, str] = {
    "hold": "a step to the highest voltage, held for ten minutes",
    "reversal": "slow loops of three amplitudes, nested",
    "range": "slow loops over the whole range, again with another load or sensor",
    "slew": "the same loop at three rates, the fastest in use among them",
    "resonance": "a sweep or a multisine that passes the resonance, well sampled",
    "record": "a long record with rests, and with the temperature beside it",
}


#: Returns the scale of a length [m].
Length = Callable[[float], Scale]


def size_text(sizes: Sequence[Size], length: Length) -> str:
    """Return what the tests of one effect give, as a sentence without its full stop."""
    if not sizes:
        return ""
    first, scale = sizes[0], length(max(abs(s.value) for s in sizes))  # one unit in a sentence
    low, high = first.voltages or (0.0, 0.0)
    voltages = f"{low:.3g} to {high:.3g} V"
    each = [_amount(s, scale) for s in sizes]
    if first.test == "hold":
        way = "falls back" if first.value < 0 else "goes on"
        times = [f"{s.at:g} s" if s.at < 60.0 else f"{s.at / 60.0:g} min" for s in sizes]
        by = listing([f"{text} in {time}" for text, time in zip(each, times, strict=True)])
        text = f"after a step to {high:.3g} V the displacement {way} by {by}"
        if beyond := [time for s, time in zip(sizes, times, strict=True) if s.beyond_records]:
            verb = "lies" if len(beyond) == 1 else "lie"
            text += f"; {listing(beyond)} {verb} beyond these records"
    elif first.test == "reversal":
        text = f"in loops of {voltages} it sets the ways up and down apart by up to {each[0]}"
    elif first.test == "range":
        way = "adds" if sizes[1].value > 0 else "takes"
        text = (
            f"over {voltages} it {way} {each[1]} at the top, and bends the curve by"
            f" up to {each[0]} beside zero and sensitivity"
        )
    elif first.test == "slew":
        rate = prefixed_scale(first.at, "V").text(first.at)
        text = f"at the fastest slew, {rate}/s, it amounts to {each[0]}"
    elif first.test == "resonance":
        where = listing([number(s.at) for s in sizes])
        text = f"at {where} Hz it makes the displacement {listing(each)} times as large"
    else:
        amounts = {(s.test, s.output): amount for s, amount in zip(sizes, each, strict=True)}
        still = {s.output for s in sizes if s.value == 0.0} if len(sizes) > 1 else set()
        moves = [
            f"the {plain(o)} by up to {a}"
            for (test, o), a in amounts.items()
            if test == "record" and o not in still
        ]
        rms = "".join(f", {a} rms" for (test, _), a in amounts.items() if test == "rms")
        text = f"within a record of {number(first.at)} s it moves {listing(moves)}{rms}"
    return text


def _amount(size: Size, length: Scale) -> str:
    """Return a figure with its interval, without its sign."""
    value = abs(size.value)
    in_metres = size.unit == "m" and size.output == "displacement"
    scale = length if in_metres or size.unit == "counts" else prefixed_scale(value, size.unit)
    if size.interval is None:
        return scale.text(value)
    ends = sorted(scale.factor * abs(v) for v in size.interval)
    return f"{scale.text(value)} ({interval_text(*ends)})"


#: The files of a base and an extended model where none was named, as the documentation calls them.
_FILES = ("model.json", "extended.json")
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
        return Advice((
            "See that both columns are of one run and of one axis, that the amplifier was on, and"
            " that units and sign are right.",
        ))  # fmt: skip
    stack = d if isinstance(d, StackDiagnosis) else None
    errors, noise = _sizes(d)
    commands, remarks = _commands(d, model_file)
    if d.verdict == "adequate" and d.doubt:
        text = "Use the model within these records only: their held-out samples cannot confirm it."
        return Advice((text,), remarks, commands[:1])
    if d.verdict == "adequate":
        text = (
            f"Use the model: it errs by {errors} on held-out samples, at a noise of"
            f" {noise}. Other {'voltages' if stack else 'inputs'}, rates and durations than these"
            " are untested."
        )
        return Advice((text,), remarks, commands)
    if not d.causes:
        text = (
            f"Do not correct the device by a name: none is certain. Take {errors} as the model's"
            f" error, and {'measure the next record' if stack else _further(d)}."
        )
        if d.patch is not None and d.budget.unnamed is not None:
            patched = (
                "To predict without a name, --patch patched.json writes the model with the unnamed"
                f" correction, which removes {percent(within(d.budget.unnamed.share))} of the error"
                " above the noise."
            )
            remarks = (patched, *remarks)
        return Advice((text,), remarks, commands)
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


def _further(d: Diagnosis) -> str:
    """Return what to do where no effect of any model explains what is missing."""
    if d.correction is None:
        return "record more of what may matter: another input, level or output"
    law = d.correction.equation or f"the law of {d.correction.of} in {d.correction.port}"
    return f"write {law} into the equations, with its parameters free, and diagnose again"


def _commands(d: Diagnosis, model_file: str | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the commands that take the model further, and remarks on its file."""
    stack = d if isinstance(d, StackDiagnosis) else None
    if not (stack or model_file or added(d)):
        return (), ()  # its equations are already there
    file = model_file or _FILES[added(d)]
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
        remarks.append(
            f"The commands read {file}: write it with -o {file}, in Python with"
            f' psa.save_model(result.model, "{file}").'
        )
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
            text = listing([RECORDS[t] for t in tests])
            lines.append(
                f"The record does not decide; in the place of {plain(cause.effect)} it may be"
                f" {'; or '.join(each)}. What decides: {text}."
            )
        elif cause.cannot_be_told_from:
            lines.append("The records do not decide: record another level, rate or output as well.")
    return list(dict.fromkeys(lines))


def effect_size(effect: Component, model: Model, sizes: Sequence[Size]) -> str:
    """Return how large an effect of a model is, with the size of its gain."""
    name = effect.gain or ""
    unit, (value,) = in_display_unit(model, name, model.values[name])
    gain = with_unit(number(value, 2), unit)
    size = size_text(sizes, handy_scale) or "it changes too little to be seen in its test"
    stack = next((n for n in STACKS if re.sub(r"\W", "_", n) == model.name), "this model")
    return f"on {stack} with {name} = {gain}: {size}"


def effect_advice(effect: Component) -> tuple[str, str]:
    """Return what to do about an effect, and which record shows it."""
    return DO[effect.what_now.code], RECORDS[effect.what_now.test]
