"""JSON that people give: what cannot be written again the same is refused in one sentence."""

from pathlib import Path

import pytest

from psa_casadi.errors import InputError
from psa_casadi.strict_json import DEEPEST, MOST_BYTES, json_text, parse_json, read_json_text, shown

REFUSED = {
    "": "Expecting value",
    "{": "line 1 column 2",
    '{"a": 1, "b": {"c": 1, "d": 2, "c": 1}}': "the name 'c' stands twice in one object",
    "[1, NaN]": "NaN is no number of JSON",
    "-Infinity": "-Infinity is no number of JSON",
    "[1e999]": "the number '1e999' is too large",
    "[-1E400]": "the number '-1E400' is too large",
    "9" * 310: "the number '999999",
    "1" * 5000: "1... is too large",
    "[" * 100_000: f"line 1: lists and objects lie more than {DEEPEST} deep",
    '{"a":' * 100_000: f"lists and objects lie more than {DEEPEST} deep",
    '["[[[",\n' + "[" * (DEEPEST + 1): f"line 2: lists and objects lie more than {DEEPEST} deep",
    r'["a\u0000"]': r"the text 'a\x00' has the character U+0000",
    r'[{"\u000b": 1}]': r"the text '\x0b' has the character U+000B",
    r'"\ud800"': r"the text '\ud800' has the character U+D800",
    r'"\uffff"': "has the character U+FFFF",
    '"\x00"': "Invalid control character",
    '"\ufdd0" x': "Extra data",
}


@pytest.mark.parametrize("text", REFUSED, ids=range(len(REFUSED)))
def test_what_cannot_be_used_is_told_in_one_short_sentence(text: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_json(text, "a.json", "give another file.")
    (problem,) = caught.value.problems
    assert problem.startswith("a.json is not JSON that can be used (")
    assert problem.endswith("); give another file.")
    assert REFUSED[text] in problem
    assert len(problem) < 250


def test_what_can_be_used_is_read_as_it_was_written() -> None:
    deep: object = "[[[{{"
    for _ in range(DEEPEST // 2):
        deep = {r"a\"[[": [deep]}
    for content in (
        {"a": [1, -0.0, 5e-324, 1.7976931348623157e308, 10**308, None, True, "é\n\t\U0001f600"]},
        deep,
        [],
    ):
        text = json_text(content)
        assert parse_json(text, "a.json", "") == content
        assert json_text(parse_json(text, "a.json", "")) == text


@pytest.mark.parametrize("content", [float("nan"), [float("inf")], {"a": "\x00"}, {"\ud800": 1}])
def test_what_could_not_be_read_again_is_not_written(content: object) -> None:
    with pytest.raises(ValueError, match=r"not JSON compliant|has the character"):
        json_text(content)


def test_a_file_is_utf_8_and_of_limited_size(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes("\ufeff[1]".encode())
    assert parse_json(read_json_text(path), "a.json", "") == [1]
    path.write_bytes(b'["\xff"]')
    with pytest.raises(ValueError, match="utf-8"):
        read_json_text(path)
    with path.open("wb") as stream:
        stream.truncate(MOST_BYTES + 1)
    with pytest.raises(ValueError, match="more than 16 MiB"):
        read_json_text(path)


def test_a_long_value_is_cut_off_in_a_sentence() -> None:
    assert shown("a") == "'a'"
    assert len(shown("a" * 1000)) == 83
