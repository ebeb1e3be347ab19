"""Hook of mkdocs: the page of commands is made from the command line itself."""

import re
import subprocess
import sys
from typing import Any

PAGE = "commands.md"

#: Shortened lists, which follow in full.
_SHORTENED = re.compile(r"^\*\*Commands\*\*:\n\n(?:\* .*\n)+\n?", re.MULTILINE)
_EXAMPLE = re.compile(r"^(?:\x08\n)?Example: (psa .*)$", re.MULTILINE)
_TITLE = re.compile(r"\A# .*\n+")


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return the text of a page, the one of commands with all of them below."""
    return f"{markdown}\n{commands()}" if page.file.src_uri == PAGE else markdown


def commands() -> str:
    """Return every command with its arguments and options in Markdown."""
    line = [sys.executable, "-m", "typer", "psa_casadi.cli.app", "utils", "docs", "--name", "psa"]
    text = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    return _EXAMPLE.sub(r"Example: `\1`", _TITLE.sub("", _SHORTENED.sub("", text)))
