"""Every code that a result says has a sentence, and the sentence takes the values that it gets."""

import ast
from inspect import signature
from pathlib import Path
from string import Formatter

import pytest

import psa_casadi
from psa_casadi.notes import note
from psa_casadi.report.words.notes import SENTENCES


def _said() -> list[tuple[str, set[str]]]:
    """Return the code and the names of the values of every note in the package."""
    found = []
    for path in Path(psa_casadi.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "note":
                names = {k.arg for k in node.keywords if k.arg}
                codes = [c for c in ast.walk(node.args[0]) if isinstance(c, ast.Constant)]
                found += [(c.value, names) for c in codes if isinstance(c.value, str)]
    return found


def test_every_note_has_a_sentence_that_takes_its_values() -> None:
    said = _said()
    assert len(said) > 40
    for code, names in said:
        sentence = SENTENCES[code]
        if isinstance(sentence, str):
            asked = {field for _, field, _, _ in Formatter().parse(sentence) if field}
            assert asked <= names, code
        else:
            assert set(signature(sentence).parameters) == names, code


def test_values_have_their_units_and_names_stand_in_a_row() -> None:
    assert str(note("noise_repeats", apart=(0.02, "s"))).endswith("returns after 20 ms")
    assert str(note("little", least=0.7)) == "that is less than 70 % and much remains"
    said = str(note("vague", names=("a", "b"), why=note("no_such_voltage")))
    assert said.startswith("a, b: in the extended model and not named: no stack bears")
    assert str(note("same_curve", effects=("a", "b", "c"))).startswith("a and b and c bend")


def test_a_code_without_a_sentence_is_an_error() -> None:
    with pytest.raises(KeyError):
        str(note("nothing of the kind"))
