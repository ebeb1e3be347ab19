"""Numbers and findings in words: the sentences that every report shares."""

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING

from psa_casadi.diagnosis.residual.misfit import Misfit
from psa_casadi.diagnosis.result import Alternative, Candidate, Cause, Decision, Diagnosis
from psa_casadi.model.compose import Model
from psa_casadi.units import convert

if TYPE_CHECKING:  # which take long to load
    from psa_casadi.any_model.result import OdeDiagnosis

#: A length in a sentence.
_LENGTH = re.compile(r"(?P<number>[+-]?\d[\d.]*(?:e[+-]?\d+)?) (?P<unit>mm|um|nm)\b")
_METRES = {"mm": 1e-3, "um": 1e-6, "nm": 1e-9}
#: A length in a sentence stays in its own unit where the page's would give a larger number.
_LARGEST = 1000.0

#: Units that take prefixes, and these, the largest first.
_PREFIXED = frozenset(("m", "s", "V", "A", "N", "Pa", "Hz", "C", "W", "J", "rad"))
_PREFIXES = (("M", 1e6), ("k", 1e3), ("", 1.0), ("m", 1e-3), ("µ", 1e-6), ("n", 1e-9))

#: What a record may be: measured on a device, or computed.
ORIGINS = ("measured", "synthetic")

VERDICTS = {
    "adequate": "adequate",
    "cause_named": "cause named",
    "partly_explained": "partly explained",
    "ambiguous": "ambiguous",
    "unexplained": "unexplained",
    "not_driven": "not driven",
}


@dataclass(frozen=True)
class Scale:
    """A unit to show a length in: `shown = factor * metres` (counts are shown as they are)."""

    unit: str
    factor: float

    def text(self, metres: float, digits: int = 3) -> str:
        """Return a length with its unit, such as "12.3 nm"."""
        return f"{number(self.factor * metres, digits)} {self.unit}".rstrip()


_PAGE: ContextVar[Scale | None] = ContextVar("unit of a page", default=None)


@contextmanager
def one_unit(scale: Scale) -> Iterator[None]:
    """Show all errors in one unit meanwhile, so that those of one page can be compared."""
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


