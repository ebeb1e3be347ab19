"""What exact steps take a model apart into: found from its equations alone, for every model."""

from collections.abc import Sequence

import casadi as ca
import pytest

from psa_casadi.component import Component, Equations
from psa_casadi.components import BASE, SIMPLIFIED
from psa_casadi.effects import EFFECTS
from psa_casadi.examples.van_der_pol import model as van_der_pol
from psa_casadi.model.compose import compose
from psa_casadi.model.structure import structure_of
from psa_casadi.simulation.exact.run import why_not
from psa_casadi.simulation.exact.split import Split, split_of
from tests.exact_cases import BEAT, CUBIC, FEEDBACK, JUMP, KINK, LAG, OUTPUT
from tests.sampled_models import loop

#: Effects that need not split; the issue allows some, today there is none.
ALLOWED = 3

#: Force that the hysteresis softens: what it multiplies lies in a loop.
SOFTER = Component(
    name="softer",
    description="a spring that the hysteresis softens",
    source="test",
    equations=lambda s: Equations(add={"tip_force": -1e3 * s.f_H * s.x}),
)


def parts(components: Sequence[Component]) -> Split:
    found = split_of(structure_of(tuple(components)))
    assert isinstance(found, Split), found
    return found


def names(split: Split, indices: Sequence[int]) -> list[str]:
    return [split.structure.states[i].name for i in indices]


def groups(split: Split) -> dict[str, list[str]]:
    """Return the states along each driver, by names."""
    return {names(split, [g.driver])[0]: names(split, g.states) for g in split.groups}


def ports(split: Split) -> dict[str, tuple[bool, str]]:
    """Return each port's row with whether it feeds back, and its chord's driver."""
    return {
        names(split, [p.state])[0]: (
            p.feedback,
            names(split, [p.chord])[0] if p.chord >= 0 else "",
        )
        for p in split.ports
    }


@pytest.mark.parametrize("base", [BASE, SIMPLIFIED], ids=["cascade", "single mass"])
def test_nearly_every_effect_splits(base: tuple[Component, ...]) -> None:
    parts(base)
    present = {c.name for c in base}
    whole = [e for e in EFFECTS.values() if set(e.needs) <= present]
    found = {e.name: split_of(structure_of((*base, e))) for e in whole}
    not_split = {name: split for name, split in found.items() if isinstance(split, str)}
    assert len(not_split) <= ALLOWED, not_split
    assert len(whole) >= len(EFFECTS) - 1
    for split in found.values():
        if isinstance(split, Split):
            every = sorted((*split.linear, *split.along))
            assert every == list(range(len(split.structure.states)))


def test_all_effects_at_once_split() -> None:
    split = parts((*BASE, *EFFECTS.values()))
    assert set(groups(split)) == {"u", "x"}
    assert [kind for kind, _ in split.order].count("loop") == 2


def test_the_base_is_a_linear_part_and_hysteresis_along_the_voltage() -> None:
    split = parts(BASE)
    assert names(split, split.linear) == ["u", "f_out", "y", "v_y", "x", "v_x"]
    assert groups(split) == {"u": ["f_H"]}
    assert ports(split) == {"f_out": (False, "u")}
    assert split.order == (("group", (0,)), ("port", (0,)))


@pytest.mark.parametrize(
    ("effect", "along", "port"),
    [
        ("hysteresis_memory", {"u": ["f_H", "z_m1", "z_m2", "z_m3", "z_m4"]}, {}),
        ("self_heating", {"u": ["f_H", "heat"]}, {}),
        ("ageing", {"u": ["f_H", "travel"]}, {}),
        ("backlash", {"u": ["f_H"], "x": ["z_b"]}, {}),
        ("load_stiffness", {"u": ["f_H"]}, {"v_x": (True, "")}),
        ("preload_loss", {"u": ["f_H"]}, {"v_x": (True, "")}),
        ("current_limit", {"u": ["f_H"]}, {"u": (True, "")}),
        ("voltage_saturation", {"u": ["f_H"]}, {"u": (False, "")}),
        ("structural_mode", {"u": ["f_H"]}, {}),
        ("sensor_nonlinearity", {"u": ["f_H"]}, {}),
    ],
)
def test_groups_and_ports_of_an_effect(
    effect: str, along: dict[str, list[str]], port: dict[str, tuple[bool, str]]
) -> None:
    split = parts((*BASE, EFFECTS[effect]))
    assert groups(split) == along
    assert ports(split) == {"f_out": (False, "u"), **port}
    assert {kind for kind, _ in split.order} == (
        {"group", "port", "loop"} if any(f for f, _ in port.values()) else {"group", "port"}
    )


def test_what_feeds_comes_before_what_it_feeds() -> None:
    def order(effect: str) -> list[tuple[str, list[str]]]:
        split = parts((*BASE, EFFECTS[effect]))
        rows = {"group": [g.driver for g in split.groups]}
        rows |= {kind: [p.state for p in split.ports] for kind in ("port", "loop")}
        return [(k, names(split, [rows[k][m] for m in ms])) for k, ms in split.order]

    hysteresis = [("group", ["u"]), ("port", ["f_out"])]
    assert order("voltage_saturation") == [("port", ["u"]), *hysteresis]
    assert order("current_limit") == [("loop", ["u"]), *hysteresis]
    assert order("load_stiffness") == [*hysteresis, ("loop", ["v_x"])]
    assert order("backlash") == [*hysteresis, ("group", ["x"])]


def test_a_component_of_one_s_own_splits_like_any_other() -> None:
    lag = parts((*BASE, LAG))
    assert "f_2" in names(lag, lag.linear)
    assert ports(lag) == {"f_out": (False, "u")}
    spring = parts((*BASE, CUBIC))
    assert ports(spring) == {"f_out": (False, "u"), "v_x": (True, "")}
    assert ("loop", (1,)) in spring.order


def test_any_ode_may_split() -> None:
    """Van der Pol's damping is a loop on a linear oscillator; it just shows no displacement."""
    oscillator = van_der_pol().structure
    split = split_of(oscillator)
    assert isinstance(split, Split)
    assert (names(split, split.linear), ports(split)) == (["x", "v"], {"v": (True, "")})
    assert why_not(oscillator, OUTPUT) == f"it has no output {OUTPUT}"


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
    with pytest.raises(AssertionError, match=reason):
        parts((*BASE, component))
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


def test_a_force_in_time_alone_is_a_port_without_feedback() -> None:
    """Or it is refused: its values at start, quarter, half and end may tell nothing of it."""
    found = split_of(structure_of((*BASE, BEAT)))
    assert isinstance(found, str) or ports(found)["v_x"][0] is False
