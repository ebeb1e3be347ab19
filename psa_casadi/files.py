"""Output files that are written whole or not at all."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from psa_casadi.errors import InputError

#: Files that are being written, and those that were, in their order.
_TEMPORARY: set[Path] = set()
_WRITTEN: list[Path] = []


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path to write to, beside `path`; it takes the place of `path` if the block ends well.

    If the block raises, what it wrote is removed and a file that stood at `path` stays as it was.
    A link is followed. A device or a pipe (`/dev/stdout`) cannot be replaced and is yielded itself.

    Raises:
        InputError: `path` is a directory, or the directory it names does not exist.
    """
    target = Path(path).resolve()
    if target.is_dir():
        raise InputError(f"{path}: cannot write, this is a directory; name a file in it.")
    if not target.parent.is_dir():
        raise InputError(
            f"{path}: cannot write, the directory {target.parent} does not exist; create it first."
        )
    if target.exists() and not target.is_file():
        yield target
        return
    temporary = target.with_name(f".{secrets.token_hex(4)}.{target.name}")
    _TEMPORARY.add(temporary)
    try:
        yield temporary
        if target.exists():
            temporary.chmod(target.stat().st_mode & 0o777)
        temporary.replace(target)
        _WRITTEN.append(Path(path))
    finally:
        temporary.unlink(missing_ok=True)
        _TEMPORARY.discard(temporary)


def written() -> tuple[Path, ...]:
    """Return the files that this process has written whole, by the names they were given."""
    return tuple(_WRITTEN)


def remove_temporaries() -> None:
    """Remove what is being written, before the process ends at once."""
    for temporary in tuple(_TEMPORARY):
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def atomic_write(path: str | os.PathLike[str], data: str | bytes) -> None:
    """Write `data` to `path`, whole or not at all; text is written as UTF-8 with its own line ends.

    Raises:
        InputError: `path` cannot be written to; the sentence says why.
    """
    content = data.encode() if isinstance(data, str) else data
    try:
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise InputError(
            f"{path}: cannot write ({error.strerror}); choose another place or free this one."
        ) from error
