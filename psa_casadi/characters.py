"""The characters that names and texts of a model may have, in whatever file they are written."""

import re

from psa_casadi.errors import InputError

#: XML 1.0, section 2.2; HTML, JSON as UTF-8 and Modelica carry all of these too.
_BARRED = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def barred(text: str) -> str:
    """Return the first character that no document can carry, as in "U+0000"; else nothing."""
    found = _BARRED.search(text)
    return f"U+{ord(found[0]):04X}" if found else ""


def check_text(text: str, what: str) -> None:
    """Refuse a text with a character that no document can carry; `what` begins the sentence.

    Raises:
        InputError: there is one; the sentence names it and shows what stands before it.
    """
    if found := _BARRED.search(text):
        before = " ".join(text[max(0, found.start() - 40) : found.start()].split())
        raise InputError(
            f"{what} has the character {barred(found[0])} after '{before}', which no document can"
            " carry; remove it from the names, descriptions and notes of the model."
        )


def plain(text: str) -> str:
    """Return a text with a replacement character for each that no document can carry."""
    return _BARRED.sub("\ufffd", text)
