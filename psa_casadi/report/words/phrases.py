"""Numbers and findings in words: the sentences that every report shares."""

import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from psa_casadi.common.units import convert
from psa_casadi.diagnosis.result import Cause, Diagnosis
from psa_casadi.diagnosis.task import Thresholds
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment

#: A length in a sentence keeps its usual unit where the page's would give a larger number.
_LARGEST = 1000.0
#: Units of quantities in sentences, the largest first, and the least value that each is for.
_IN_SENTENCES: dict[str, tuple[tuple[str, float], ...]] = {
    "m": (("mm", 1e-3), ("µm", 1e-6), ("nm", 1e-9)),
    "s": (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)),
}
_LEAST = 0.1

#: Units that take prefixes, and these, the largest first.
_PREFIXED = frozenset(("m", "s", "V", "A", "N", "Pa", "Hz", "C", "W", "J", "rad"))
_PREFIXES = (("M", 1e6), ("k", 1e3), ("", 1.0), ("m", 1e-3), ("µ", 1e-6), ("n", 1e-9))


@dataclass(frozen=True)
class Scale:
    """A unit to show a length in: `number = factor * metres`; counts stay counts."""

    unit: str
    factor: float

    def text(self, metres: float, digits: int = 3) -> str:
        """Return a length with its unit, such as "12.3 nm"."""
        return f"{number(self.factor * metres, digits)} {self.unit}".rstrip()


_PAGE: ContextVar[Scale | None] = ContextVar("unit of a page", default=None)


@contextmanager
def one_unit(scale: Scale | None) -> Iterator[None]:
    """Show all errors in one unit meanwhile, each in a handy one without a scale."""
    before = _PAGE.set(scale)
    try:
        yield
    finally:
        _PAGE.reset(before)


def length_scale(largest: float, *, counts: bool = False) -> Scale:
    """Return the unit of a page's errors, else that in which `largest` [m] is a handy number."""
    page = _PAGE.get()
    if counts or page is None or page.unit == "counts":
        return handy_scale(largest, counts=counts)
    return page


def scale_of(experiments: Iterable[Experiment], largest: float) -> Scale:
    """Return the unit of errors of size `largest` [m] of records, which may be in counts."""
    counts = any(getattr(e.record, "displacement_unit", "m") == "counts" for e in experiments)
    return length_scale(largest, counts=counts)


def handy_scale(largest: float, *, counts: bool = False) -> Scale:
    """Return the unit in which a length of size `largest` [m] is a handy number."""
    if counts:
        return Scale("counts", 1.0)
    return prefixed_scale(min(max(1e-9, largest), 0.1), "m")  # never in metres


def prefixed_scale(largest: float, unit: str) -> Scale:
    """Return a unit with the prefix that makes `largest` a handy number; compounds have none."""
    if unit in _PREFIXED and largest > 0:
        prefix = next((p for p in _PREFIXES if largest >= 0.5 * p[1]), _PREFIXES[-1])
        return Scale(prefix[0] + unit, 1.0 / prefix[1])
    return Scale("" if unit == "1" else unit, 1.0)


def any_scale(largest: float, unit: str) -> Scale:
    """Return the unit in which a quantity of size `largest` in an SI unit is a handy number."""
    return handy_scale(largest) if unit == "m" else prefixed_scale(largest, unit or "1")


def in_brackets(what: str, unit: str) -> str:
    """Return the label of an axis: the quantity with its unit in brackets, if it has one."""
    return f"{what} [{unit}]" if unit not in ("", "1") else what


def number(value: float, digits: int = 3, *, trim: bool = False) -> str:
    """Return a number with a count of significant digits, with an exponent only where it helps.

    With `trim` it ends in no zeros behind its point.
    """
    if not math.isfinite(value):
        return "not finite"
    if trim:
        return f"{float(f'{value:.{digits - 1}e}'):g}"
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if -4 < power < 6:
        return f"{float(f'{mantissa}e{power}'):.{max(0, digits - 1 - power)}f}"
    return f"{mantissa}e{power}"


def percent(share: float) -> str:
    """Return a share as a percentage, such as "97 %"."""
    return f"{100.0 * share:.0f} %"


def quantity(value: float, unit: str = "1") -> str:
    """Return a value in SI units with two digits, such as "0.12 µm"; of a page, in its unit."""
    sizes = _IN_SENTENCES.get(unit, ((unit, 1.0),))
    if value == 0 and unit == "m":
        sizes = sizes[1:2]
    name, size = next((u for u in sizes if abs(value) >= _LEAST * u[1]), sizes[-1])
    page = _PAGE.get()
    in_page = unit == "m" and page is not None and page.unit != "counts"
    if in_page and page is not None and abs(page.factor * value) < _LARGEST:
        name, size = page.unit, 1.0 / page.factor
    return with_unit(number(value / size, 2, trim=True), name)


