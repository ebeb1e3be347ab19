"""JSON that people give: read as it was written, or refused in sentences that name the place."""

import json
import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import psa_casadi as psa
from psa_casadi.common.strict_json import MOST_BYTES, json_text, parse_json, read_json
from psa_casadi.model.evidence import Evidence
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.variables import Interval, Provenance
from tests.model.evidence_models import evident_model
from tests.mutations import sentences
from tests.studies.fuzz.damage import damaged_bytes

MODEL = psa.stack_model("demo")


def _short() -> Evidence | None:
    """Return evidence whose reference run has three samples, one of them not measured."""
    evidence = evident_model().evidence
    if evidence is None or evidence.reference is None:
        return evidence
    reference = replace(
        evidence.reference,
        time=evidence.reference.time[:3],
        inputs={n: c[:3] for n, c in evidence.reference.inputs.items()},
        displacement=(None, *evidence.reference.displacement[1:3]),
    )
    return replace(evidence, reference=reference)


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
    problems = sentences(lambda: loads(text, "m.json"))
    if problems:
        assert len(problems) <= 21
        assert all(p.startswith(("m.json", "... and")) and len(p) < 2000 for p in problems)
        return True
    model = loads(text)
    written = dumps(model)
    again = loads(written)
    assert dumps(again) == written
    assert again.provenance == model.provenance
    assert again.evidence == model.evidence
    assert dict(again.values) == dict(model.values)
    assert again.changed_starts() == model.changed_starts()
    return False


def test_a_whole_file_comes_back() -> None:
    publication = psa.Publication("A. Author", "1.2", "(c) 2026 A. Author & sons", "CC-BY-4.0")
    text = dumps(replace(SAVED, publication=publication))
    assert dumps(loads(text)) == text


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
    for _ in range(700):
        same_or_refused(damaged_bytes(TEXT.encode(), draw).decode(errors="replace"))


def edited(change: Callable[[dict[str, Any]], object]) -> str:
    content = json.loads(TEXT)
    change(content)
    return json.dumps(content)


def refused(change: Callable[[dict[str, Any]], object]) -> str:
    """Return the problems of a changed file, each of which starts with its name."""
    problems = sentences(lambda: loads(edited(change), "m.json"))
    assert all(line.startswith("m.json") for line in problems)
    return "\n".join(problems)


GONE = object()
#: The problem of a file in which a value at a place is another one, or is gone.
NAMED: dict[str, tuple[str, Any]] = {
    "'components' is missing; give a list": ("components", GONE),
    "unknown name 'slow_creep' in components": ("components.+", "slow_creep"),
    "'components[5]' is {'name': 'warp'}; give a text": ("components.5", {"name": "warp"}),
    "'effects[0]' is [1]; give a text or names with": ("effects.+", [1]),
    "'effects[0].module' is missing": ("effects.+", {"name": "a", "sha256": "0"}),
    "'drive' is listed 10001 times": ("components", ["drive"] * 10_001),
    "'linear_force' is listed 2 times": ("components.+", "linear_force"),
    "'parameters' is missing; give names with values": ("parameters", GONE),
    "'parameters.m_P.value' is True": ("parameters.m_P.value", True),
    "unknown parameters ['warp']": ("parameters.warp", {"value": 1}),
    "'parameters.n.interval' is [1]; give [low, high] or null": ("parameters.n.interval", [1]),
    "'identified_from[0].sha256' is missing": ("identified_from", [{"record": "a"}]),
    "'notes' is 'one'; give a list": ("notes", "one"),
    "'publication.author' is 3; give a text": ("publication", {"author": 3}),
    "the character U+000B": ("description", "a\x0bb"),
    "the character U+0000": ("parameters.a\0", {"value": 1}),
    "Infinity is no number of JSON": ("parameters.n.value", float("inf")),
    "'evidence.seen' is missing": ("evidence.seen", GONE),
    "'evidence.fitted_m' is 'x'; give a number": ("evidence.fitted_m", "x"),
    "an error, a rate or a duration below 0": ("evidence.fitted_m", -1.0),
    "'evidence.seen.voltage' is [2.0, 1.0]; give [low": ("evidence.seen.voltage", [2, 1]),
    "'evidence.runs[0].samples' is 2.5; give a whole": ("evidence.runs.0.samples", 2.5),
    "held-out stretches that follow each other": ("evidence.runs.0.held_out", [[5, 9], [8, 12]]),
    "held-out error and held-out samples": ("evidence.runs.0.held_out", []),
    "have samples, each of at least one": ("evidence.runs.0.averaged", 0),
    "parameters, none twice; not ['warp']": ("evidence.covariance.names", ["k_L", "A", "warp"]),
    "a row and a column for each name": ("evidence.covariance.matrix.2", GONE),
    "must be symmetric": ("evidence.covariance.matrix.0.1", 7.0),
    "two or more increasing times": ("evidence.reference.time", [0.0]),
    "a value of each column for each time": ("evidence.reference.inputs", {}),
    "which is not among the runs": ("evidence.reference.record", "other"),
    "'evidence.reference.displacement' is 3; give a list": ("evidence.reference.displacement", 3),
}


