"""Output files that are written whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from psa_casadi.errors import InputError
from psa_casadi.scratch import temporary_file

#: Files that were written, in their order.
_WRITTEN: list[Path] = []


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path to write to, beside `path`; it takes the place of `path` if the block ends well.

    If the block raises, or the process is killed, a file that stood at `path` stays as it was. What
    the block wrote is removed, after a kill by the next that writes to the folder. A link is
    followed. A device or a pipe (`/dev/stdout`) cannot be replaced and is yielded itself.

    Raises:
        InputError: `path` cannot be written to; the sentence says why.
    """
    reason = why_not_written(path)
    if reason:
        raise InputError(reason)
    target = Path(path).resolve()
    try:
        if target.exists() and not target.is_file():
            yield target
            return
        with temporary_file(target.parent, target.name) as temporary:
            yield temporary
            if target.exists():
                temporary.chmod(target.stat().st_mode & 0o777)
            replace_durably(temporary, target)
            _WRITTEN.append(Path(path))
    except BrokenPipeError:  # who read it has gone
        raise
    except OSError as error:
        raise InputError(
            f"{path}: cannot write ({error.strerror or error}); choose another place or free this"
            " one."
        ) from error


def written() -> tuple[Path, ...]:
    """Return the files that this process has written whole, by the names they were given."""
    return tuple(_WRITTEN)


def atomic_write(path: str | os.PathLike[str], data: str | bytes) -> None:
    """Write `data` to `path`, whole or not at all; text is written as UTF-8 with its own line ends.

    Raises:
        InputError: `path` cannot be written to, or the text cannot be; the sentence says why.
    """
    try:
        content = data.encode() if isinstance(data, str) else data
    except UnicodeEncodeError as error:
        found = ord(error.object[error.start])
        raise InputError(
            f"{path}: cannot write, the text has the character U+{found:04X}, which UTF-8 does not"
            " have; remove it from names and descriptions."
        ) from error
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def why_not_written(path: str | os.PathLike[str]) -> str | None:
    """Return a sentence on why no file can stand at `path`; None where one can."""
    try:
        target = Path(path).resolve()
        if target.is_dir():
            return f"{path}: cannot write, this is a directory; name a file in it."
        if not target.parent.is_dir():
            return (
                f"{path}: cannot write, the directory {target.parent} does not exist; create it"
                " first."
            )
        target.exists()
    except (OSError, RuntimeError) as error:  # a name too long; links that lead in a circle
        said = error.strerror if isinstance(error, OSError) else error
        return f"{path}: cannot write ({said}); choose another name."
    return None


def make_folder(path: str | os.PathLike[str]) -> None:
    """Make a folder and those above it, where they are not there; InputError where that fails."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(
            f"{path}: cannot be created, there is a file of that name; name another folder."
        ) from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be created ({error.strerror}); name another folder."
        ) from error


def why_not_read(error: Exception) -> str:
    """Return in words why a file could not be read."""
    if isinstance(error, FileNotFoundError):
        return "there is no such file"
    if isinstance(error, UnicodeDecodeError):
        return "it is no text in UTF-8"
    said = error.strerror if isinstance(error, OSError) else None
    return said.lower() if said else str(error)


def replace_durably(temporary: Path, target: Path) -> None:
    """Put a written file in the place of another, so that a power cut leaves one of them whole."""
    with temporary.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(temporary, target)
