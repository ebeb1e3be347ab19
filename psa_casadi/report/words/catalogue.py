"""Texts by table and code, from the TOML files here, with the values in their places."""

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.resources import files
from typing import Any

import numpy as np
from jinja2 import DictLoader, Environment, StrictUndefined

from psa_casadi.common.errors import quoted
from psa_casadi.records.drive import is_mains
from psa_casadi.report.words import phrases
from psa_casadi.report.words.phrases import listing

#: The tables of texts by code.
TABLES: dict[str, dict[str, Any]] = {}
for _file in ("notes.toml", "sentences.toml", "words.toml"):
    TABLES |= tomllib.loads(files("psa_casadi.report.words").joinpath(_file).read_text("utf-8"))

#: Titles of views along the coordinates of a residual, and labels of their axes.
TITLES: Mapping[str, str] = TABLES["axis_title"]
LABELS: Mapping[str, str] = TABLES["axis_label"]


def say(code: str, **values: Any) -> str:
    """Return the sentence `TABLE.CODE` with its values; LookupError where there is none."""
    return CATALOGUE.get_template(code).render(values)


def _inserted(value: Any) -> Any:
    """Return a value as sentences show it: a quantity (value, unit) in a handy unit."""
    if not isinstance(value, tuple):
        return value
    is_quantity = len(value) == 2 and isinstance(value[0], float) and isinstance(value[1], str)
    return phrases.quantity(*value) if is_quantity else ", ".join(map(str, value))


def _formatted(value: Any, form: str) -> str:
    """Return a number in a format; that of a quantity (value, unit) with its unit behind it."""
    if isinstance(value, tuple):
        return phrases.with_unit(format(value[0], form), value[1])
    return format(value, form)


def _of_quantity(show: Callable[..., str]) -> Callable[..., str]:
    """Return what shows a value and a unit, or the two as one quantity."""
    return lambda value, *unit: show(*(value if isinstance(value, tuple) else (value, *unit)))


def _word(code: str, table: str, other: str | None = None) -> Any:
    """Return a word by its code, or by another one; the code itself where there is none."""
    words = TABLES[table]
    return words[code] if other is None or code in words else words.get(other, code)


def plural(count: Any, one: str, several: str) -> str:
    """Return the singular or plural for a number, or for the length of a collection."""
    return one if (len(count) if hasattr(count, "__len__") else count) == 1 else several


def _times(count: float) -> str:
    return {1: "once", 2: "twice"}.get(round(count), f"{count:.0f} times")


def _instants(at: Sequence[float], count: float) -> str:
    more = f" and {count - len(at):.0f} more" if count > len(at) else ""
    return f"at {listing([f'{t:.6g} s' for t in at])}{more}"


def _frequencies(at: Iterable[float]) -> str:
    return listing([f"{f:.4g} Hz{' (mains)' if is_mains(f) else ''}" for f in at])


def _reading(reading: tuple[float, str], digits: int) -> str:
    size, unit = reading
    scale = phrases.prefixed_scale(abs(size), unit or "1")
    return phrases.with_unit(f"{scale.factor * size:.{digits}g}", scale.unit)


def _estimate(estimate: tuple[float, float, float]) -> str:
    """Return a value with its interval, in as many digits as distinguish them, four at least."""
    value, low, high = estimate
    half, digits = max(high - value, value - low), 4
    if 0.0 < half < abs(value):
        digits = max(4, min(9, 1 + math.ceil(math.log10(abs(value) / half))))
    return f"{value:.{digits}g} ({low:.{digits}g} to {high:.{digits}g})"


def si(value: float, unit: str) -> str:
    """Return a value with three digits at most and a prefix, such as "200 kHz"."""
    if value == 0.0:
        return f"0 {unit}"
    prefixes = {-9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}
    power = int(np.clip(3 * math.floor(math.log10(abs(value) * 1.0005) / 3), -9, 6))
    if unit == "s" and value >= 1.0:
        power = 0
    return f"{value / 10.0**power:.3g} {prefixes[power]}{unit}"


def _relative(share: float) -> str:
    return f"{100.0 * share:.2g} %" if share < 0.995 else "no better than its size"


def _probable(then: Iterable[tuple[str, float]]) -> str:
    return ", ".join(f"{name} {phrases.percent(p)}" for name, p in then)


#: What fills the sentences in; the filters are for values that need more than a format.
CATALOGUE = Environment(
    loader=DictLoader({f"{t}.{n}": text for t, rows in TABLES.items() for n, text in rows.items()}),
    undefined=StrictUndefined, variable_start_string="{", variable_end_string="}",
    finalize=_inserted, autoescape=False, keep_trailing_newline=True,
)  # fmt: skip
CATALOGUE.globals["infinity"] = math.inf
_OF_PHRASES = (
    "confidence_text", "counted", "either", "listing", "number", "percent", "plain", "raised",
    "with_unit", "within",
)  # fmt: skip
CATALOGUE.filters |= {name: getattr(phrases, name) for name in _OF_PHRASES}
CATALOGUE.filters |= {
    "correlation": lambda value: f"{value:.2f}".replace("-", "−"),
    "estimate": _estimate,
    "fmt": _formatted,
    "frequencies": _frequencies,
    "instants": _instants,
    "plural": plural,
    "probable": _probable,
    "quantity": _of_quantity(phrases.quantity),
    "quoted": quoted,
    "reading": _reading,
    "relative": _relative,
    "si": si,
    "signed": _of_quantity(phrases.signed),
    "times": _times,
    "with_its_unit": _of_quantity(phrases.with_its_unit),
    "word": _word,
}
