"""What the process with the foreign code tells the one that started it, in lines that are signed.

A record has a number and is signed with a key that only the two processes have; code that ends the
process early, or writes where it should not, can neither finish the records nor add one.
"""

import hashlib
import hmac
import json
import os
from dataclasses import astuple, dataclass, field

from psa_casadi.errors import PsaError
from psa_casadi.export.check.rows import CheckRow

#: What a process ends with that cannot write records any more.
CLOSED = 71

_LONGEST_LINE = 1 << 16


class SpoiltError(PsaError):
    """What was read is not a sequence of records."""


def _signed(key: bytes, number: int, text: str) -> bytes:
    mark = hmac.new(key, f"{number} {text}".encode(), hashlib.sha256).hexdigest()
    return f"{mark} {text}\n".encode()


@dataclass
class Writer:
    """Writes records to a file descriptor; a process that cannot do so ends at once."""

    descriptor: int
    key: bytes
    number: int = 0

    def write(self, record: str | CheckRow) -> None:
        """Tell that a check of this name begins, or what came of it."""
        self._tell(["begin", record] if isinstance(record, str) else ["row", *astuple(record)])

    def out_of_memory(self) -> None:
        """Tell that there is no memory left."""
        self._tell(["memory"])

    def end(self) -> None:
        """Tell that all checks are done; nothing may follow."""
        self._tell(["end"])

    def _tell(self, content: list[object]) -> None:
        line = _signed(self.key, self.number, json.dumps(content))
        self.number += 1
        try:
            while line:
                line = line[os.write(self.descriptor, line) :]
        except OSError:
            os._exit(CLOSED)


@dataclass
class Reader:
    """Collects rows from the bytes that were read; `begun` is the check that runs now."""

    key: bytes
    rows: list[CheckRow] = field(default_factory=list)
    begun: str = ""
    complete: bool = False
    without_memory: bool = False
    _number: int = 0
    _rest: bytes = b""

    def feed(self, data: bytes) -> None:
        """Take more bytes; raises SpoiltError where they are no records that follow."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._take(line)
        if len(self._rest) > _LONGEST_LINE or (self.complete and self._rest):
            raise SpoiltError("something else was written between the results")

    def close(self) -> None:
        """Say that no more bytes come; raises SpoiltError if a record is cut off."""
        if self._rest:
            raise SpoiltError("the last result is cut off")

    def _take(self, line: bytes) -> None:
        text = line.partition(b" ")[2].decode("ascii", "replace")
        expected = _signed(self.key, self._number, text)[:-1]
        if self.complete or not hmac.compare_digest(line, expected):
            raise SpoiltError("something else was written between the results")
        self._number += 1
        kind, *content = json.loads(text)
        if kind == "begin":
            self.begun = str(content[0])
        elif kind == "row":
            self.rows.append(CheckRow(*content))
            self.begun = ""
        elif kind == "memory":
            self.without_memory = True
        else:
            self.complete = True
