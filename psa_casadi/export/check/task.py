"""What the process with the foreign code is asked to do, and within which limits."""

from dataclasses import dataclass
from pathlib import Path

from psa_casadi.export.check.playback import Playback
from psa_casadi.export.check.truth import Truth

#: What a whole check, and the foreign code in it, may take unless told otherwise [s], [bytes].
TIMEOUT, MEMORY = 600.0, 4 << 30


@dataclass(frozen=True)
class Limits:
    """How long all checks may take [s], and how much memory the foreign code [bytes].

    Memory is limited on Linux only, and counts from what Python itself has when it starts.
    """

    timeout: float
    memory: int


@dataclass(frozen=True)
class Task:
    """An FMU by its path (for messages) and the folder into which it was unpacked.

    `key` signs the records; `truth` is what to compare with, `playbacks` are runs to repeat.
    """

    path: Path
    unpacked: Path
    truth: Truth | None
    key: bytes
    limits: Limits
    playbacks: tuple[Playback, ...] = ()
