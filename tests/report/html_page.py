"""Contents of an HTML page of a report: text, external resources, figures."""

import base64
import gzip
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np

import psa_casadi as psa

_ARRAYS = re.compile(r'<script type="application/gzip" id="arrays">(.*?)</script>')
_SCRIPT = re.compile(r'<script type="application/json">(.*?)</script>', re.DOTALL)
_DTYPES = {"f4": np.float32, "f8": np.float64, "i1": np.int8, "i2": np.int16, "i4": np.int32}


class Page(HTMLParser):
    """Resources that a page loads, its inner links and their ends, its text without scripts."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.targets: set[str] = set()
        self.names: set[str] = set()
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._open.append(tag)
        table = {k: v or "" for k, v in attrs}
        self.names.add(table.get("id", ""))
        links = [v for k, v in table.items() if k in ("src", "href", "srcset", "data")]
        self.targets |= {link[1:] for link in links if link.startswith("#")}
        self.loaded += [link for link in links if not link.startswith(("#", "data:image/png;"))]

    def handle_endtag(self, tag: str) -> None:
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if not {"script", "style"} & set(self._open):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def read_page(path: Path) -> tuple[str, Page]:
    """Return the text and the contents of a page, which must load no external resource."""
    text = path.read_text("utf-8")
    page = Page(text)
    assert page.loaded == []
    return text, page


def figures(page: str) -> list[dict[str, Any]]:
    """Return the plotly figures of a page in their order."""
    holder = _ARRAYS.search(page)
    arrays = gzip.decompress(base64.b64decode(holder[1])).decode().split(" ") if holder else []

    def resolved(part: dict[str, Any]) -> dict[str, Any]:
        return {k: arrays[v] if k == "bdata" and isinstance(v, int) else v for k, v in part.items()}

    return [json.loads(text, object_hook=resolved) for text in _SCRIPT.findall(page)]


def numbers(values: Any) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the numbers of a trace, which plotly may have written in base64."""
    if isinstance(values, dict):
        data = base64.b64decode(values["bdata"])
        return np.frombuffer(data, _DTYPES[values["dtype"]]).astype(np.float64)
    return np.array([np.nan if v is None else v for v in values], dtype=np.float64)


def written(result: Any, folder: Path, **how: Any) -> tuple[str, Page]:
    """Return the page of a result without a live model, and its contents."""
    write = psa.write_fit_report if isinstance(result, psa.Identification) else psa.write_report
    write(result, folder / "page.html", still=True, **how)
    return read_page(folder / "page.html")
