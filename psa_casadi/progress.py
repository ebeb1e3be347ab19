"""What long work tells while it runs, on a terminal where it is given nothing else."""

import shutil
import sys
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
Progress = Callable[[str], None]

_CLEAR = "\r\x1b[K"


def silent(step: str) -> None:
    """Tell nothing."""


def on_a_terminal(work: Callable[P, R]) -> Callable[P, R]:
    """Return long work that shows its `progress` on one line of the terminal, if it is given none.

    The line is that of stderr, cut to the terminal's width, and goes when the work ends. Where
    stderr is no terminal, nothing is written.
    """
    name = getattr(work, "__name__", "work")

    @wraps(work)
    def run(*inputs: P.args, **words: P.kwargs) -> R:
        if "progress" in words or not sys.stderr.isatty():
            return work(*inputs, **words)

        def tell(step: str) -> None:
            room = shutil.get_terminal_size().columns - 1
            sys.stderr.write(f"{_CLEAR}{f'{name}: {step}'[:room]}")
            sys.stderr.flush()

        output: Any = {**words, "progress": tell}
        try:
            return work(*inputs, **output)
        finally:
            sys.stderr.write(_CLEAR)
            sys.stderr.flush()

    return run