def handy_scale(largest: float, *, counts: bool = False) -> Scale:
    """Return the unit in which a length of size `largest` [m] is a handy number."""
    if counts:
        return Scale("counts", 1.0)
    for unit, size in (("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9)):
        if largest >= 0.5 * size:
            return Scale("µm" if unit == "um" else unit, 1.0 / size)
    return Scale("nm", 1e9)


def prefixed_scale(largest: float, unit: str) -> Scale:
    """Return a unit with the prefix that makes `largest` a handy number; compounds have none."""
    if unit in _PREFIXED and largest > 0:
        found = next((p for p in _PREFIXES if largest >= 0.5 * p[1]), _PREFIXES[-1])
        return Scale(found[0] + unit, 1.0 / found[1])
    return Scale("" if unit == "1" else unit, 1.0)


def in_brackets(what: str, unit: str) -> str:
    """Return what an axis says: the quantity with its unit in brackets, if it has one."""
    return f"{what} [{unit}]" if unit not in ("", "1") else what


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, with an exponent only where it helps."""
    if not math.isfinite(value):
        return "not finite"
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


def in_page_unit(sentence: str) -> str:
    """Return a sentence with its errors in the unit of the page, and "µm" for "um"."""
    page = _PAGE.get()

    def shown(length: re.Match[str]) -> str:
        unit = length["unit"].replace("u", "µ")
        if page is None or page.unit in ("counts", unit):
            return f"{length['number']} {unit}"
        value = page.factor * _METRES[length["unit"]] * float(length["number"])
        if abs(value) >= _LARGEST:
            return f"{length['number']} {unit}"
        sign = "+" if length["number"].startswith("+") else ""
        return f"{sign}{float(f'{value:.1e}'):g} {page.unit}"

    return _LENGTH.sub(shown, sentence)


def strongest_sentence(misfits: Sequence[Misfit]) -> str:
    """Return the sentence that says most of what is wrong, "" if nothing is above the noise."""
    told = [m for m in misfits if len(m.sentences) > 1]
    if told:
        return in_page_unit(max(told, key=weight).sentences[1])
    return ""


def weight(m: Misfit) -> float:
    """Return the excess over the noise, by which records are compared."""
    return m.excess * (m.rms / m.floor.level if m.floor.level > 0 else 1.0)


def probability_text(probability: float) -> str:
    """Return a probability as a percentage that is neither 0 nor 100."""
    if probability < 0.005:
        return "< 1 %"
    return percent(probability) if probability < 0.995 else "> 99 %"


def share_text(candidate: Candidate) -> str:
    """Return the share of the excess that an effect explains, and whether it was only screened."""
    if not candidate.fitted and candidate.explained_share == 0:
        return "screened"
    if candidate.explained_share < 0:
        return "fits worse"
    share = percent(candidate.explained_share)
    return share if candidate.fitted else f"{share} (screened)"


def rest_sentence(d: "Diagnosis | OdeDiagnosis") -> str:
    """Say what remains, with the p value of the test of the rest."""
    p = d.remaining.p_value
    return f"{d.remaining.where.rstrip('.')} ({f'p = {number(p, 2)}' if p > 1e-6 else 'p < 1e-6'})."


def plain(name: str) -> str:
    """Return the name of an effect as words: "slow_creep" is slow creep."""
    return name.replace("_", " ")


def listing(words: Sequence[str], joint: str = "and") -> str:
    """Return "a, b and c"."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {joint} {words[-1]}"


def with_unit(text: str, unit: str) -> str:
    """Return a number's text with its unit; "1" is no unit to a reader."""
    return text if unit == "1" else f"{text} {unit}"


def shown_in(model: Model, name: str) -> tuple[str, str]:
    """Return the SI unit of a parameter and the unit it is shown in."""
    parameter = model.parameter(name)
    return parameter.unit, parameter.display_unit or parameter.unit


def interval_text(low: float, high: float) -> str:
    """Return an interval; one over more than four decades says that nothing was determined."""
    if not (math.isfinite(low) and math.isfinite(high)) or (low > 0 and high > 1e4 * low):
        return "not determined"
    digits = next((d for d in (3, 4, 5) if number(low, d) != number(high, d)), 6)
    return f"{number(low, digits)} to {number(high, digits)}"


def added(d: "Diagnosis | OdeDiagnosis") -> bool:
    """Say whether the extended model differs from the base."""
    return bool(d.causes or (isinstance(d, Diagnosis) and d.kept))


#: What an interval of the gain from blocks of few records says.
OWN_VOLTAGES = (
    "The interval is taken over blocks of the held-out samples and holds for these voltages only;"
    " for other voltages hold out four records or more (--holdout)."
)


def gain_sentence(d: Diagnosis) -> str:
    """Say how far the held-out error falls."""
    gain = d.gain.holdout_rms_reduction_percent
    low, high = d.gain.interval
    if gain <= 0:
        return "the held-out error does not fall"
    return f"the held-out error falls by {gain:.0f} % (95 % interval {low:.0f} to {high:.0f} %)"


_PLAIN = {
    "adequate": "Nothing beyond the noise is missing from the base model",
    "not_driven": "The displacement does not follow the voltage: nothing can be diagnosed",
}


def verdict_sentence(d: Diagnosis) -> str:
    """Say the verdict in one sentence, with confidence and gain."""
    if d.doubt:
        seen = (
            "Nothing beyond the noise is seen to be missing"
            if d.verdict == "adequate"
            else "Something is missing, and no cause is named"
        )
        return f"{seen}; {d.doubt}."
    error = (
        f"the base model's held-out error is {number(d.base_errors.holdout_nrmse_percent, 2)} %"
        " of the range"
    )
    if d.verdict in _PLAIN:
        return f"{_PLAIN[d.verdict]}; {error}."
    if d.verdict == "unexplained" or not d.causes:
        return (
            "Something is missing, and no effect in the table explains it: no cause is named; "
            f"{_kept(d)}{_unnamed(d)}{error}."
        )
    share = None if d.budget is None else d.budget.together.share
    return naming_sentence(d, [_cause(c) for c in d.causes], gain_sentence(d), share)


def naming_sentence(
    d: "Diagnosis | OdeDiagnosis", causes: Sequence[str], gain: str, share: float | None
) -> str:
    """Say the verdict of a diagnosis that names: its `causes` in words, and what they remove.

    `gain` is what they do to the error, `share` what they remove of its power above the noise.
    """
    if d.verdict == "ambiguous":
        first = d.causes[0]
        rivals = listing([plain(n) for n in (first.effect, *first.cannot_be_told_from)], "or")
        together = listing([plain(c.effect) for c in d.causes])
        return (
            f"Something is missing, and these data do not decide whether it is {rivals}; with"
            f" {together}, {gain}."
        )
    are = f"{'cause is' if len(causes) == 1 else 'causes are'} {listing(causes)}"
    if d.verdict == "partly_explained":
        of = "" if share is None else f" ({percent(within(share))} of its power above the noise)"
        return f"The closest known {are}: {gain}{of}; more than noise remains."
    return f"The {are}: {gain}."


def within(share: float) -> float:
    """Return a share as it is shown, from 0 to 1."""
    return max(0.0, min(1.0, share))


def _kept(d: Diagnosis) -> str:
    """Say what the extended model of a diagnosis without a cause holds, "" where nothing."""
    if d.budget is None or not d.kept:
        return ""
    share = percent(within(d.budget.together.share))
    return (
        f"{listing([plain(name) for name in d.kept])} removes {share} of the error above the noise"
        " and is kept in the extended model without being a cause; "
    )


def _unnamed(d: Diagnosis) -> str:
    """Say what the unnamed correction would remove, "" without one."""
    if d.patch is None or d.budget is None or d.budget.unnamed is None:
        return ""
    share = percent(within(d.budget.unnamed.share))
    more = "a further " if added(d) else ""
    return f"{d.patch.sentence} would remove {more}{share} of the error above the noise; "


def _cause(cause: Cause) -> str:
    return f"{plain(cause.effect)} ({cause.belongs_to}, confidence {percent(cause.confidence)})"


def alternative_sentence(d: Diagnosis, a: Alternative) -> str:
    """Say which of two causes an exported plant holds, and what that makes of its displacement."""
    counts = any(e.record.displacement_unit == "counts" for e in d.experiments)
    apart = length_scale(a.plant_differs_m, counts=counts).text(a.plant_differs_m, 2)
    inside = any(c.name == a.cause for c in d.model.plant().components)
    holds = "holds" if inside else "leaves out"
    return (
        f"an exported plant {holds} the {plain(a.cause)}; with {plain(a.instead)} in its place its"
        f" displacement differs by up to {apart} ({number(a.plant_differs_percent, 2)} % of range),"
        " which these data do not decide"
    )


def column_sentence(d: Diagnosis, c: Decision) -> str:
    """Say what a further column decided, and what the models miss of it in held-out samples."""
    if c.base_rms is None or c.noise is None or c.extended_rms is None:
        return c.sentence
    after = f", extended {number(c.extended_rms)}" if added(d) else ""
    errors = f"base {number(c.base_rms)}{after}, noise {number(c.noise)}"
    return f"{c.sentence} Held-out rms: {with_unit(errors, c.unit)}."


def cause_size(d: Diagnosis, cause: Cause) -> str:
    """Return "name = value unit (low to high)" for every parameter of a cause.

    Of one that is several of a kind, and has many, at which frequencies they are.
    """
    several = next((c for c in d.model.components if c.name == cause.effect and c.count > 1), None)
    if several is not None:
        tones = sorted(d.model.values[p.name] for p in several.parameters if p.unit == "Hz")
        return f"at {', '.join(number(v) for v in tones)} Hz"
    texts = []
    for name, e in cause.parameters.items():
        unit, display = shown_in(d.model, name)
        value, low, high = (convert(v, unit, display) for v in (e.value, *e.interval))
        estimate = with_unit(number(value), display)
        texts.append(f"{name} = {estimate} ({interval_text(low, high)})")
    return ", ".join(texts)
