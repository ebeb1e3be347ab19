"""The sentences of notes by code, with the note's values in their places."""

import math
from collections.abc import Callable, Mapping, Sequence
from string import Formatter
from typing import Any

from psa_casadi.common.errors import quoted
from psa_casadi.common.notes import Note
from psa_casadi.identification.result import Identification
from psa_casadi.report.words.advice_words import IDENTIFICATION
from psa_casadi.report.words.misfit_words import ENDINGS, MISFIT, NOISE
from psa_casadi.report.words.phrases import (
    are,
    listing,
    plain,
    prefixed_scale,
    quantity,
    raised,
    with_its_unit,
    with_unit,
)

Probable = Sequence[tuple[str, float]]

#: What the places are called that effects belong to.
PLACES = {
    "drive": "the amplifier",
    "sensor": "the sensor",
    "plant": "the stack with its load",
    "environment": "the surroundings",
}
#: Unnamed corrections by kind, and where that leaves it open by port.
CORRECTIONS: Mapping[str, str] = {
    "curve at drive voltage": "a bent curve of the drive voltage",
    "curve at reading": "a bent curve of the displacement",
    "curve at force": "a bent curve of the force",
    "direction": "a difference between the branches",
    "memory": "a memory of past reversals",
    "relaxation": "a lag or creep over decades of time",
    "modes": "further resonances",
    "time": "a change with time that does not follow the voltage",
    "gain in time": "a sensitivity that changes with time",
}
_SEEN = {
    "correlation": "neighbouring samples are correlated",
    "line": "its spectrum has a line",
    "drive": "it depends on voltage, rate or time",
    "size": "the size depends on voltage, rate or time",
    "effect": "something follows what an effect would add",
}
_LACKING = {
    "hold": "a hold of several seconds, which separates creep and drift",
    "rates": "the same loop at three rates, which separate delay, lag and creep",
    "amplitudes": "the loop at three amplitudes, which separate asymmetry and memory",
    "repeats": "a voltage that repeats, which shows the noise",
}


def _known_from(places: int) -> str:
    if not places:
        return "predicted from the voltage"
    often = "once" if places == 1 else f"{places} times"
    return f"as it was where this voltage was played before, {often}"


def _not_shown(value: float) -> str:
    if value > 0.995:
        return ""
    return (
        f" The voltage of {100.0 * (1.0 - value):.0f} % of the samples is not in the reference:"
        " they are left out."
    )


def correction(kind: str, port: str) -> str:
    """Return what an unnamed correction is."""
    return CORRECTIONS.get(kind) or CORRECTIONS.get(f"{kind} at {port}", kind)


def _withdrawn(
    names: Sequence[str], evidence: float, share: float, output: str, kept: bool, why: Note
) -> str:
    remove = "would remove"
    if kept:
        they = "it removes" if len(names) == 1 else "they remove"
        remove = f"in the extended model, where {they}"
    joint = ": " if why.code == "better_unnamed" else ", because "
    return (
        f"{', '.join(names)}: found with a ln of the Bayes factor over the base of {evidence:.0f},"
        f" {remove} {100 * share:.0f} % of the held-out error{f' of {output}' * bool(output)} above"
        f" the noise; not named{joint}{why}."
    )


def _before(then: Probable) -> str:
    return ", ".join(f"{name} {100 * p:.0f} %" for name, p in then)


def _steps(quantum: tuple[float, str], rounding: tuple[float, str]) -> str:
    return (
        f" The sensor counts in steps of {quantity(*quantum)}, which alone give"
        f" {quantity(*rounding)} rms."
    )


#: What marks samples that a sensor has made, by kind.
_SUSPECT = {
    "outlier": "stand out as spikes of at most three samples that return at once",
    "drop-out": "belong to drop-outs, where the sensor jumps to one value and back",
    "stuck": "repeat the last one to the last digit, as a stuck sensor does",
}


