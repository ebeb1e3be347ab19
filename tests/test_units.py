import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import UNITS, Power, Unit, convert, parse_unit, to_si, units_of

# Exponents from the SI brochure, 9th edition, tables 4 and 5; order kg m s A.
SI_BROCHURE = {
    "Hz": (0, 0, -1, 0), "N": (1, 1, -2, 0), "Pa": (1, -1, -2, 0), "J": (1, 2, -2, 0),
    "W": (1, 2, -3, 0), "C": (0, 0, 1, 1), "V": (1, 2, -3, -1), "F": (-1, -2, 4, 2),
    "Ohm": (1, 2, -3, -2), "S": (-1, -2, 3, 2), "H": (1, 2, -2, -2),
}  # fmt: skip

# Unit strings of the models: factor and exponents of the base units.
COMPOUNDS = {
    "N.s/m": (1.0, {"kg": 1, "s": -1}),
    "N/m": (1.0, {"kg": 1, "s": -2}),
    "N/V": (1.0, {"m": -1, "s": 1, "A": 1}),
    "N/(V.s)": (1.0, {"m": -1, "A": 1}),
    "N/V2": (1.0, {"kg": -1, "m": -3, "s": 4, "A": 2}),
    "V/s": (1.0, {"kg": 1, "m": 2, "s": -4, "A": -1}),
    "m/s": (1.0, {"m": 1, "s": -1}),
    "1/A": (1.0, {"A": -1}),
    "kg.m/s2": (1.0, {"kg": 1, "m": 1, "s": -2}),
    "um/ms": (1e-3, {"m": 1, "s": -1}),
    "um/V": (1e-6, {"kg": -1, "m": -1, "s": 3, "A": 1}),
    "K/W": (1.0, {"kg": -1, "m": -2, "s": 3, "K": 1}),
    "1/(kOhm.uF)": (1e3, {"s": -1}),
    "mm2": (1e-6, {"m": 2}),
    "m.s-2": (1.0, {"m": 1, "s": -2}),
    "%/degC": (0.01, {"K": -1}),
    "rad/s": (1.0, {"s": -1, "rad": 1}),
}

PREFIXES = {"p": -12, "n": -9, "u": -6, "m": -3, "k": 3, "M": 6, "G": 9}


@pytest.mark.parametrize("symbol", SI_BROCHURE)
def test_derived_units_have_the_exponents_of_the_si_brochure(symbol: str) -> None:
    unit = UNITS[symbol]
    assert unit.exponents == (*SI_BROCHURE[symbol], 0, 0, 0, 0)
    assert unit.factor == 1.0
    assert unit.offset == 0.0


@pytest.mark.parametrize("text", COMPOUNDS)
def test_compound_units(text: str) -> None:
    factor, exponents = COMPOUNDS[text]
    unit = parse_unit(text)
    assert unit.factor == factor
    assert unit.base_exponents == exponents
    assert unit.offset == 0.0


@pytest.mark.parametrize(
    ("written", "name"),
    [("µm", "um"), ("\u03bcF", "uF"), ("\u2126", "Ohm"), ("k\u03a9", "kOhm"), ("°C", "degC")],
)
def test_signs_that_people_write_are_understood(written: str, name: str) -> None:
    assert parse_unit(written) == UNITS[name]


@given(st.integers(-(10**9), 10**9), st.sampled_from(["um", "mV", "uF", "nm", "mA", "kN"]))
def test_a_decimal_number_converts_to_the_nearest_float(digits: int, unit: str) -> None:
    written = f"{digits}e{PREFIXES[unit[0]]}"
    assert to_si(float(digits), unit) == float(written)


@given(
    st.floats(1e-9, 1e6),
    st.sampled_from(["s", "V", "m", "N", "A", "K", "Hz", "Ohm", "F", "C", "degC", "deg", "%"]),
    st.data(),
)
def test_conversion_there_and_back_returns_the_value(
    value: float, start: str, data: st.DataObject
) -> None:
    other = data.draw(st.sampled_from(units_of(UNITS[start].quantity)))
    there = convert(value, start, other)
    back = convert(there, other, start)
    offset = max(UNITS[start].offset, UNITS[other].offset)
    assert math.isclose(back, value, rel_tol=1e-15, abs_tol=1e-15 * offset / UNITS[start].factor)


@given(st.sampled_from(sorted(UNITS)), st.sampled_from(sorted(UNITS)), st.integers(1, 3))
def test_a_product_and_a_quotient_add_and_subtract_exponents(a: str, b: str, power: int) -> None:
    def raised(unit: Unit, n: int) -> tuple[Power, ...]:
        return (*(n * e for e in unit.exponents), n * unit.counts)

    def of(text: str) -> tuple[Power, ...]:
        return raised(parse_unit(text), 1)

    one, two = UNITS[a], UNITS[b]
    product = tuple(x + y for x, y in zip(raised(one, 1), raised(two, power), strict=True))
    quotient = tuple(x - y for x, y in zip(raised(one, 1), raised(two, power), strict=True))
    suffix = str(power) if power > 1 else ""
    assert of(f"{a}.{b}{suffix}") == product
    assert of(f"{a}/{b}{suffix}") == quotient
    assert parse_unit(f"{a}/{b}{suffix}").ratio == one.ratio / two.ratio**power
    assert of(f"{a}/({b}{suffix}.{a})") == raised(two, -power)


def test_temperature_has_an_offset_only_by_itself() -> None:
    assert to_si(25.0, "degC") == 298.15
    assert convert(0.0, "K", "degC") == -273.15
    assert convert(2.0, "V/degC", "V/K") == 2.0


def test_converting_between_quantities_is_an_error_that_names_both() -> None:
    with pytest.raises(InputError, match=r"'mV' \(voltage\) to 'um' \(length\)"):
        convert(1.0, "mV", "um")
    with pytest.raises(InputError, match=r"sensor counts.*length"):
        convert(1.0, "counts", "um")
    with pytest.raises(InputError, match=r"dimension kg/s\b"):
        convert(1.0, "N.s/m", "N/m")


def test_an_unknown_unit_is_named_and_the_existing_ones_are_listed() -> None:
    with pytest.raises(InputError, match=r"unit 'micorn' is unknown; units of length .*um, nm"):
        parse_unit("micorn", "length")
    with pytest.raises(InputError, match=r"unit 'KV' is unknown; units of voltage .*kV, V, mV"):
        parse_unit("KV")
    with pytest.raises(InputError, match=r"unit 'furlang' in 'N/furlang' .*Ohm"):
        parse_unit("N/furlang")


@pytest.mark.parametrize("text", ["", "N/m/s", "N//m", "N.(m", "N/m.s", "2m", "m/"])
def test_what_is_no_unit_string_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(InputError, match=r"is not a unit string; .*N\.s/m or N/\(V\.s\)"):
        parse_unit(text)
