"""What results say: a code with its figures and names. The sentence is made where reports are."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from psa_casadi.common.display import made


@dataclass(frozen=True)
class Note:
    """Something to say: its code, and the values that its sentence takes by name.

    A value is a number, a text, a quantity `(value, unit)`, a tuple of names, or a note.
    `str(note)` is the sentence.
    """

    code: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return str(made("note_text", self))


def note(code: str, **values: Any) -> Note:
    """Return something to say, with the values that its sentence takes."""
    return Note(code, values)


def texts(notes: tuple[Note | str, ...]) -> tuple[str, ...]:
    """Return the sentences of notes; what is a sentence already stays."""
    return tuple(map(str, notes))
