"""On a terminal: the command that was typed, and the progress of long work."""

import shutil
import sys
from collections.abc import Callable
from contextvars import ContextVar
from functools import wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
Progress = Callable[[str], None]

#: The command that runs, as it was typed, which pages and files quote; empty in Python.
typed: ContextVar[str] = ContextVar("typed", default="")

_CLEAR = "\r\x1b[K"


def silent(step: str) -> None:
    """Show nothing."""


def on_a_terminal(work: Callable[P, R]) -> Callable[P, R]:
    """Return long work that shows its `progress` on one line of the terminal by default.

    The line is that of stderr, cut to the terminal's width, and goes when the work ends. Where
    stderr is no terminal, nothing is written.
    """
    name = getattr(work, "__name__", "work")

    @wraps(work)
    def run(*inputs: P.args, **words: P.kwargs) -> R:
        if "progress" in words or not sys.stderr.isatty():
            return work(*inputs, **words)

        def show_step(step: str) -> None:
            room = shutil.get_terminal_size().columns - 1
            sys.stderr.write(f"{_CLEAR}{f'{name}: {step}'[:room]}")
            sys.stderr.flush()

        with_progress: Any = {**words, "progress": show_step}
        try:
            return work(*inputs, **with_progress)
        finally:
            sys.stderr.write(_CLEAR)
            sys.stderr.flush()

    return run
