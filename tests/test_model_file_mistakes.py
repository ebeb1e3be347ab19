"""MODEL.json with mistakes of every kind: told in sentences, or the same model again."""

import json
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import Evidence
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.stacks import stack_model
from psa_casadi.variables import Interval, Provenance
from tests.evidence_models import evident_model
from tests.mutations import changed, sentences

MODEL = stack_model("demo")


def _short() -> Evidence | None:
    """Return evidence whose reference run has three samples, one of them not measured."""
    told = evident_model().evidence
    if told is None or told.reference is None:
        return told
    reference = replace(
        told.reference,
        time=told.reference.time[:3],
        inputs={n: c[:3] for n, c in told.reference.inputs.items()},
        displacement=(None, *told.reference.displacement[1:3]),
    )
    return replace(told, reference=reference)


SAVED = replace(
    MODEL,
    evidence=_short(),
    provenance=Provenance(
        identified_from=(("rig", "0" * 64),),
        free=("k_L", "tau"),
        intervals={"k_L": Interval(1.0, 2.0), "n": Interval(-1e-300, 5e-324)},
        notes=("a note",),
    ),
).with_starts({MODEL.state_names[0]: 1e-6})
TEXT = dumps(SAVED)
VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 2, -0.0, 1e308, 10**308, 5e-324, 2**63, [], {}, [2, 1], [1, 2], [[]], "",
    {"name": "drive"}, {"name": ["x"]}, {"name": "slow_creep", "module": "m", "sha256": "0"},
    "drive", "slow_creep", [0, 0], [None, None], [True, False], "x" * 5000, [10**308, 10**308],
    "\x00", "\ud800", "\ufffe", "a\x0bb", float("nan"), float("inf"), [0, float("inf")],
)  # fmt: skip
PIECES = ("1e999", "NaN", "-Infinity", "9" * 5000, "[" * 3000, r'"\u0000"', '{"a":1,"a":2}', "-0")


def same_or_refused(text: str) -> bool:
    """Whether a text is refused as it should be; what is not must come back from a new file."""
    said = sentences(lambda: loads(text, "m.json"))
    if said:
        assert len(said) <= 21
        assert all(p.startswith(("m.json", "... and")) and len(p) < 2000 for p in said)
        return True
    model = loads(text)
    written = dumps(model)
    again = loads(written)
    assert dumps(again) == written
    assert again.provenance == model.provenance
    assert again.evidence == model.evidence
    assert dict(again.values) == dict(model.values)
    assert again.own_starts() == model.own_starts()
    return False


def _places(content: Any) -> Iterator[tuple[Any, Any]]:
    keys = content if isinstance(content, dict) else range(len(content))
    for key in keys:
        yield content, key
        if isinstance(content[key], dict | list):
            yield from _places(content[key])


def test_values_of_every_kind_in_every_place_are_refused_or_kept() -> None:
    draw = random.Random(5)
    count = len(list(_places(json.loads(TEXT))))
    refused = 0
    for place in range(count):
        for value in draw.sample(VALUES, 4):
            content = json.loads(TEXT)
            parent, key = list(_places(content))[place]
            parent[key] = value
            refused += same_or_refused(json.dumps(content))
    assert 0.5 * 4 * count < refused < 4 * count


def test_wrong_text_in_any_place_is_refused_or_kept() -> None:
    draw = random.Random(6)
    for _ in range(300):
        at = draw.randrange(len(TEXT))
        same_or_refused(TEXT[:at] + draw.choice(PIECES) + TEXT[at + draw.choice((0, 1, 5)) :])
    for wrong in changed(TEXT.encode(), 700, seed=7):
        same_or_refused(wrong.decode(errors="replace"))


def edited(change: Callable[[dict[str, Any]], object]) -> str:
    content = json.loads(TEXT)
    change(content)
    return json.dumps(content)


NAMED: dict[str, Callable[[dict[str, Any]], object]] = {
    "the interval of 'n' is [2, 1]; give [low, high]": lambda c: c["parameters"]["n"].update(
        interval=[2, 1]
    ),
    "'free' of 'n' is 'no'; give true or false": lambda c: c["parameters"]["n"].update(free="no"),
    "unknown name {'name': 'warp'} in components": lambda c: c["components"].append(
        {"name": "warp"}
    ),
    "the character U+000B": lambda c: c.update(description="a\x0bb"),
    "the character U+0000": lambda c: c["parameters"].update({"a\0": {"value": 1}}),
    "Infinity is no number of JSON": lambda c: c["parameters"]["n"].update(
        interval=[0, float("inf")]
    ),
}


@pytest.mark.parametrize("expected", NAMED)
def test_a_mistake_is_named(expected: str) -> None:
    assert expected in "\n".join(sentences(lambda: loads(edited(NAMED[expected]))))


def test_a_name_twice_is_no_choice_of_the_last() -> None:
    text = TEXT.replace('"k_L": {', '"k_L": {"value": 1e-3, "unit": "N/V"},\n    "k_L": {', 1)
    (problem,) = sentences(lambda: loads(text))
    assert "the name 'k_L' stands twice in one object" in problem


def test_many_mistakes_are_listed_up_to_twenty() -> None:
    for text in (
        edited(lambda c: c["parameters"].update({f"p{k}": {"interval": 1} for k in range(500)})),
        edited(lambda c: c.update(starts={f"x{k}": 1.0 for k in range(500)})),
    ):
        problems = sentences(lambda t=text: loads(t))  # type: ignore[misc]
        assert len(problems) == 21
        assert problems[-1].startswith("... and 48")
    text = edited(lambda c: c.update(components=["drive"] * 10_000))
    (problem,) = sentences(lambda: loads(text))
    assert "'components' lists 10000 names, but there are only" in problem


UNWRITABLE: dict[str, Callable[[Model], Model]] = {
    "U+0000": lambda m: replace(m, description="a\0b"),
    "U+D800": lambda m: replace(m, name="\ud800"),
    "U+001B": lambda m: replace(m, provenance=replace(m.provenance, notes=("\x1b[2J",))),
    "not JSON compliant": lambda m: replace(
        m, provenance=replace(m.provenance, intervals={"n": Interval(0.0, float("inf"))})
    ),
}


@pytest.mark.parametrize("expected", UNWRITABLE)
def test_a_model_that_could_not_be_read_again_is_not_saved(expected: str) -> None:
    with pytest.raises(InputError, match=r"cannot be saved as MODEL\.json") as caught:
        dumps(UNWRITABLE[expected](SAVED))
    assert expected in str(caught.value)


def test_an_integer_of_thirty_digits_is_a_number() -> None:
    """It fits a double, and no machine's integer."""
    content = json.loads(TEXT)
    content["starts"] = {MODEL.state_names[0]: 10**30}
    assert loads(json.dumps(content)).own_starts() == {MODEL.state_names[0]: 1e30}