def signed(value: float, unit: str) -> str:
    """Return a quantity with its sign, also where it is above zero."""
    return f"{'+' if value > 0 else ''}{quantity(value, unit)}"


#: Width of the labels of a terminal's lines.
_LABEL = 10


def labelled(rows: Iterable[tuple[str, str]], width: int) -> str:
    """Return texts behind their labels, in lines of this width."""
    return "\n".join(
        # a percent sign stays with its number
        textwrap.fill(
            text.replace(" %", "\u00a0%"),
            max(width, 40),
            initial_indent=f"{label:<{_LABEL}} ",
            subsequent_indent=" " * (_LABEL + 1),
            break_long_words=False,
            break_on_hyphens=False,
        ).replace("\u00a0", " ")
        for label, text in rows
    )


def raised(text: str) -> str:
    """Return a text with a capital at its start."""
    return f"{text[:1].upper()}{text[1:]}"


def lowered(text: str) -> str:
    """Return a text with a small letter at its start."""
    return f"{text[:1].lower()}{text[1:]}"


def within(share: float) -> float:
    """Return a share cut to 0 and 1."""
    return max(0.0, min(1.0, share))


def probability_text(probability: float) -> str:
    """Return a probability as a percentage that is neither 0 nor 100."""
    if probability < 0.005:
        return "< 1 %"
    return percent(probability) if probability < 0.995 else "> 99 %"


#: Words for a probability from so much on (IPCC, Mastrandrea et al. 2010, table 1).
_LIKELIHOOD = (
    (0.99, "virtually certain"), (0.95, "extremely likely"), (0.9, "very likely"),
    (0.66, "likely"), (0.51, "more likely than not"), (0.33, "about as likely as not"),
)  # fmt: skip


def confidence_text(confidence: float) -> str:
    """Return how sure a cause is, as a number and in words."""
    rounded = round(confidence, 2)
    words = next((w for least, w in _LIKELIHOOD if rounded >= least), "unlikely")
    return f"confidence {percent(confidence)}: {words}"


def rest_sentence(d: Diagnosis) -> str:
    """Say what remains, with the p value of the test of the rest.

    It is of white noise: a small one is left out where noise of another colour, or below the
    detection limit, is what remains.
    """
    p, where = d.remaining.p_value, d.remaining.where
    if d.remaining.white and p < Thresholds().alarm:
        return where
    return f"{where.rstrip('.')} ({f'p = {number(p, 2)}' if p > 1e-6 else 'p < 1e-6'})."


def plain(name: str) -> str:
    """Return the name of an effect as words: "slow_creep" is slow creep."""
    return name.replace("_", " ")


#: Effects that a sentence names of those that it is about.
MOST_NAMES = 5


def listing(
    each: Iterable[str], joint: str = "and", between: str = ",", *, most: int | None = None
) -> str:
    """Return "a, b and c", or "a, b and 7 more" of more words than `most`."""
    words = list(each)
    if most is not None and len(words) > most:
        return f"{', '.join(words[:most])} {joint} {len(words) - most} more"
    if len(words) < 2:
        return "".join(words)
    return f"{f'{between} '.join(words[:-1])}{'' if joint[0] == ';' else ' '}{joint} {words[-1]}"


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, such as "2 records"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def either(effects: Sequence[str]) -> str:
    """Return effects of which the data leave open which it is, as words."""
    return listing([plain(name) for name in effects], "or", most=MOST_NAMES)


def with_unit(text: str, unit: str) -> str:
    """Return a number's text with its unit; "1" is no unit to a reader."""
    return text if unit in ("", "1") else f"{text} {unit}"


def with_its_unit(value: float, unit: str) -> str:
    """Return a figure of an output with its unit, with a prefix where that has one."""
    scale = prefixed_scale(value, unit or "1")
    return with_unit(number(scale.factor * value), scale.unit or "1")


def in_display_unit(model: Model, name: str, *values: float) -> tuple[str, list[float]]:
    """Return the display unit of a parameter, and SI values in it."""
    parameter = model.parameter(name)
    unit = parameter.display_unit or parameter.unit
    return unit, [convert(v, parameter.unit, unit) for v in values]


def interval_text(low: float, high: float) -> str:
    """Return an interval; one over more than four decades counts as not determined."""
    if not (math.isfinite(low) and math.isfinite(high)) or (low > 0 and high > 1e4 * low):
        return "not determined"
    digits = interval_digits(low, high)
    return f"{number(low, digits)} to {number(high, digits)}"


def interval_digits(low: float, high: float) -> int:
    """Return with how many significant digits the ends of an interval differ, three at least."""
    return next((d for d in (3, 4, 5) if number(low, d) != number(high, d)), 6)


def added(d: Diagnosis) -> bool:
    """Say whether the extended model differs from the base."""
    return bool(d.causes or d.kept)


def place_of(cause: Cause) -> str:
    """Say where a cause sits: the port of a model, or the part of a stack's rig."""
    return cause.port or cause.belongs_to