#: Steps of the search for causes, as what was not tried.
_LEFT = {
    "neighbours": "further sets of causes",
    "other effects": "effects behind the two leading ones",
    "finalists": "the nearest rivals to their end",
    "fits afresh": "fits from an ordinary base",
    "other parents": "sets of causes from each of their causes",
    "base again": "the base once more without each cause",
    "resonances": "resonances that the base has missed",
    "several modes": "several modes at once",
    "several at once": "several causes at once",
    "exchange": "other effects in a cause's place",
    "all afresh": "the effects far behind",
    "rejected": "causes beside what held-out data reject",
}


def _reading(value: tuple[float, str], digits: int) -> str:
    size, unit = value
    scale = prefixed_scale(abs(size), unit or "1")
    return with_unit(f"{scale.factor * size:.{digits}g}", scale.unit)


DIAGNOSIS: Mapping[str, str | Callable[..., str]] = {
    # what remains
    "noise_only": "What remains cannot be distinguished from noise.",
    "structure": lambda seen, output, excess: (
        f"{f'Of {output}: in' if output else 'In'} the residual {_SEEN[seen]}."
        f" {100.0 * excess:.0f} % of its power is above the noise."
    ),
    "held_out_error": (
        "The held-out samples' error is {factor:.2f} times what the fitted ones let expect:"
        " something matters there that these do not show."
    ),
    # what was done to the records
    "masked": lambda where, count, kind: (
        f"{where}: {count} sample{'s' * (count > 1)} {_SUSPECT[kind]}; masked, so that they count"
        " for nothing."
    ),
    "flat_end": lambda where, count, share, value, upper, drive, moved: (
        f"{where}: {count} samples ({100.0 * share:.0f} %) stay at {_reading(value, 6)},"
        f" the {'largest' if upper else 'smallest'} value, while {drive} moves {moved}: the sensor"
        " is saturated there; masked, so that they count for nothing."
    ),
    "quantised": lambda where, output, step: (
        f"{where}: {output} is quantised in steps of {_reading(step, 3)}."
    ),
    "budget": lambda work, left: (
        f"The search for causes ended at its budget of work ({work:.2g} steps of simulations): the"
        f" answer is the best so far. Not tried: {', '.join(_LEFT[name] for name in left)}."
    ),
    "stuck": (
        "{count} readings repeat the last one far from the model, as a stuck sensor does; masked."
    ),
    "smooth_voltage": (
        "Between its samples the voltage follows a smooth curve, not straight lines, of whose"
        " difference the base model's error held {share:.2f} ({low:.2f} to {high:.2f}): the model"
        " is driven by the curve, and a simulation of such a record needs more samples for each"
        " period."
    ),
    "even_clock": lambda rms, share, low, high: (
        f"The time stamps jitter by {quantity(rms, 's')} rms, the samples do not: of what even"
        f" times change, the base model's error held {share:.2f} ({low:.2f} to {high:.2f}). Even"
        " times are used; record the sampling rate instead of stamps."
    ),
    "since": lambda removed, places, open, shown: (
        f"What the base model leaves of the reference is taken off the displacement,"
        f" {quantity(*removed)} rms, {_known_from(places)}.{_not_shown(shown)} A sound device may"
        f" differ by {quantity(*open)} rms: less is no change."
    ),
    "since_moved": lambda name, values, unit, alone: (
        f"{name} of the base model has changed from {with_its_unit(values[0], unit)} to"
        f" {with_its_unit(values[1], unit)} since the reference: that alone explains"
        f" {'more than any effect of the table' if alone else 'as much as the named causes'}."
    ),
    "noise": lambda record, level, how, samples, quantum, rounding: (
        f"The noise of {record} is {quantity(*level)} rms, {how} ({samples} samples)."
        f"{_steps(quantum, rounding) if quantum is not None else ''}"
    ),
    "noise_fast": "from the fast part of what the model leaves",
    "noise_repeats": "from what differs when the same voltage returns after {apart}",
    "noise_holds": lambda count: (
        f"from {'a held voltage' if count == 1 else f'{count} held voltages'} after smooth creep is"
        " taken off"
    ),
    # does the displacement follow the voltage?
    "flipped": (
        "With the sign of the displacement flipped the base model explains {flipped:.2p} % of its"
        " variance, as given {share:.2p} %: the sensor or the voltage is probably connected the"
        " other way round."
    ),
    "filtered": (
        "A linear filter of the voltage explains {linear:.0p} % of the displacement's variance, the"
        " base model {share:.0p} %: the two belong together, but with dynamics that the base model"
        " does not have (several resonances, a delay, perhaps the other sign). No causes were"
        " sought."
    ),
    "not_driven": (
        "The voltage explains {share:.0p} % of the displacement's variance, and no more with the"
        " other sign: check that both columns are of the same device and the same time."
    ),
    # why held-out samples do not confirm a cause
    "few_held_out": (
        "only {count} of the readings that count are held out, and no model can be judged by fewer"
        " than {least}"
    ),
    "saturated": (
        "the sensor is saturated in {share:.0p} % of the readings, so that more of the motion is"
        " hidden than shown"
    ),
    "gain_unknown": (
        "the 95 % interval of the held-out gain, {low:.0f} to {high:.0f} %, reaches from an error"
        " that doubles to noise alone, and most held-out samples lose by it"
    ),
    "no_such_voltage": (
        "no stack bears such a voltage, and what depends on its level cannot be determined"
    ),
    "other_quantity": "much would remain, and the displacement may be another quantity",
    "held_out_says_little": lambda why: f"{raised(str(why))}: the held-out error says little.",
    "extrapolates": (
        "{share:.0p} % of the held-out samples are of a kind that no fitted sample shows"
        " ({kinds: and }): there the held-out error extrapolates."
    ),
    "not_held_out": (
        "{share:.0p} % of the fitted samples are of a kind that is not held out ({kinds: and }):"
        " the held-out error says nothing of it."
    ),
    "voltages_beyond": (
        "Held-out voltages go from {least:.4g} to {most:.4g} V, fitted ones from {low:.4g} to"
        " {high:.4g} V: beyond these the held-out error extrapolates."
    ),
    # causes that are not named
    "small": (
        "{effect} is in the extended model and removes {share:.0p} % of the held-out error above"
        " the noise. It is not named: structure remains, and so little may only correct the form of"
        " what is named."
    ),
    "withdrawn": _withdrawn,
    "vague": "{names}: in the extended model and not named: {why}.",
    "better_unnamed": lambda each: (
        "beside the model without it, an unnamed correction explains more ("
        + "; ".join(f"{what}, instead of {name}" for what, name in each)
        + ")"
    ),
    "little": lambda least, more: (
        f"that is less than {100.0 * least:.0f} %" + " and much remains" * more
    ),
    "correction": correction,
    "free": lambda of, port, equation="": (
        f"a free function of {of} in {port}" + (f", {equation}" if equation else "")
    ),
    "would_remove": lambda what, share: (
        f"{raised(str(what))} would remove {100 * share:.0f}% of what is left above the noise."
    ),
    "blind_spot": (
        "These records show {effect} only from {smallest:.3g} on ({gain}), while {ordinary:.3g} is"
        " an ordinary size."
    ),
    "blind": (
        "These records show {effect} at no size ({gain}), while {ordinary:.3g} is an ordinary size."
    ),
    # what a further column decided
    "column_agrees": ("{column} agrees with the model: with it as without it nothing is named."),
    "column_decides_nothing": ("{column} decides nothing: with it as without it nothing is named."),
    "column_adds": (
        "{column} changes no name; it adds {gained:.0f} to the ln of the Bayes factor."
    ),
    "column_holds": lambda column, effect, before: (
        f"{column} explains by itself what without it is named ({_before(before)}): {effect} is in"
        " the column."
    ),
    "column_names": lambda column, new, then: (
        f"Only with {column} is there {' or '.join(new)}; without it"
        f" {' or '.join(then) or 'nothing is named'}."
    ),
    "column_clears": lambda column, before: (
        f"With {column} nothing is named; without it {_before(before)}."
    ),
    "column_rules_out": lambda column, places, effects, now, before: (
        f"With {column} {are([PLACES[p] for p in places] or effects, ' and ')} ruled out: what is"
        f" left is {' or '.join(now)} (without it: {_before(before)})."
    ),
    # what to do next
    "record_again": (
        "Correct the record, or record again, so that what the verdict says of it no longer holds."
    ),
    "correct_columns": "Correct the record as the notes say, and diagnose it again.",
    "no_next": "None is needed for this verdict.",
    "lacking": lambda what: (
        f"Record what these records lack: {listing([_LACKING[w] for w in what], '; and', ';')}."
    ),
    "other_conditions": (
        "These records hold what usually separates causes: a hold, several rates and amplitudes,"
        " repeats. Record the same voltage with another load, mean voltage or sensor, or a further"
        " column (current, charge, a second displacement)."
    ),
    "same_curve": (
        "{effects: and } bend the same curve: no voltage below the resonances separates"
        " them. Measure the displacement with a second sensor (column displacement_2) or the"
        " load's force (load_force), elsewhere in the range of this sensor, or without the load;"
        " or sample fast enough to excite and see the resonances."
    ),
}


