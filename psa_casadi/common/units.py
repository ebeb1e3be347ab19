"""The table of units, and conversion between them.

A unit string is written as FMI writes it: symbols joined by `.`, at most one `/`, exponents after
the symbol, a denominator of several symbols in parentheses: `N.s/m`, `N/(V.s)`, `kg.m/s2`, `1/A`.
`N*m`, `m/s^2` and `m/s²`, as laboratories write them, are read too. The table holds the units of
the house; any other symbol (rpm, bar, psi, inch, L, T) is looked up in pint.

Source: FMI 2.0.5, section 2.2.2, and FMI 3.0.2, section 2.4.3 (definition of units).
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from psa_casadi.common.errors import InputError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]
#: A number, or an array of them.
Value = TypeVar("Value", float, FloatArray)

#: The base units in FMI's order; `Unit.exponents` follows it.
BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")

Power = int | Fraction
Exponents = tuple[Power, Power, Power, Power, Power, Power, Power, Power]
NO_DIMENSION: Exponents = (0, 0, 0, 0, 0, 0, 0, 0)


@dataclass(frozen=True)
class Unit:
    """One unit: `value in SI base units = factor * value + offset`.

    `ratio` is the factor as an exact fraction. `exponents` are those of `BASE_UNITS`. `counts` is
    the exponent of a sensor's count, which no factor turns into anything else. `quantity` names
    what the unit measures; it is empty for a compound unit.
    """

    name: str
    ratio: Fraction
    offset: float
    exponents: Exponents
    counts: int = 0
    quantity: str = ""

    @property
    def factor(self) -> float:
        """Size of the unit in SI base units."""
        return float(self.ratio)

    @property
    def dimension(self) -> tuple[Exponents, int]:
        """What must be equal for two units to be convertible."""
        return self.exponents, self.counts

    @property
    def base_exponents(self) -> dict[str, Power]:
        """The exponents that are not zero, by the name of the base unit."""
        return {b: e for b, e in zip(BASE_UNITS, self.exponents, strict=True) if e}


_POWERS = {"p": -12, "n": -9, "u": -6, "m": -3, "": 0, "k": 3, "M": 6, "G": 9}

# symbol, quantity, prefixes in use other than none, exponents of kg m s A K mol cd rad
_SI_UNITS: tuple[tuple[str, str, str, Exponents], ...] = (
    ("s", "time", "num", (0, 0, 1, 0, 0, 0, 0, 0)),
    ("V", "voltage", "umk", (1, 2, -3, -1, 0, 0, 0, 0)),
    ("m", "length", "pnumk", (0, 1, 0, 0, 0, 0, 0, 0)),
    ("N", "force", "umkM", (1, 1, -2, 0, 0, 0, 0, 0)),
    ("A", "current", "pnumk", (0, 0, 0, 1, 0, 0, 0, 0)),
    ("K", "temperature", "m", (0, 0, 0, 0, 1, 0, 0, 0)),
    ("Hz", "frequency", "mkMG", (0, 0, -1, 0, 0, 0, 0, 0)),
    ("Ohm", "resistance", "mkMG", (1, 2, -3, -2, 0, 0, 0, 0)),
    ("F", "capacitance", "pnum", (-1, -2, 4, 2, 0, 0, 0, 0)),
    ("C", "charge", "pnum", (0, 0, 1, 1, 0, 0, 0, 0)),
    ("H", "inductance", "num", (1, 2, -2, -2, 0, 0, 0, 0)),
    ("S", "conductance", "num", (-1, -2, 3, 2, 0, 0, 0, 0)),
    ("J", "energy", "num", (1, 2, -2, 0, 0, 0, 0, 0)),
    ("W", "power", "umk", (1, 2, -3, 0, 0, 0, 0, 0)),
    ("Pa", "pressure", "kMG", (1, -1, -2, 0, 0, 0, 0, 0)),
    ("mol", "amount of substance", "", (0, 0, 0, 0, 0, 1, 0, 0)),
    ("cd", "luminous intensity", "", (0, 0, 0, 0, 0, 0, 1, 0)),
    ("rad", "angle", "num", (0, 0, 0, 0, 0, 0, 0, 1)),
)

_OTHER_UNITS: tuple[Unit, ...] = (
    Unit("g", Fraction(1, 1000), 0.0, (1, 0, 0, 0, 0, 0, 0, 0), quantity="mass"),
    Unit("kg", Fraction(1), 0.0, (1, 0, 0, 0, 0, 0, 0, 0), quantity="mass"),
    Unit("min", Fraction(60), 0.0, (0, 0, 1, 0, 0, 0, 0, 0), quantity="time"),
    Unit("h", Fraction(3600), 0.0, (0, 0, 1, 0, 0, 0, 0, 0), quantity="time"),
    Unit("deg", Fraction(math.pi / 180), 0.0, (0, 0, 0, 0, 0, 0, 0, 1), quantity="angle"),
    Unit("degC", Fraction(1), 273.15, (0, 0, 0, 0, 1, 0, 0, 0), quantity="temperature"),
    Unit("1", Fraction(1), 0.0, NO_DIMENSION, quantity="ratio"),
    Unit("%", Fraction(1, 100), 0.0, NO_DIMENSION, quantity="ratio"),
    Unit("ppm", Fraction(1, 10**6), 0.0, NO_DIMENSION, quantity="ratio"),
    Unit("counts", Fraction(1), 0.0, NO_DIMENSION, counts=1, quantity="sensor counts"),
)


#: Every unit that has a symbol, by that symbol.
UNITS: dict[str, Unit] = {
    f"{prefix}{symbol}": Unit(
        f"{prefix}{symbol}", Fraction(10) ** _POWERS[prefix], 0.0, exponents, quantity=quantity
    )
    for symbol, quantity, prefixes, exponents in _SI_UNITS
    for prefix in ("", *prefixes)
} | {unit.name: unit for unit in _OTHER_UNITS}

_ALIASES = str.maketrans(
    {"\u00b5": "u", "\u03bc": "u", "\u03a9": "Ohm", "\u2126": "Ohm", "°": "deg", "·": ".",
     "\u00d7": ".", "*": ".", "^": "", "²": "2", "³": "3", "\u212b": "angstrom", "Å": "angstrom"}
)  # fmt: skip
_FACTOR = re.compile(r"(?P<symbol>1|%|[A-Za-z]+)(?P<exponent>[+-]?[0-9]{1,2}(?:\.[0-9])?)?")
#: Between factors: a point or a space before a letter; in `m2.5` it belongs to the exponent.
_TIMES = re.compile(r"\s*[.\s]\s*(?=[A-Za-z%1])")
#: A unit's size in SI base units lies between this and its inverse, so that both are floats.
_SMALLEST = Fraction(1, 10**150)
_FORM = re.compile(r"(?P<above>[^/()]+)(?:/(?:\((?P<group>[^/()]+)\)|(?P<one>[^/().]+(?:\.\d)?)))?")
#: Pint's names of the base units, in their order, and of a sensor's count.
_PINT_BASE = (
    "kilogram", "meter", "second", "ampere", "kelvin", "mole", "candela", "radian", "count",
)  # fmt: skip
#: What engineers mean where pint has another unit of the name: an inch's thousandth, not an angle.
_ENGINEERS = {"mil": "thou", "mils": "thou"}
#: The longest symbol that is looked up in pint.
_LONGEST_SYMBOL = 24


def units_of(quantity: str) -> tuple[str, ...]:
    """Return the symbols of the units of one quantity, such as "voltage", largest first."""
    units = [unit for unit in UNITS.values() if unit.quantity == quantity]
    return tuple(unit.name for unit in sorted(units, key=lambda unit: -unit.ratio))


def parse_unit(text: str, quantity: str = "", *, common: bool = False) -> Unit:
    """Return the unit that an FMI-style unit string names.

    In a compound a temperature is a difference: `V/degC` has no offset. `quantity` is what the
    unit is meant to measure ("voltage"), so that the message on an unknown unit lists the right
    ones; it does not restrict the result. `common` restricts it to the symbols of the table.

    Raises:
        InputError: a symbol is unknown (the sentence lists units that exist), or the string is not
            a unit string.
    """
    name = _TIMES.sub(".", text.strip().replace("**", "").translate(_ALIASES))
    if name in UNITS:
        return UNITS[name]
    form = _FORM.fullmatch(name)
    if form is None:
        raise InputError(_not_a_unit(text))
    if not common and name.isalpha() and (whole := _from_pint(name)):
        return whole
    ratio, exponents, counts = Fraction(1), list(NO_DIMENSION), Fraction(0)
    below = form["group"] or form["one"]
    for part, sign in ((form["above"], 1), (below, -1)):
        for factor in _TIMES.split(part.strip()) if part else ():
            match = _FACTOR.fullmatch(factor)
            if match is None:
                raise InputError(_not_a_unit(text))
            symbol = match["symbol"]
            unit = UNITS.get(symbol) or (None if common else _from_pint(symbol))
            if unit is None:
                raise InputError(_unknown_symbol(symbol, text, quantity))
            power = sign * Fraction(match["exponent"] or 1)
            ratio *= Fraction(unit.ratio**power)
            if not _SMALLEST < ratio < 1 / _SMALLEST:
                raise InputError(_not_a_unit(text))
            counts += power * unit.counts
            exponents = [
                e + power * other for e, other in zip(exponents, unit.exponents, strict=True)
            ]
    if counts.denominator != 1:
        raise InputError(_not_a_unit(text))
    kg, m, s, A, K, mol, cd, rad = map(_whole, exponents)
    return Unit(name, ratio, 0.0, (kg, m, s, A, K, mol, cd, rad), int(counts))


def _whole(power: Power) -> Power:
    return int(power) if power == int(power) else power


@cache
def _registry() -> Any:
    import pint  # noqa: PLC0415 - a second to load, for symbols that are not in the table

    return pint.UnitRegistry(non_int_type=Fraction)


@cache
def _from_pint(symbol: str) -> Unit | None:
    """Return the unit of a symbol or a name that pint knows; None where it is none of ours."""
    if not 1 < len(symbol) <= _LONGEST_SYMBOL and symbol not in "TGLlhd":
        return None
    registry = _registry()
    try:
        unit = registry.parse_units(_ENGINEERS.get(symbol, symbol))
        factor, base = registry.get_base_units(unit, check_nonmult=False)
        offset = registry.Quantity(Fraction(0), unit).to(base).magnitude
    except Exception:  # noqa: BLE001 - pint may raise anything on a word that is no unit
        return None
    powers = dict(base._units)
    exponents = [powers.pop(name, 0) for name in _PINT_BASE]
    if powers or any(p != int(p) for p in exponents) or not factor > 0:  # bits, gauss of 1881
        return None
    ratio = Fraction(factor).limit_denominator(10**40)
    kg, m, s, A, K, mol, cd, rad, count = map(int, exponents)
    read = Unit(symbol, ratio, float(offset), (kg, m, s, A, K, mol, cd, rad), count)
    similar = [unit for unit in UNITS.values() if unit.dimension == read.dimension]
    same = [u for u in similar if (u.ratio, u.offset) == (read.ratio, read.offset)]
    return next(iter(same), replace(read, quantity=similar[0].quantity if similar else ""))


def _not_a_unit(text: str) -> str:
    return (
        f"'{text[:60]}' is not a unit string; write symbols joined by '.', at most one '/', and a "
        f"denominator of several symbols in parentheses, such as N.s/m or N/(V.s)."
    )


def _unknown_symbol(symbol: str, text: str, quantity: str) -> str:
    within = "" if symbol == text.strip() else f" in '{text[:60]}'"
    by_case = [unit.quantity for unit in UNITS.values() if unit.name.lower() == symbol.lower()]
    listed = units_of(quantity or by_case[0]) if quantity or by_case else tuple(UNITS)
    what = f"units of {quantity or by_case[0]}" if quantity or by_case else "units"
    return f"the unit '{symbol[:60]}'{within} is unknown; {what} that exist: {', '.join(listed)}."


def convert(value: Value, from_unit: str, to_unit: str) -> Value:
    """Return `value` [`from_unit`] in `to_unit`.

    Powers of ten convert with a single rounding: 7 um becomes exactly the float 7e-6.

    Raises:
        InputError: a unit is unknown, or the two measure different quantities.
    """
    source, target = parse_unit(from_unit), parse_unit(to_unit)
    if source.dimension != target.dimension:
        raise InputError(
            f"cannot convert '{from_unit}' ({_describe(source)}) to '{to_unit}' "
            f"({_describe(target)}): they measure different quantities; correct one of the units."
        )
    ratio = source.ratio / target.ratio
    scaled = value * float(ratio) if ratio >= 1 else value / float(1 / ratio)
    if source.offset == target.offset:
        return scaled
    return scaled + (source.offset - target.offset) / target.factor


def to_si(value: Value, unit: str) -> Value:
    """Return `value` [`unit`] in SI base units; counts stay counts.

    Raises:
        InputError: the unit is unknown.
    """
    return convert(value, unit, si_unit(unit))


def si_unit(unit: str) -> str:
    """Return the coherent SI unit of the quantity that `unit` measures, such as "m" for "um".

    A unit with a symbol keeps one (V for mV); a compound is spelled in base units (m/s for um/ms).

    Raises:
        InputError: the unit is unknown.
    """
    parsed = parse_unit(unit)
    if parsed.ratio == 1 and not parsed.offset:
        return parsed.name
    coherent = replace(parsed, ratio=Fraction(1), offset=0.0)
    for candidate in UNITS.values():
        if replace(candidate, name=parsed.name) == coherent:
            return candidate.name
    return _spell(parsed)


def _spell(unit: Unit) -> str:
    powers = [*unit.base_exponents.items(), *([("counts", unit.counts)] if unit.counts else [])]
    above = ".".join(f"{b}{e}" if e != 1 else b for b, e in powers if e > 0) or "1"
    below = [f"{b}{-e}" if e != -1 else b for b, e in powers if e < 0]
    if not below:
        return above
    return f"{above}/{below[0]}" if len(below) == 1 else f"{above}/({'.'.join(below)})"


def _describe(unit: Unit) -> str:
    return unit.quantity or f"dimension {_spell(unit)}"


def per(unit: str, below: Sequence[str]) -> str:
    """Return the SI unit of one quantity over the product of others, in base units."""
    above, *lower = (parse_unit(si_unit(q)) if q else parse_unit("1") for q in (unit, *below))
    left = [a - sum(rest) for a, *rest in zip(*(q.exponents for q in (above, *lower)), strict=True)]
    return _spell(replace(above, exponents=tuple(left), counts=above.counts))


def rate_unit(unit: str) -> str:
    """Return the unit of a quantity's time derivative: m/s for m, m/s2 for m/s, N/(V.s) for N/V."""
    above, _, below = unit.partition("/")
    if not below:
        return f"{above}/s"
    factors = below.strip("()").split(".")
    for i, factor in enumerate(factors):
        match = re.fullmatch(r"s(\d*)", factor)
        if match:
            factors[i] = f"s{int(match[1] or 1) + 1}"
            break
    else:
        factors.append("s")
    return f"{above}/{factors[0]}" if len(factors) == 1 else f"{above}/({'.'.join(factors)})"
