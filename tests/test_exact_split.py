"""What exact steps take a model apart into: found from its equations alone, for every model."""

import re

import casadi as ca
import pytest

from psa_casadi.component import Component, Equations
from psa_casadi.components import BASE, SIMPLIFIED
from psa_casadi.effects import EFFECTS
from psa_casadi.model.compose import compose
from psa_casadi.model.structure import structure_of
from psa_casadi.simulation.exact.run import why_not
from psa_casadi.simulation.exact.split import Split, split_of
from tests.exact_cases import FEEDBACK, JUMP, KINK, OUTPUT
from tests.sampled_models import loop

#: Force that the hysteresis softens: what it multiplies lies in a loop.
SOFTER = Component(
    name="softer",
    description="a spring that the hysteresis softens",
    source="test",
    equations=lambda s: Equations(add={"tip_force": -1e3 * s.f_H * s.x}),
)


@pytest.mark.parametrize("base", [BASE, SIMPLIFIED], ids=["cascade", "single mass"])
def test_every_effect_splits(base: tuple[Component, ...]) -> None:
    present = {c.name for c in base}
    whole = [e for e in EFFECTS.values() if set(e.needs) <= present]
    assert len(whole) >= len(EFFECTS) - 1
    for components in (base, *((*base, e) for e in whole), (*base, *whole)):
        split = split_of(structure_of(components))
        assert isinstance(split, Split), split
        assert sorted((*split.linear, *split.along)) == list(range(len(split.structure.states)))


@pytest.mark.parametrize(
    ("component", "reason"),
    [
        (KINK, r"kink of their own \(contact\)"),
        (FEEDBACK, r"kink of their own \(voltage_reversal\)"),  # u' is a driver's rate no more
        (SOFTER, "a hysteresis lies in a loop"),
        (JUMP, "jump"),  # its derivative is 0 wherever there is one
    ],
    ids=lambda c: getattr(c, "name", ""),
)
def test_what_does_not_split_says_why(component: Component, reason: str) -> None:
    structure = compose((*BASE, component)).structure
    found = split_of(structure)
    assert isinstance(found, str)
    assert re.search(reason, found)
    assert why_not(structure, OUTPUT) == found


def test_sampled_states_do_not_split() -> None:
    assert split_of(loop().structure) == "it has sampled states"


def test_a_function_that_the_c_code_does_not_have_is_told() -> None:
    """The text is printed only where there is no library yet, so that it fails there."""
    bent = Component(
        name="bent",
        description="a force by the inverse of a hyperbolic sine",
        source="test",
        equations=lambda s: Equations(add={"free_force": ca.asinh(s.u / 10.0)}),
    )
    reason = why_not(compose((*BASE, bent)).structure, OUTPUT)
    assert reason is not None
    assert reason.startswith("operation")
