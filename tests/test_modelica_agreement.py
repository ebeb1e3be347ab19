import re

import pytest

from psa_casadi.effects import EFFECTS
from psa_casadi.model.stacks import STACKS
from tests.modelica_runs import (
    SPANS,
    model_named,
    right_side_error,
    signal_class,
    text_of,
    triangle_error,
)
from tests.tiers import slow_but

NAMES = [*STACKS, *EFFECTS, "every_effect"]


@pytest.mark.parametrize("name", slow_but([*list(STACKS)[:1], *EFFECTS], NAMES))
def test_right_hand_sides_read_back_are_the_models(name: str) -> None:
    assert right_side_error(model_named(name), text_of(name)) < 1e-12


@pytest.mark.parametrize("name", slow_but(["P-885.51", "slow_creep"], NAMES))
def test_trajectories_are_those_of_simulate(name: str) -> None:
    errors = triangle_error(model_named(name), text_of(name), SPANS.get(name, 0.02))
    assert max(errors.values()) < 1e-6, errors


def _changed(old: str, new: str, count: int = 0) -> str:
    """Return the package of P-885.51 with something else in the equations of `Signal`."""
    text = text_of("P-885.51")
    start = text.index("  equation\n")
    end = start + text[start:].index("annotation(")
    place = -1
    for _ in range(count + 1):
        place = text.index(old, max(place + 1, start))
    assert place < end
    return text[:place] + new + text[place + len(old) :]


def _signs() -> list[tuple[str, str, int]]:
    """Every plus and minus between two terms of the equations, turned into the other."""
    body = re.sub(r"//[^\n]*", "", signal_class(text_of("P-885.51")).split("  equation\n")[1])
    kept = body.replace(" + 1e-24", "")
    return [("+", "-", i) for i in range(kept.count(" + "))] + [
        ("-", "+", i) for i in range(len(re.findall(r"\s-\s", kept)))
    ]


@pytest.mark.parametrize(("old", "new", "count"), _signs())
def test_a_flipped_sign_is_caught(old: str, new: str, count: int) -> None:
    text = text_of("P-885.51")
    start = text.index("  equation\n")
    pattern = rf"(?<=\s){re.escape(old)}(?=\s(?!1e-24))"
    found = list(re.finditer(pattern, re.sub(r"//[^\n]*", lambda m: " " * len(m[0]), text[start:])))
    place = start + found[count].start()
    assert right_side_error(model_named("P-885.51"), text[:place] + new + text[place + 1 :]) > 1e-6


@pytest.mark.parametrize("parameter", ["k_P", "k_B", "k_L", "m_B", "c_P", "tau", "R_s", "beta"])
@pytest.mark.parametrize("factor", [0.999, 1.001])
def test_a_parameter_off_by_a_thousandth_is_caught(parameter: str, factor: float) -> None:
    model, text = model_named("P-885.51"), text_of("P-885.51")
    value = model.values[parameter]
    pattern = rf"(parameter Real {parameter}\([^)]*\)?[^)=]*\) = ){re.escape(repr(value))}"
    changed, count = re.subn(pattern, rf"\g<1>{value * factor!r}", text)
    assert count == 2  # in Signal and in Acausal
    assert right_side_error(model, changed) > 1e-5


@pytest.mark.parametrize("term", [" + f_H", " + delta*u*voltage_direction", " + tip_force",
                                  " + k_B*(x - y)", " - f_out", " - u", " + k_P*y"])  # fmt: skip
def test_a_dropped_term_is_caught(term: str) -> None:
    assert right_side_error(model_named("P-885.51"), _changed(term, "")) > 1e-5


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("k_P*y", "1.001*k_P*y"),
        ("k_B*(x - y)", "0.999*k_B*(x - y)"),
        ("k_L*u", "1.001*k_L*u"),
        (" + f_H", ""),
        (" + f_H", " - f_H"),
        (" - f_out", " - 1.001*f_out"),
        ("gamma*voltage_rate", "(-gamma)*voltage_rate"),
    ],
)
def test_a_trajectory_shows_a_mutation(old: str, new: str) -> None:
    errors = triangle_error(model_named("P-885.51"), _changed(old, new), 0.02)
    assert max(errors.values()) > 1e-4
