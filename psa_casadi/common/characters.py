"""The characters that texts may have: in the files that are written, and on a terminal."""

import re

from psa_casadi.common.errors import InputError

#: XML 1.0, section 2.2; HTML, JSON as UTF-8 and Modelica carry all of these too.
_BARRED = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

#: What a terminal obeys instead of showing it: control characters but tab and line end, and those
#: that turn the direction of writing.
_OBEYED = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def barred(text: str) -> str:
    """Return the first character that no document can carry, as in "U+0000"; else nothing."""
    match = _BARRED.search(text)
    return f"U+{ord(match[0]):04X}" if match else ""


def check_text(text: str, what: str) -> None:
    """Refuse a text with a character that no document can carry; `what` starts the sentence.

    Raises:
        InputError: there is one; the sentence names it and quotes the text before it.
    """
    if match := _BARRED.search(text):
        before = " ".join(text[max(0, match.start() - 40) : match.start()].split())
        raise InputError(
            f"{what} has the character {barred(match[0])} after '{before}', which no document can"
            " carry; remove it from the names, descriptions and notes of the model."
        )


def plain(text: str) -> str:
    """Return a text with a replacement character for each that no document can carry."""
    return _BARRED.sub("\ufffd", text)


def visible(text: str) -> str:
    """Return a text as a terminal may show it: what it would obey is spelled out as an escape."""
    return _OBEYED.sub(lambda match: match[0].encode("unicode_escape").decode(), text)
