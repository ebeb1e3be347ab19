"""Marks of the exam: what an answer of the diagnosis is worth.

A record has one set of accepted names for each hidden cause. A name is a hit if it is in such a
set, `modal_series` of any order also where `structural_mode` is.

* Clean: `adequate` is right, of a stack that is not Bouc-Wen's also a name of HYSTERESIS, whose
  form differs from the base model's. A further name beside it, or another alone, is wrong. No name
  is an alarm, of other hysteresis an honest one.
* One or two causes: right alone if all are hit and no name has a rival; right in a set if one has,
  or if a hit is itself the rival of a name; half if one of two is hit. Names of HYSTERESIS count
  neither way on a stack that is not Bouc-Wen's; any other name is a wrong extra. `adequate` and no
  name at all are marks of their own.
* Foreign: no name is right, and so is what comes nearest. `adequate` is a miss.

Where a wrong name has 90 % or more and nothing is right, the mark says so; of a clean record also
where it is beside a right one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from tests.studies.exam.record import Record

#: What the package has for hysteresis of another form than its base model's.
HYSTERESIS = frozenset(
    {
        "hysteresis_memory",
        "rate_independent_asymmetry",
        "field_dependent_gain",
        "saturation_of_strain",
    }
)
#: A wrong name is sure from this probability on.
SURE = 0.9
ALARM, HONEST = "alarm on clean", "unexplained (honest)"
ADEQUATE, HYSTERESIS_FOUND = "right (adequate)", "right (hysteresis)"
ALONE, IN_SET, WITH_EXTRA = "right alone", "right in a set", "right + wrong extra"
HALF, HALF_WITH_EXTRA = "half (one of two)", "half + wrong extra"
MISSED, UNEXPLAINED, ONLY_HYSTERESIS = "adequate (missed)", "unexplained", "hysteresis only"
NEAREST, RIGHTLY_UNEXPLAINED = "right (nearest effect)", "right (unexplained)"
WRONG, SURELY = "wrong name", ", 90 % or more"


@dataclass(frozen=True)
class Named:
    """A named cause, its probability, and what it cannot be told from."""

    effect: str
    probability: float
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True)
class Answer:
    """The verdict of a diagnosis and the causes that it names."""

    verdict: str
    causes: tuple[Named, ...] = ()


def mark(record: Record, answer: Answer) -> str:
    """Return the mark of an answer."""
    match record.group:
        case "clean":
            return _clean(record, answer)
        case "foreign":
            return _foreign(record, answer)
        case _:
            return _hidden(record, answer)


def _clean(record: Record, answer: Answer) -> str:
    if answer.verdict == "adequate":
        return ADEQUATE
    other = _other_hysteresis(record)
    if not answer.causes:
        return HONEST if other else ALARM
    wrong = [c for c in answer.causes if c.effect not in HYSTERESIS]
    if other and not wrong:
        return HYSTERESIS_FOUND
    right = any(c.effect in HYSTERESIS for c in answer.causes)
    return (WITH_EXTRA if right else WRONG) + _surely(wrong)


def _foreign(record: Record, answer: Answer) -> str:
    if answer.verdict == "adequate":
        return MISSED
    if not answer.causes:
        return RIGHTLY_UNEXPLAINED
    nearest = frozenset[str]().union(*record.accepted)
    wrong = [c for c in answer.causes if not _hits(c.effect, nearest)]
    return WRONG + _surely(wrong) if wrong else NEAREST


def _hidden(record: Record, answer: Answer) -> str:
    if answer.verdict == "adequate":
        return MISSED
    if not answer.causes:
        return UNEXPLAINED
    found: set[int] = set()
    extra = []
    for cause in answer.causes:
        hit = _hit_of(cause, record.accepted)
        if hit is not None:
            found.add(hit)
        elif not (_other_hysteresis(record) and cause.effect in HYSTERESIS):
            extra.append(cause)
    if len(found) == len(record.accepted):
        if extra:
            return WITH_EXTRA
        return IN_SET if any(c.rivals for c in answer.causes) else ALONE
    if found:
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


def _other_hysteresis(record: Record) -> bool:
    return record.stack.hysteresis != "Bouc-Wen"


def _surely(wrong: Sequence[Named]) -> str:
    return SURELY if any(c.probability >= SURE for c in wrong) else ""