def _identification(identification: Identification) -> str:
    """Return the parameters with their standard errors, and what is left of the outputs."""
    model = identification.model
    rows = [
        with_unit(f"  {n} = {model.values[n]:.6g} +- {e:.2g}", model.parameter(n).unit)
        for n, e in identification.errors.items()
    ]
    left = [
        f"  {n}: {v:.3g} rms left, noise {identification.noise[n]:.3g}"
        for n, v in identification.rms.items()
    ]
    warnings = [f"  {w}" for w in identification.warnings]
    return "\n".join([f"identified '{model.name}':", *rows, *left, *warnings])


def _estimate(value: float, low: float, high: float) -> str:
    """Return a value with its interval, in as many digits as distinguish them, four at least."""
    half = max(high - value, value - low)
    digits = 4
    if 0.0 < half < abs(value):
        digits = max(4, min(9, 1 + math.ceil(math.log10(abs(value) / half))))
    return f"{value:.{digits}g} ({low:.{digits}g} to {high:.{digits}g})"


OWN_MODELS: Mapping[str, str | Callable[..., str]] = {
    "own_identification": _identification,
    "moved": lambda name, estimate, without, unit, causes: (
        f"{name} = {with_unit(_estimate(*estimate), unit)}, without the cause{'s' * (causes > 1)}"
        f" {without:.4g}"
    ),
    # the records
    "stairs": (
        "The input '{input}' stands still between jumps in {records}, and each jump is read as a"
        " ramp of one sampling interval; if it is held between samples, as by a digital controller,"
        ' say so: --hold zero, in Python psa.Signals(..., hold="zero").'
    ),
    "no_column": lambda output, near=(): (
        f"No record has a column '{output}'; that output is not compared."
        + f" The records have {quoted(near)}; name the column '{output}' if it is that."
        * bool(near)
    ),
    "no_unit": lambda record, names: (
        f"{record} states no unit of {listing(names)}; the model's are taken."
    ),
    "hold_found": lambda hold, nats: (
        f"The inputs are {'held' if hold == 'zero' else 'straight lines'} between samples, which"
        f" explains the records better (ln of the likelihood higher by {nats:.0f}). This is an"
        f" estimate; if you know better, give --hold {'linear' if hold == 'zero' else 'zero'}."
    ),
    "inputs_smoothed": lambda inputs, nats: (
        f"The readings of {listing(inputs)} are noisy, and the noise is not what drove the device:"
        " the records are explained better by the readings smoothed (ln of the likelihood higher"
        f" by {nats:.0f}), which the fit uses. Smooth them in your own simulation as well."
    ),
    # the fit
    "starts_in_binary": lambda names: (
        f"The binary of the FMU starts {', '.join(names)} at its own values: an importer must set"
        " the start values of the description (fmpy: apply_default_start_values=True)."
    ),
    "in_parts": lambda parts, lasts: (
        f"The records are fitted in {parts} parts of {quantity(*lasts)}, each with a state of its"
        " own to begin with. What the model misses at the beginning of a whole record grows or"
        " stays, so that one simulation of it cannot be followed."
    ),
    "own_interrupted": "The search was interrupted; these are the best values so far.",
    "cut_off": "The fit was cut off before it converged; its values are not final.",
    "one_start": (
        "Of {starts} starts only one led to this minimum; it is the best found, and may not be the"
        " best there is."
    ),
    "own_undetermined": "'{name}' is not determined by these records.",
    "on_bound": "'{name}' sits on a bound of its range; its interval means nothing.",
    "output_missed": (
        "'{output}' is missed by {ratio:.2g} times its noise: the model lacks something, or a"
        " load acts at random, so that"
        " the values bend to it, and their errors are too small; psa diagnose looks for the cause."
    ),
    "output_not_followed": (
        "'{output}' is left with {share:.0p} % of its own movement: see that its column, and those"
        " of the inputs, are in the model's units."
    ),
    # the verdict
    "held_out_unlike": (
        "The fitted samples leave no more than noise, but the held-out ones of {output}"
        " {ratio:.1f} times their noise: these records do not say the same, or their inputs are not"
        " read alike (see `hold`)."
    ),
    "cancel": lambda effect, output, alone, together: (
        f"That each cause is physics is doubtful, as they cancel each other: {plain(effect)} alone"
        f" changes {output} by up to {with_its_unit(*alone)}, all together by"
        f" {with_its_unit(*together)}."
    ),
    "slight": (
        "{names: and } together fit better (ln of the Bayes factor higher by {more:.0f}). Not"
        " named, because {small: and } would remove less than {least:.0%} of what the rest does,"
        " and so little may only correct its form."
    ),
}


