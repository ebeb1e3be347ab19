"""Mistakes in modelDescription.xml, each with the rows of the check that must find it."""

from collections.abc import Callable

from psa_casadi.export.common.variable_table import variable_table
from tests.export.fmu_models import model_named

STACK = "P-885.51"
#: Value references of the model's variables by name.
PLACES = {v.name: k for k, v in enumerate(variable_table(model_named(STACK).plant()), 1)}
SWITCH, KNOWNS = "switch.voltage_reversal", ("u", "voltage", "G", "R_s", "C_p")
KINDS = "tunable tunable dependent dependent dependent"


def _unknown(fmi: int, name: str, *knowns: str, kinds: str) -> str:
    """Return how the description lists the dependencies of an output."""
    places = " ".join(str(PLACES[n]) for n in knowns)
    own = "index" if fmi == 2 else "valueReference"
    return f'{own}="{PLACES[name]}" dependencies="{places}" dependenciesKind="{kinds}"'


def _dependency(
    name: str, before: tuple[str, str], after: tuple[str, str], fmi: int
) -> tuple[str, str]:
    """Return the edit of an entry; a pair has the knowns and their kinds."""
    old, new = (_unknown(fmi, name, *k.split(), kinds=kinds) for k, kinds in (before, after))
    return old, new


def _of_state(fmi: int, unit: str) -> tuple[str, str]:
    """Return the edit of the unit of der(u), the only variable in V/s that has no nominal value."""
    more = (' intermediateUpdate="true"' if fmi == 3 else "") + ' derivative="2"'
    return f'unit="V/s"{more}', f'unit="{unit}"{more}'


#: By name: old and new text for a version of FMI, the rows, and a part of what one of them says.
Faults = dict[str, tuple[Callable[[int], tuple[str, str]], set[str], str]]
DESCRIPTIONS: Faults = {
    "wrong token": (
        lambda v: ('guid="{', 'guid="{0') if v == 2 else ('Token="{', 'Token="{0'),
        {"co-simulation instantiates", "model exchange instantiates"},
        "not of the same export",
    ),
    "unit without a definition": (
        lambda _: ('<Unit name="N/V">', '<Unit name="N.V">'),
        {"description valid", "units defined", "units consistent"},
        "'k_L' has the unit 'N/V', which is not defined",
    ),
    "variable without a unit": (
        lambda _: (' unit="N.s/m" min', " min"),
        {"units defined"},
        "has the unit 'None'",
    ),
    "wrong unit of a derivative": (
        lambda v: _of_state(v, "V"), {"units consistent"}, "'der(u)' is in 'V', but 'u' is in 'V'",
    ),
    "wrong definition of a unit": (
        lambda _: ('<BaseUnit kg="-1" m="-2" s="4" A="2"', '<BaseUnit kg="-1" m="-2" s="3" A="2"'),
        {"units consistent"},
        "the unit 'F' is defined as",
    ),
    "wrong factor of a display unit": (
        lambda _: ('name="um" factor="1000000.0"', 'name="um" factor="1000.0"'),
        {"units consistent"},
        "the display unit 'um' has the factor 1000",
    ),
    "missing dependency": (
        lambda v: _dependency("charge", ("u C_p", "tunable dependent"), ("u", "tunable"), v),
        {"dependencies complete", "dependencies of the model"},
        "'charge' depends on 'C_p', which its dependencies do not list",
    ),
    "superfluous dependency": (
        lambda v: _dependency(
            "displacement", ("x", "constant"), ("x v_x", "constant constant"), v),
        {"dependencies of the model"},
        "'displacement' does not depend on 'v_x', which its dependencies list",
    ),
    "wrong kind of a dependency": (
        lambda v: _dependency(
            "charge", ("u C_p", "tunable dependent"), ("u C_p", "constant dependent"), v),
        {"dependencies of the model"},
        "'charge' depends on 'u' in the way 'tunable', not 'constant'",
    ),
    "wrong start value": (
        lambda _: ('start="0.0001"', 'start="0.0002"'),
        {"start values"},
        "'tau' starts at 0.0002, the model has 0.0001",
    ),
    "nominal value of zero": (
        lambda _: ('nominal="65.7"', 'nominal="0.0"'),
        {"nominal values", "model exchange"},  # a tolerance of zero for a state at zero
        "'f_H' has the nominal value 0",
    ),
    "wrong nominal value": (
        lambda _: ('nominal="65.7"', 'nominal="66.0"'),
        {"nominal values"},
        "'f_H' has another nominal value in the binary",
    ),
    "wrong number of event indicators": (
        lambda v: (
            ('EventIndicators="1"', 'EventIndicators="2"') if v == 2
            else (f"<EventIndicator {_unknown(3, SWITCH, *KNOWNS, kinds=KINDS)} />", "")),
        {"event indicators"},
        "event indicators are announced",
    ),
}  # fmt: skip
