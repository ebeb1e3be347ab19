"""Notes, combinations, advice, profiles and errors of fits in sentences.

Results carry codes and figures; `notes.toml` and `sentences.toml` have the text of each code.
"""

from functools import singledispatch
from typing import Any

import numpy as np

from psa_casadi.common.notes import Note
from psa_casadi.common.units import convert
from psa_casadi.identification.advice import Advice, Plan
from psa_casadi.identification.determinacy import Combination
from psa_casadi.identification.grades import STRONG_CORRELATION, Degree, Grade, named
from psa_casadi.identification.profile import PROFILE_LIMIT, Profile
from psa_casadi.report.words.catalogue import TABLES, say
from psa_casadi.report.words.phrases import Scale, listing, number, percent, raised
from psa_casadi.report.words.series import ResidualFigures

#: Shares of the lags beyond the 95 % band up to which a residual passes for white, with the
#: correlation of neighbours that is negligible.
_WHITE_SHARE, _WHITE_NEIGHBOURS = 0.12, 0.05
_SHAPE = 0.5


def note_text(note: Note) -> str:
    """Return the sentence of a note; within a page its lengths are in the page's unit."""
    ending = say(f"ending.{note.code}", **note.values) if note.code in TABLES["ending"] else ""
    return say(f"note.{note.code}", **note.values) + ending


def brief_text(note: Note) -> str:
    """Return the sentence of a finding in a residual, with the share it explains in brackets."""
    if note.code not in TABLES["ending"]:
        return note_text(note)
    head = say(f"note.{note.code}", **note.values)
    return f"{head} ({percent(note.values['share'])} of the excess)."


@singledispatch
def sentence_of(result: Any) -> str:
    """Return a combination or an advice as a sentence."""
    raise TypeError(f"{type(result).__name__} has no sentence")


@sentence_of.register
def _combination(c: Combination) -> str:
    relative = say("part.each_to", pairs=list(zip(c.parameters, c.alone, strict=False)))
    return say(f"combination.{c.kind}", c=c, names=listing(c.parameters), alone=relative)


@sentence_of.register
def _advice(a: Advice) -> str:
    names = listing(a.parameters)
    if a.plan is None:
        return say(f"advice.{a.kind}", a=a, names=names)
    others = "".join(f", or {plan_words(o, sampled=False)}," for o in a.instead)
    times = {1: "", 2: ", twice,"}.get(a.repeats, f", {a.repeats} times,")
    before = "together with what is advised above, " if a.kind == "together" else ""
    return raised(f"{before}{plan_words(a.plan)}{others}{times} would determine {names}.")


def plan_words(p: Plan, *, sampled: bool = True) -> str:
    """Return what to measure, with how it is to be `sampled` where that is fast."""
    return say(f"plan.{p.kind}", p=p, sampled=sampled)


def profile_sentences(p: Profile) -> tuple[str, ...]:
    """Return a profile in words: its interval with open ends, and what is odd about it."""

    def in_unit(value: float) -> str:
        number = f"{convert(value, p.unit, p.display_unit):.4g}"
        return number if p.unit == "1" else f"{number} {p.display_unit}"

    low, high = (None if end is None else in_unit(end) for end in (p.low, p.high))
    first, last = (in_unit(float(v)) for v in p.values[[0, -1]])
    ends = {"low": low, "high": high, "first": first, "last": last, "estimate": in_unit(p.estimate)}
    kinds = (("open", "below"), ("above", "between"))
    kind = kinds[low is not None][high is not None]
    interval = say(f"profile.{kind}", name=p.name, **ends)
    at_estimate = float(np.interp(p.estimate, p.values, p.increase))
    if kind == "open" or at_estimate <= 0.1 * PROFILE_LIMIT:
        return (interval,)
    best = in_unit(float(p.values[np.argmin(p.increase)]))
    values = {"best": best, "lower": at_estimate, "limit": PROFILE_LIMIT}
    return interval, say("profile.not_minimal", name=p.name, **values)


def error_sentence(rms: float, noise: float, span: float, scale: Scale, origin: str) -> str:
    """Say how far the model is from the records; rms, noise and largest range in [m]."""
    share, ratio = number(100.0 * rms / span, 2), rms / noise if noise > 0 else None
    return say("fit.error", origin=origin, rms=scale.text(rms), share=share, ratio=ratio)


def determined_sentence(graded: tuple[Grade, ...]) -> str:
    """Say how many parameters the records determine, and name those they do not."""
    fitted = sum(g.degree != "fixed" for g in graded)
    if not fitted:
        return say("fit.no_intervals")
    degrees: tuple[Degree, ...] = ("weak", "undetermined", "on its bound")
    open_ones = {degree: named(graded, degree) for degree in degrees}
    good = len(named(graded, "determined"))
    return say("fit.determined", good=good, fitted=fitted, open_ones=open_ones)


def error_bar_note(graded: tuple[Grade, ...]) -> str:
    """Say what the bars of determinacy are relative to, and where their limits lie."""
    return say("fit.error_bars", by_change=[g.name for g in graded if g.by_change])


def pairs_sentence(pairs: list[tuple[str, str, float]]) -> str:
    """Say which parameters are known only together."""
    return say("fit.pairs", pairs=pairs, limit=STRONG_CORRELATION)


def residual_sentence(f: ResidualFigures, model: str, time: Scale) -> str:
    """Say whether the residual of a model is white and normal, with the figures behind it."""
    words = []
    if abs(f.skewness) > _SHAPE:
        words.append("longer upwards" if f.skewness > 0 else "longer downwards")
    if abs(f.kurtosis) > _SHAPE:
        words.append("heavier in its tails" if f.kurtosis > 0 else "lighter in its tails")
    return f"{whiteness_sentence(f, model, time)} {say('fit.distribution', f=f, words=words)}"


def whiteness_sentence(f: ResidualFigures, model: str, time: Scale) -> str:
    """Say whether the residual of a model is white, with the figures behind it."""
    white = f.outside <= _WHITE_SHARE and abs(f.neighbours) <= _WHITE_NEIGHBOURS
    return say("fit.whiteness", f=f, model=model, white=white, lasting=time.text(f.lasting, 2))