#: A code's sentence: a template with the values' names, or what makes it of the values.
Sentence = str | Callable[..., str]
SENTENCES: Mapping[str, Sentence] = {**DIAGNOSIS, **IDENTIFICATION, **MISFIT, **NOISE, **OWN_MODELS}


class _Words(Formatter):
    """Formats quantities `(value, unit)` with their units, and names in a row.

    What follows the colon is a number's format, ".0p" that of a percentage without its sign, or
    the separator of names, ", " by default.
    """

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, tuple):
            if len(value) == 2 and isinstance(value[0], float) and isinstance(value[1], str):
                if format_spec:
                    return with_unit(format(value[0], format_spec), value[1])
                return quantity(*value)
            return (format_spec or ", ").join(map(str, value))
        if format_spec.endswith("p"):
            return format(100.0 * value, f"{format_spec[:-1]}f")
        return format(str(value) if isinstance(value, Note) else value, format_spec)


_WORDS = _Words()


def note_text(note: Note) -> str:
    """Return the sentence of a note; within a page its lengths are in the page's unit."""
    return _head(note) + (ENDINGS[note.code](note.values["share"]) if note.code in ENDINGS else "")


def brief_text(note: Note) -> str:
    """Return the sentence of a finding in a residual, with the share it explains in brackets."""
    if note.code not in ENDINGS:
        return note_text(note)
    return f"{_head(note)} ({100.0 * note.values['share']:.0f} % of the excess)."


def _head(note: Note) -> str:
    sentence = SENTENCES[note.code]
    if isinstance(sentence, str):
        return _WORDS.vformat(sentence, (), note.values)
    return sentence(**note.values)