def put(content: Any, place: str, value: Any) -> None:
    """Put a value in a place of a file; "+" appends it to a list."""
    *way, last = (int(k) if k.isdecimal() else k for k in place.split("."))
    for key in way:
        content = content[key]
    if value is GONE:
        del content[last]
    elif last == "+":
        content.append(value)
    else:
        content[last] = value


@pytest.mark.parametrize("expected", NAMED)
def test_a_mistake_is_named(expected: str) -> None:
    assert expected in refused(lambda content: put(content, *NAMED[expected]))


def test_what_the_other_components_need_is_named() -> None:
    def spoil(content: dict[str, Any]) -> None:
        content["components"].remove("drive")
        for name in ("G", "R_s", "C_p", "u_rated"):
            del content["parameters"][name]

    assert "'u'" in refused(spoil)


def test_a_name_twice_is_no_choice_of_the_last() -> None:
    text = TEXT.replace('"k_L": {', '"k_L": {"value": 1e-3, "unit": "N/V"},\n    "k_L": {', 1)
    (problem,) = sentences(lambda: loads(text))
    assert "the name 'k_L' occurs twice in one object" in problem


def test_many_mistakes_are_listed_up_to_twenty() -> None:
    for text in (
        edited(lambda c: c["parameters"].update({f"p{k}": {"interval": 1} for k in range(500)})),
        edited(lambda c: c.update(starts={f"x{k}": 1.0 for k in range(500)})),
    ):
        problems = sentences(lambda t=text: loads(t))  # type: ignore[misc]
        assert len(problems) == 21
        assert problems[-1].startswith("... and ")


UNWRITABLE: dict[str, Callable[[psa.Model], psa.Model]] = {
    "U+0000": lambda m: replace(m, description="a\0b"),
    "U+D800": lambda m: replace(m, name="\ud800"),
    "U+001B": lambda m: replace(m, provenance=replace(m.provenance, notes=("\x1b[2J",))),
    "not JSON compliant": lambda m: replace(
        m, provenance=replace(m.provenance, intervals={"n": Interval(0.0, float("inf"))})
    ),
}


@pytest.mark.parametrize("expected", UNWRITABLE)
def test_a_model_that_could_not_be_read_again_is_not_saved(expected: str) -> None:
    with pytest.raises(psa.InputError, match=r"cannot be saved as MODEL\.json") as caught:
        dumps(UNWRITABLE[expected](SAVED))
    assert expected in str(caught.value)


def test_an_integer_of_thirty_digits_is_a_number() -> None:
    """It fits a double, and no machine's integer."""
    content = json.loads(TEXT)
    content["starts"] = {MODEL.state_names[0]: 10**30}
    assert loads(json.dumps(content)).changed_starts() == {MODEL.state_names[0]: 1e30}


REFUSED = {
    "": "Expecting value",
    "{": "line 1 column 2",
    "[1, NaN]": "NaN is no number of JSON",
    "[-1E400]": "the number '-1E400' is too large",
    "[" * 100_000: "its lists nest too deep",
    '{"a":' * 100_000: "its lists nest too deep",
    r'["a\u0000"]': r"the text 'a\x00' has the character U+0000",
    r'"\ud800"': r"the text '\ud800' has the character U+D800",
    '"\x00"': "Invalid control character",
    '"\ufdd0" x': "Extra data",
}


@pytest.mark.parametrize("text", REFUSED, ids=range(len(REFUSED)))
def test_what_is_no_json_is_refused_in_one_short_sentence(text: str) -> None:
    (problem,) = sentences(lambda: parse_json(text, "a.json", "give another file."))
    assert problem.startswith("a.json is not JSON that can be used (")
    assert problem.endswith("); give another file.")
    assert REFUSED[text] in problem
    assert len(problem) < 250


def test_what_can_be_used_is_read_as_it_was_written() -> None:
    contents: tuple[Any, ...] = (
        {"a": [1, -0.0, 5e-324, 1.7976931348623157e308, 10**308, None, True, "é\n\t\U0001f600"]},
        [[[{"[{": []}]]],
    )
    for content in contents:
        text = json_text(content)
        assert parse_json(text, "a.json", "") == content
        assert json_text(parse_json(text, "a.json", "")) == text


def test_a_file_is_utf_8_and_of_limited_size(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes("\ufeff[1]".encode())
    assert read_json(path, "") == [1]
    path.write_bytes(b'["\xff"]')
    assert "is no text in UTF-8" in sentences(lambda: read_json(path, ""))[0]
    with path.open("wb") as stream:
        stream.truncate(MOST_BYTES + 1)
    assert "more than 16 MiB" in sentences(lambda: read_json(path, ""))[0]
