"""The command that runs, as it was typed: the pages and files that it writes tell it."""

from contextvars import ContextVar

#: Empty where Python runs the package.
typed: ContextVar[str] = ContextVar("typed", default="")
