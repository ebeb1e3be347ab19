"""Texts of an export that are made from templates: C, Modelica, HTML."""

import textwrap
from collections.abc import Mapping
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

#: What a parser of XML would take for a space in an attribute.
_LINE_ENDS = {ord(c): f"&#{ord(c)};" for c in "\t\n\r"}


def filled(template: str, **values: object) -> str:
    """Return a template of the folder `templates` with its values, escaped in HTML and XML."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("psa_casadi.export"),
        undefined=StrictUndefined,
        autoescape=lambda name: name is not None and name.endswith((".html", ".ssd", ".xml")),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "wrapped": _wrapped, "comment": _comment, "words": comment_text, "stated": _stated,
        "joined": _joined,
    }  # fmt: skip
    return environment


def _stated(attributes: Mapping[str, str | None]) -> Markup:
    """Return the attributes of an element of XML that have a value, with their line ends."""
    texts = ((name, escape(text)) for name, text in attributes.items() if text is not None)
    return Markup("".join(f' {name}="{text.translate(_LINE_ENDS)}"' for name, text in texts))


def _wrapped(text: str, indent: str = "") -> str:
    """Return a text in lines, the further ones indented."""
    lines = textwrap.wrap(text.strip("\n"), 96, subsequent_indent=indent, break_long_words=False)
    return "\n".join(lines)


def _joined(text: Markup) -> Markup:
    """Return a text of HTML on one line."""
    return Markup(" ").join(text.split())


def _comment(text: str) -> str:
    """Return lines as they stand in a comment of C."""
    lines = (comment_text(line, keep=True) for line in text.split("\n"))
    return "\n".join(f"   {line}".rstrip() for line in lines)


def comment_text(text: str, *, keep: bool = False) -> str:
    """Return text that may stand in a C comment, in ASCII; with `keep` its spaces stay."""
    kept = text if keep else " ".join(text.split())
    plain = kept.encode("ascii", "replace").decode("ascii")
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
