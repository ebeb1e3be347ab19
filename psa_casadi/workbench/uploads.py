"""The files that were given to the page, in a folder that only this user can read."""

import re
import shutil
from collections.abc import Callable, Collection
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path

from psa_casadi.characters import plain, visible
from psa_casadi.errors import InputError
from psa_casadi.records.read.file_bytes import MOST_BYTES

#: The most files, and the most bytes of all of them together.
MOST_FILES, MOST_TOGETHER = 32, 2 * MOST_BYTES
#: The longest name, in letters.
_LONGEST = 80
_BLOCK = 2**20
#: What a name of a file may not have, on any system, in a command line or in --columns.
_BARRED = re.compile(r"[^\w.+() -]")


@dataclass(frozen=True)
class Limits:
    """The most that is taken: bytes of one file, of all together, and files."""

    one: int = MOST_BYTES
    together: int = MOST_TOGETHER
    files: int = MOST_FILES


@dataclass(frozen=True)
class Upload:
    """A file that was given: the name that it had, and where it lies by a name without marks."""

    key: int
    name: str
    path: Path
    size: int


def stored_name(name: str, taken: Collection[str]) -> str:
    """Return a name to store a file by: without paths and marks, and unlike those that are taken.

    The ending is kept, as it says how a file is read.
    """
    last = re.split(r"[\\/]", plain(name))[-1]
    clean = _BARRED.sub("_", last).strip(" .").lstrip("-").strip(" .") or "record"
    stem, dot, ending = clean.rpartition(".")
    stem, ending = (stem, dot + ending) if dot else (ending, "")
    stem, ending = stem[:_LONGEST].rstrip(" ."), ending[:16]
    there = {n.casefold() for n in taken}
    names = (f"{stem}{f'_{k + 1}' if k else ''}{ending}" for k in range(len(there) + 1))
    return next(n for n in names if n.casefold() not in there)  # there is one more than are taken


def shown_name(name: str) -> str:
    """Return a file's name as the page shows it."""
    return plain(visible(name))[: 2 * _LONGEST] or "record"


def received(stream: BufferedIOBase, size: int, target: Path, admit: Callable[[int], None]) -> None:
    """Write so many bytes of a stream to a new file; `admit` is asked with how many there are.

    Raises:
        InputError: the stream ends before, or the file cannot be written.
    """
    left = size
    try:
        with target.open("xb") as file:
            while left and (block := stream.read(min(left, _BLOCK))):
                left -= len(block)
                admit(size - left)
                file.write(block)
    except OSError as error:
        raise InputError(f"The file cannot be kept ({error.strerror or error}).") from error
    if left:
        raise InputError("The file did not arrive whole; give it again.")


def removed(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
