"""The sentences of notes: what each code says, with the note's values in its places."""

from collections.abc import Callable, Mapping
from string import Formatter
from typing import Any

from psa_casadi.notes import Note
from psa_casadi.report.words.diagnosis_notes import DIAGNOSIS
from psa_casadi.report.words.misfit_words import ENDINGS, MISFIT
from psa_casadi.report.words.own_notes import OWN_MODELS
from psa_casadi.report.words.phrases import quantity, with_unit

#: A code's sentence: a template with the values' names, or what makes it of the values.
Sentence = str | Callable[..., str]
SENTENCES: Mapping[str, Sentence] = {**DIAGNOSIS, **MISFIT, **OWN_MODELS}


class _Words(Formatter):
    """Formats quantities `(value, unit)` with their units, and names in a row.

    What follows the colon is a number's format, ".0p" that of a percentage without its sign, or
    what stands between names, ", " by default.
    """

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, tuple):
            if len(value) == 2 and isinstance(value[0], float) and isinstance(value[1], str):
                if format_spec:
                    return with_unit(format(value[0], format_spec), value[1])
                return quantity(*value)
            return (format_spec or ", ").join(map(str, value))
        if format_spec.endswith("p"):
            return format(100.0 * value, f"{format_spec[:-1]}f")
        return format(str(value) if isinstance(value, Note) else value, format_spec)


_WORDS = _Words()


def note_text(said: Note) -> str:
    """Return the sentence of a note; within a page its lengths are in the page's unit."""
    return _head(said) + (ENDINGS[said.code](said.values["share"]) if said.code in ENDINGS else "")


def brief_text(said: Note) -> str:
    """Return the sentence of a finding in a residual, with the share it explains in brackets."""
    if said.code not in ENDINGS:
        return note_text(said)
    return f"{_head(said)} ({100.0 * said.values['share']:.0f} % of the excess)."


def _head(said: Note) -> str:
    sentence = SENTENCES[said.code]
    if isinstance(sentence, str):
        return _WORDS.vformat(sentence, (), said.values)
    return sentence(**said.values)
