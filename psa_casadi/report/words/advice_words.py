"""What an identification leaves open, in words: notes, combinations, records to measure, profiles.

Results carry codes and figures; every sentence about them is made here.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import singledispatch
from math import floor, log10
from typing import Any

import numpy as np

from psa_casadi.common.errors import quoted
from psa_casadi.common.units import convert
from psa_casadi.identification.advice import Advice, Plan
from psa_casadi.identification.determinacy import Combination
from psa_casadi.identification.profile import PROFILE_LIMIT, Profile
from psa_casadi.report.words.phrases import listing


def _branches(missing: Sequence[str]) -> str:
    if missing:
        return f"the {' and the '.join(missing)} branches"
    return "two branches in succession"


def _window(
    name: str, coefficient: str, change: float, reasons: Sequence[tuple[str, float]]
) -> str:
    """Say that the linear part moves with its window, and what keeps integrals from converging."""
    words = {
        "truncated": "the window truncates the response, which still moves by {:.1g} of the step"
        " at its end",
        "noise": "white noise of {:.1g} of the step, which six integrations amplify",
        "ringing": "the response rings (it overshoots by {:.0f} %), and integrals of a ringing"
        " response converge only long after the ringing has ended",
        "short": "the window is too short for the higher integrals",
    }
    causes = "; ".join(words[code].format(size) for code, size in reasons)
    by = f"a factor of {change:.2g}" if change > 10.0 else f"{100.0 * change:.0f} %"
    return (
        f"The linear part is not to be trusted: without the last tenth of step '{name}',"
        f" {coefficient} changes by {by}, though it should not depend on where the"
        f" window ends. Likely cause: {causes}. Use --method prediction-error for these"
        " records."
    )


_TIP_FOR_STEP = (
    " k is taken from the slope of the largest loop near its tip, which is not the paper's."
)
_NO_STACK = "The denominator of eq. (15) is no stack's: "
_DELAY_ALONE = (
    ". tau = a_1 - b_1 alone is taken, masses and dampings keep ordinary values; use --method"
    " prediction-error, or a longer, quieter step."
)
_TWO_CLOCKS = (
    "{record}: voltage and displacement were sampled by two clocks: the delay between them {way}"
    " evenly by {height:.3g} ms and jumps back every {period:.3g} s, which moves the readings by"
    " {off:.2g} {unit} rms"
)
#: Sentences by the codes of notes; their figures are put in where the braces stand.
IDENTIFICATION: Mapping[str, str | Callable[..., str]] = {
    "interrupted": "The search was interrupted; this is the best fit so far, and its values are not"
    " final.",
    "not_unique": lambda names: (
        f"Two starts led to equally good fits that differ in {quoted(names)}: these records do"
        " not decide which is right."
    ),
    "undetermined": lambda names: (
        f"{quoted(names)} {'is' if len(names) == 1 else 'are'} not determined by these records."
    ),
    "missed": "Record '{record}' is missed by {times:.2g} times its noise: the model lacks"
    " something there; `psa diagnose` looks for the cause.",
    "form": "hysteresis: {better}, which leaves {left:.3g} nm rms; {other} would leave"
    " {other_left:.3g} nm.",
    "force_assumed": "Force scale assumed: voltage and displacement determine the displacement"
    " only. Forces, masses and stiffnesses are right in proportion, not in size; give a stiffness"
    " to fix them.",
    "averaged": "{record}: {samples} samples are averaged in blocks of {block}, which loses"
    " nothing of voltage or displacement beyond a tenth of the noise.",
    "still_column": "{column} is left out: it never changes.",
    "stray_current": "{column} is left out: it does not follow the voltage as a capacitance's does"
    " (another sign or unit, a limited current, uneven time steps).",
    "column": "{column}: fitted beside the displacement; {rms:.3g}{unit} rms of it are missed,"
    " {share:.2g} % of its own rms.",
    "turned_column": "{column} falls where the model's rises: its sign is probably turned.",
    "capacitance": "The measured {source} gives C_p = {value:.4g} uF ({low:.4g} to {high:.4g};"
    " times the amplifier's gain, if the voltage is its input): it explains {share:.1f} % of it.",
    "capacitance_kept": "The model keeps the {value:.4g} uF given.",
    "two_clocks": f"{_TWO_CLOCKS}.",
    "clocks_undone": f"{_TWO_CLOCKS}; that was undone. Better read both from one device.",
    "paper": lambda names: (
        "Identified by the paper's method (Yang and Zhu 2015, section 3), which gives no"
        f" intervals. It found {', '.join(names) or 'nothing'}; all other parameters have ordinary"
        " values."
    ),
    "no_step": lambda loops: (
        "No record is a step (a jump of the voltage that is then held), so the linear part cannot"
        " be found by this method: the lag, masses and dampings keep ordinary values."
        f"{_TIP_FOR_STEP if loops else ''} Give the response to a step as a record."
    ),
    "no_loop": "No record is a loop (a voltage that goes up and down at even intervals), so A,"
    " delta, n, beta and gamma cannot be found by this method: the model has no loop (f_H = 0)."
    " Give two periods of a slow sine or triangle from rest at 0 V.",
    "fast_loops": "The slowest loops have {frequency:.3g} Hz; the paper asks for less than 1 Hz,"
    " so that mechanics and lag do not widen the loop. Give slower loops.",
    "lagging_step": "The step lags by {delay:.3g} ms, {angle:.2g} rad of the loops at"
    " {frequency:.3g} Hz, which the method counts as hysteresis: A, delta, n, beta and gamma are"
    " off. Give slower loops.",
    "not_from_rest": lambda names: (
        f"{quoted(names)} do not begin at 0 V, though the method needs h = 0 at the start; their"
        " first sample is taken for rest. Give loops from rest at 0 V."
    ),
    "bridged": lambda names: (
        f"Missing samples were bridged by straight lines in {quoted(names)}; derivatives there are"
        " not measured."
    ),
    "out_of_range": "{name} = {value:.3g} {unit} is outside of its range, {low:g} to {high:g};"
    " {instead:.3g} stands in the model, and the rest does not belong to it.",
    "runs_away": "The model with these values cannot be simulated on the records (with A, beta and"
    " gamma like these the hysteresis grows without bound, or masses and dampings are out of"
    " proportion), so its loop, lags and masses were set back to ordinary values; use --method"
    " prediction-error.",
    "window": _window,
    "signs": lambda names: (
        f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not larger than zero, which the"
        " paper's eq. (15) demands: the moments did not find a stack's transfer function. A longer,"
        " quieter step may help."
    ),
    "no_a_5": f"{_NO_STACK}a_5 is zero or not finite{_DELAY_ALONE}",
    "growing_poles": f"{_NO_STACK}{{count}} of its 5 poles do not decay{_DELAY_ALONE}",
    "other_zero": "b_1 = {b_1:.3g} s, but the poles allow {nearest:.3g} s at the nearest with the"
    " assumed k_P/k_B = {ratio:.3g}: b_1 or this ratio is wrong, and the first microseconds of a"
    " step will be off.",
    "rough_velocity": "The noise of loop '{loop}' does not allow a good velocity: over the longest"
    " window it is {share:.1f} % of the mean speed. A, delta, n, beta and gamma rest on it; give"
    " slower or less noisy loops.",
    "no_samples": "No samples with h = x - k u above zero are left on the {branch} branches, so"
    " {what} has no equation, and the model has no loop (f_H = 0). Likely cause: k is wrong or the"
    " loops did not begin at rest at 0 V; give loops that do.",
    "negative_rising": "The logarithms of (31) are of negative numbers on the rising branches, so"
    " beta + gamma > 0 does not hold; the logarithms of the opposite numbers are taken.",
    "wrong_sign": "{lost:.0f} % of the logarithms on the {branch} branches ({what}) are of numbers"
    " of the wrong sign and were left out, which biases the rest. Likely cause: noise, or a k that"
    " is wrong; give slower loops or another step.",
    "no_crossing": lambda branches: (
        f"x = k u is not met on {_branches(branches)} of the loops, so A and delta cannot be read"
        " at zero crossings, and n, beta and gamma rest on them: the model has no loop (f_H = 0)."
        " Likely cause: k contains a part of the hysteresis (it is the secant of the step), or the"
        " loops did not begin at rest at 0 V; give two periods or more from rest."
    ),
    "scatter": "A scatters by {share:.0f} % between the loops' periods, which it should not: the"
    " loops are not those of eq. (8) with this k.",
    "secant": "At its tip the loop '{loop}' meets the line x = k u (h there is {share:.0f} % of"
    " its largest value): k, read from a step, holds what the hysteresis adds at that voltage, and"
    " the paper takes it for the linear part alone. k, A, delta and all that rest on them are off.",
    "lagging_loop": "The logarithm of (34) is of negative numbers: gamma > beta does not hold, as"
    " it cannot for a loop that lags. The logarithm of (beta - gamma) h^n was taken instead, which"
    " is the same equation.",
    "diverged": "{count} of {transitions} transitions diverged: a part of the posterior may be"
    " missing. Draw more with another seed, or hold what is open (--free).",
    "chains_disagree": lambda names, limit: (
        f"The chains disagree about {quoted(names)} (r-hat above {limit}); take more draws"
        " (--draws, --tune)."
    ),
    "few_draws": lambda names, limit: (
        f"Fewer than {limit:.0f} effective draws per chain of {quoted(names)}: ends of intervals"
        " are rough; take more draws (--draws)."
    ),
    "start_cut_off": "The fit that the chains start from was cut off before it converged.",
    "coloured": lambda record, worth, output: (
        f"Residuals of '{record}'{f', {output},' if output else ''} are correlated: {worth:.3g}"
        " samples count as one, and the model lacks something there; `psa diagnose` looks for the"
        " cause."
    ),
    "of_the_prior": lambda names: (
        f"The records hardly determine {quoted(names)}: the posterior is that of the prior."
    ),
    "prior_fails": "{count} of {draws} draws of the prior cannot be simulated; they are left out"
    " of the prior's groups.",
}


@singledispatch
def sentence_of(result: Any) -> str:
    """Return a combination or an advice as a sentence."""
    raise TypeError(f"{type(result).__name__} has no sentence")


@sentence_of.register
def _combination(c: Combination) -> str:
    names = listing(c.parameters)
    if c.kind in ("only", "traded"):
        meaning, error = f"{c.meaning}, {c.known},", _error(c.relative_error)
        if c.kind == "only":
            return f"Only {meaning} is determined, to {error}; {names} trade off in it."
        pairs = zip(c.parameters, c.alone, strict=True)
        alone = listing([f"{n} to {_error(share)}" for n, share in pairs])
        return f"{names} trade off: {meaning} is known to {error}, {alone}."
    if c.kind == "tied":
        return f"{c.parameters[0]} is free; it trades off with {listing(c.parameters[1:])}."
    if c.kind == "free":
        be, which = ("is", "it") if len(c.parameters) == 1 else ("are", "any of them")
        return f"{names} {be} free: these records hardly depend on {which}."
    return {
        "group": f"{names} trade off; no simple formula of them is known.",
        "product": "Only the product R_s C_p shows in a displacement; R_s is right for the C_p that"
        " the model assumes.",
        "force": f"The scale of force is free: {names} may all be multiplied by one factor; a"
        " stiffness or blocking force from outside fixes it.",
    }[c.kind]


def _error(share: float) -> str:
    return f"{100.0 * share:.2g} %" if share < 0.995 else "no better than its size"


@sentence_of.register
def _advice(a: Advice) -> str:
    if a.plan is None:
        them = "it" if len(a.parameters) == 1 else "them"
        names = listing(a.parameters) if a.parameters else ""
        return {
            "ringing": f"If the mechanics ring, {names} would be determined as well.",
            "nothing": f"None of the {a.tried} steps, multisines, loops and holds that were tried"
            f" on the model, with the noise of these records, is sure to determine {names}; take"
            f" {them} from elsewhere, or use what is known of the combinations.",
            "force": "A stiffness or blocking force, from the data sheet or measured, would fix the"
            " scale of force; no record of voltage and displacement can.",
        }[a.kind]
    words = plan_words(a.plan)
    words += "".join(f", or {plan_words(o, sampled=False)}," for o in a.instead)
    times = {1: "", 2: ", twice,"}.get(a.repeats, f", {a.repeats} times,")
    others = "together with what is advised above, " if a.kind == "together" else ""
    text = f"{others}{words}{times} would determine {listing(a.parameters)}."
    return text[0].upper() + text[1:]


def plan_words(p: Plan, *, sampled: bool = True) -> str:
    """Return what to measure, with how it is to be `sampled` where that is fast."""
    between = f"{quantity(p.low, 'V')} to {quantity(p.high, 'V')}"
    at, length = quantity(p.frequency, "Hz"), quantity(p.length, "s")
    how = f" (sampled at {quantity(p.rate, 'Hz')} or faster for {length})" if sampled else ""
    return {
        "step": f"a step from {between} and back{how}",
        "multisine": f"a multisine from {between} up to {at}{how}",
        "loop": f"two loops (a sine) from {between} at {at}",
        "minor loops": f"nested minor loops (a triangle of {p.cycles} cycles from {between} that"
        f" closes in on the middle) at {at}",
        "hold": f"a step from {between} held for {length}",
    }[p.kind]


def quantity(value: float, unit: str) -> str:
    """Return a value with three digits at most and a prefix, such as "200 kHz"."""
    if value == 0.0:
        return f"0 {unit}"
    prefixes = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
    power = int(np.clip(3 * floor(log10(abs(value) * 1.0005) / 3), -9, 6))
    if unit == "s" and value >= 1.0:
        power = 0
    return f"{value / 10.0**power:.3g} {prefixes[power]}{unit}"


def profile_sentences(p: Profile) -> tuple[str, ...]:
    """Return a profile in words: its interval with open ends, and what is odd about it."""
    low, high = (None if end is None else _shown(p, end) for end in (p.low, p.high))
    estimate = _shown(p, p.estimate)
    if low and high:
        text = f"{p.name} lies between {low} and {high}"
    elif low:
        text = f"{p.name} is above {low}; nothing bounds it from above"
    elif high:
        text = f"{p.name} is below {high}; nothing bounds it from below"
    else:
        first, last = (_shown(p, float(v)) for v in p.values[[0, -1]])
        text = f"{p.name} is not determined: values from {first} to {last} fit as well as"
        return (f"{text} {estimate} (profile likelihood, 95 %).",)
    sentences = [f"{text} (profile likelihood, 95 %); the estimate is {estimate}."]
    at_estimate = float(np.interp(p.estimate, p.values, p.increase))
    if at_estimate > 0.1 * PROFILE_LIMIT:
        best = _shown(p, float(p.values[np.argmin(p.increase)]))
        sentences.append(
            f"The fit had not reached its minimum: with {p.name} = {best} the cost is lower by"
            f" {at_estimate:.2g} (limit {PROFILE_LIMIT:.3g}); start a fit from there."
        )
    return tuple(sentences)


def _shown(p: Profile, value: float) -> str:
    number = f"{convert(value, p.unit, p.display_unit):.4g}"
    return number if p.unit == "1" else f"{number} {p.display_unit}"
