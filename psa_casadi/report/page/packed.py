"""What makes a page small: the plots' library and the numbers packed, each array there once."""

import base64
import gzip
import hashlib
import re
from dataclasses import dataclass
from functools import cache
from html import escape
from typing import Any

from plotly.offline import get_plotlyjs

from psa_casadi.characters import plain

#: Numbers of a plot as plotly writes them; shorter ones stay where they are.
_ARRAY = re.compile(r'"bdata":\s?"([^"]{200,})"')


@dataclass(frozen=True)
class Picture:
    """A plotly figure with its caption and, below it, what the reader must know to read it."""

    caption: str
    plot: Any
    note: str = ""


class Drawings:
    """The plots of a page. Curves over the same time share it: an array is in the page once."""

    def __init__(self) -> None:
        self._arrays: dict[str, int] = {}
        self._any = False

    def __bool__(self) -> bool:
        """Say whether there is any."""
        return self._any

    def figure(self, picture: Picture) -> str:
        """Return the place of a plot in the page, with what it shows."""
        self._any = True
        data = _ARRAY.sub(self._number, picture.plot.to_json())
        note = f'<p class="note">{words(picture.note)}</p>' if picture.note else ""
        caption = words(picture.caption)
        # "<" is escaped so that no text in a figure can end the script that holds it
        return (
            f'<figure class="drawn"><figcaption>{caption}</figcaption>'
            f'<script type="application/json">{data.replace("<", _ESCAPED)}</script>'
            f'<div class="drawing" role="img" aria-label="{caption}"></div>{note}</figure>'
        )

    def _number(self, found: re.Match[str]) -> str:
        array = found[1].replace("\\u002f", "/")  # as plotly writes it in JSON
        return f'"bdata":{self._arrays.setdefault(array, len(self._arrays))}'

    def shared(self) -> str:
        """Return what all plots take: the arrays, and the library that draws them."""
        arrays = packed(" ".join(self._arrays).encode())
        return _holder("arrays", arrays) + _holder("library", _library()[0])


_ESCAPED = "\\u003c"


def packed(content: bytes) -> str:
    """Return bytes as packed.js opens them: gzip in base64."""
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")


def library_hash() -> str:
    """Return what a content security policy calls the library of the plots."""
    return _library()[1]


def script_hash(text: bytes) -> str:
    """Return what a content security policy calls a script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text).digest()).decode('ascii')}'"


def words(text: str) -> str:
    """Return words as HTML can carry them; a percent sign stays with its number."""
    return escape(plain(text)).replace(" %", "\u00a0%")


@cache  # packing takes 0.3 s
def _library() -> tuple[str, str]:
    """Return the script that the installed plotly draws with, packed, and its hash."""
    data = get_plotlyjs().encode()
    return packed(data), script_hash(data)


def _holder(name: str, content: str) -> str:
    return f'<script type="application/gzip" id="{name}">{content}</script>'
