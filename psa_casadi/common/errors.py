"""Errors for users: sentences, with all mistakes of an input at once."""

from collections.abc import Iterable, Sequence


class PsaError(Exception):
    """A failure that the package foresees; what it raises on purpose is one of these."""


class MachineError(Exception):
    """The machine lacks what the package needs, such as a compiler that works.

    No PsaError, which a search takes for a model that cannot be had: here no model can be.
    """


class InputError(PsaError, ValueError):
    """What the user gave cannot be used.

    `problems` holds one sentence for each mistake: what happened, the likely cause, what to do.
    A single sentence may be a plain string. `str(error)` has one problem on each line.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems: tuple[str, ...] = (
            (problems,) if isinstance(problems, str) else tuple(problems)
        )
        super().__init__(self.problems)

    def __str__(self) -> str:
        return "\n".join(self.problems)


def quoted(names: Iterable[str]) -> str:
    """Return names as a sentence lists them: 'a', 'b'."""
    return ", ".join(f"'{n}'" for n in names)


class Problems:
    """Collects the mistakes of one input so that the user sees them all in one message.

    At most `limit` sentences are kept; the last line counts the others.
    """

    def __init__(self, limit: int = 20) -> None:
        self._limit = limit
        self._kept: list[str] = []
        self._count = 0

    def __bool__(self) -> bool:
        return self._count > 0

    def add(self, sentence: str) -> None:
        """Note one mistake."""
        self._count += 1
        if len(self._kept) < self._limit:
            self._kept.append(sentence)

    def extend(self, sentences: Iterable[str]) -> None:
        """Note several mistakes."""
        for sentence in sentences:
            self.add(sentence)

    def add_uncounted(self, number: int) -> None:
        """Count `number` more mistakes of a kind that is noted already."""
        self._count += number

    def sentences(self) -> tuple[str, ...]:
        """Return what was kept, and how much was not."""
        more = self._count - len(self._kept)
        return (*self._kept, f"... and {more} more") if more else tuple(self._kept)

    def raise_if_any(self) -> None:
        """Raise an `InputError` with everything collected, if anything was."""
        if self:
            raise InputError(self.sentences())
