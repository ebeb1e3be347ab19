"""Texts of an export that are made from templates: C, Modelica, HTML."""

import textwrap
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined


def filled(template: str, **given: object) -> str:
    """Return a template of the folder `templates` with its values; HTML has them escaped."""
    return _environment().get_template(template).render(given)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("psa_casadi.export"),
        undefined=StrictUndefined,
        autoescape=lambda name: name is not None and name.endswith(".html"),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"wrapped": _wrapped, "comment": _comment, "words": comment_text}
    return environment


def _wrapped(text: str, indent: str = "") -> str:
    """Return a text in lines, the further ones indented."""
    lines = textwrap.wrap(text.strip("\n"), 96, subsequent_indent=indent, break_long_words=False)
    return "\n".join(lines)


def _comment(text: str) -> str:
    """Return lines as they stand in a comment of C."""
    lines = (comment_text(line, keep=True) for line in text.split("\n"))
    return "\n".join(f"   {line}".rstrip() for line in lines)


def comment_text(text: str, *, keep: bool = False) -> str:
    """Return text that may stand in a C comment, in ASCII; with `keep` its spaces stay."""
    kept = text if keep else " ".join(text.split())
    plain = kept.encode("ascii", "replace").decode("ascii")
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
