import re

import pytest

from psa_casadi.effects import EFFECTS
from psa_casadi.model.stacks import STACKS
from tests.export.modelica_runs import (
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
