"""Marks of the exam: grades of an answer of the diagnosis.

A record has one set of accepted names for each hidden cause. A name is a hit if it is in such a
set, `modal_series` of any order also where `structural_mode` is.

* Clean: `adequate` is right, and so is an accepted name (a hum as small as the noise), of a stack
  that is not Bouc-Wen's also one of HYSTERESIS, whose form differs from the base model's. A further
  name with it, or another alone, is wrong. No name is an alarm, of other hysteresis an honest
  one.
* One cause or several: right alone if all are hit and no name has a rival; right in a set if one
  has, or if a hit is itself the rival of a name; half if not all are hit. Names of HYSTERESIS count
  neither way on a stack that is not Bouc-Wen's; any other name is a wrong extra. `adequate` and no
  name at all are separate marks.
* Foreign: no name is right, and so is what comes nearest. `adequate` is a miss.

A set may hold families too, "place kind" as in "plant relaxation": what `score` counts besides
marks. A family is right if it is in a set, or that of a name in it, or if the name is right.

Where a wrong name has 90 % or more and nothing is right, the mark states so; of a clean record also
where it comes with a right one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

Group = Literal["clean", "one", "two", "three", "foreign"]
#: What the package has for hysteresis of another form than its base model's.
HYSTERESIS = frozenset(
    {
        "hysteresis_memory",
        "rate_independent_asymmetry",
        "field_dependent_gain",
        "saturation_of_strain",
    }
)
#: A wrong name counts as confident from this probability on.
SURE = 0.9
ALARM, HONEST = "alarm on clean", "unexplained (honest)"
ADEQUATE, HYSTERESIS_FOUND = "right (adequate)", "right (hysteresis)"
ALONE, IN_SET, WITH_EXTRA = "right alone", "right in a set", "right + wrong extra"
HALF, HALF_WITH_EXTRA = "half (one of two)", "half + wrong extra"
NOT_DETECTED, UNEXPLAINED, ONLY_HYSTERESIS = "adequate (missed)", "unexplained", "hysteresis only"
NEAREST, RIGHTLY_UNEXPLAINED = "right (nearest effect)", "right (unexplained)"
WRONG, SURELY = "wrong name", ", 90 % or more"


@dataclass(frozen=True)
class Question:
    """The right answers for a record.

    Its group; the accepted names of each hidden cause, of a foreign or clean record what comes
    nearest; whether its hysteresis is not Bouc-Wen's; its noise where that is not white.
    """

    group: Group
    accepted: tuple[frozenset[str], ...] = ()
    other_hysteresis: bool = False
    noise: str = ""


@dataclass(frozen=True)
class Named:
    """A named cause, its probability, its rivals, and its likeliest family.

    Rivals are the effects that cannot be distinguished from it.
    """

    effect: str
    probability: float
    rivals: tuple[str, ...] = ()
    family: str = ""
    of_family: float = 0.0


@dataclass(frozen=True)
class Answer:
    """The verdict, the causes that are named, and the likeliest family of what is left."""

    verdict: str
    causes: tuple[Named, ...] = ()
    left: str = ""
    of_left: float = 0.0


def mark(question: Question, answer: Answer) -> str:
    """Return the mark of an answer."""
    match question.group:
        case "clean":
            return _clean(question, answer)
        case "foreign":
            return _foreign(question, answer)
        case _:
            return _hidden(question, answer)


def _clean(question: Question, answer: Answer) -> str:
    if answer.verdict == "adequate":
        return ADEQUATE
    other = question.other_hysteresis
    if not answer.causes:
        return HONEST if other else ALARM
    hits = [c for c in answer.causes if _hit_of(c, question.accepted) is not None]
    wrong = [c for c in answer.causes if not (c in hits or (other and c.effect in HYSTERESIS))]
    if not wrong:
        return NEAREST if hits else HYSTERESIS_FOUND
    right = len(wrong) < len(answer.causes)
    return (WITH_EXTRA if right else WRONG) + _surely(wrong)


def _foreign(question: Question, answer: Answer) -> str:
    if answer.verdict == "adequate":
        return NOT_DETECTED
    if not answer.causes:
        return RIGHTLY_UNEXPLAINED
    nearest = frozenset[str]().union(*question.accepted)
    wrong = [c for c in answer.causes if not _hits(c.effect, nearest)]
    return WRONG + _surely(wrong) if wrong else NEAREST


def _hidden(question: Question, answer: Answer) -> str:
    if answer.verdict == "adequate":
        return NOT_DETECTED
    if not answer.causes:
        return UNEXPLAINED
    numbers: set[int] = set()
    extra = []
    for cause in answer.causes:
        hit = _hit_of(cause, question.accepted)
        if hit is not None:
            numbers.add(hit)
        elif not (question.other_hysteresis and cause.effect in HYSTERESIS):
            extra.append(cause)
    if len(numbers) == len(question.accepted):
        if extra:
            return WITH_EXTRA
        return IN_SET if any(c.rivals for c in answer.causes) else ALONE
    if numbers:
        return HALF_WITH_EXTRA if extra else HALF
    return WRONG + _surely(extra) if extra else ONLY_HYSTERESIS


def _hit_of(cause: Named, accepted: Sequence[frozenset[str]]) -> int | None:
    """Return which hidden cause a named one hits, by itself or by a rival."""
    for name in (cause.effect, *cause.rivals):
        for place, names in enumerate(accepted):
            if _hits(name, names):
                return place
    return None


def _hits(name: str, accepted: frozenset[str]) -> bool:
    return name in accepted or (name.startswith("modal_series") and "structural_mode" in accepted)


def _surely(wrong: Sequence[Named]) -> str:
    return SURELY if any(c.probability >= SURE for c in wrong) else ""


@dataclass(frozen=True)
class Score:
    """What an answer adds to the figures of many.

    Whether all hidden causes are hit and no name is wrong: in a set, alone, or by their families,
    of which one may be that of what is left without a name; whether a foreign cause is answered
    honestly (no name, or the right one or family), and a clean record with an alarm.
    `names` and `families` are what is stated: a probability and whether it is right, of every name
    that counts, or of what is left where there is no name.
    """

    in_set: bool
    alone: bool
    family: bool
    honest: bool
    alarm: bool
    names: tuple[tuple[float, bool], ...]
    families: tuple[tuple[float, bool], ...]


def score(question: Question, answer: Answer, families: Mapping[str, str]) -> Score:
    """Return what an answer adds to the figures; `families` has that of each name."""
    grade, sets = mark(question, answer), question.accepted
    wide = [names | {families[n] for n in names if n in families} for names in sets]

    def of_family(family: str) -> int | None:
        return next((k for k, known in enumerate(wide) if family in known), None)

    neutral = HYSTERESIS if question.other_hysteresis else frozenset()
    if question.other_hysteresis:  # a name of its rest is right, but is none of the hidden causes
        wide.append(frozenset({"plant hysteresis"}))
    covered, counted = {of_family(answer.left)}, []
    for cause in answer.causes:
        hit = _hit_of(cause, sets)
        place = of_family(cause.family) if hit is None else hit
        covered.add(place)
        if hit is not None or cause.effect not in neutral:
            counted.append((cause, place))
    right = all(place is not None for _, place in counted)
    stated = [(c.of_family, c.family) for c, _ in counted] or [(answer.of_left, answer.left)]
    return Score(
        in_set=grade in (ALONE, IN_SET),
        alone=grade == ALONE,
        family=right and bool(sets) and covered >= set(range(len(sets))),
        honest=grade != NOT_DETECTED and right,
        alarm=grade not in (ADEQUATE, HYSTERESIS_FOUND, HONEST, NEAREST),
        names=tuple((c.probability, any(_hits(c.effect, s) for s in sets)) for c, _ in counted),
        families=tuple((p, of_family(family) is not None) for p, family in stated if family),
    )
