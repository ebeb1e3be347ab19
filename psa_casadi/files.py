"""Output files that are written whole or not at all."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from psa_casadi.errors import InputError


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
    try:
        yield temporary
        if target.exists():
            temporary.chmod(target.stat().st_mode & 0o777)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def atomic_write(path: str | os.PathLike[str], data: str | bytes) -> None:
    """Write `data` to `path`, whole or not at all; text is written as UTF-8 with its own line ends.

    Raises:
        InputError: `path` cannot be written to, or the text cannot be; the sentence says why.
    """
    try:
        content = data.encode() if isinstance(data, str) else data
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise InputError(
            f"{path}: cannot write ({error.strerror}); choose another place or free this one."
        ) from error
    except UnicodeEncodeError as error:
        found = ord(error.object[error.start])
        raise InputError(
            f"{path}: cannot write, the text has the character U+{found:04X}, which UTF-8 does not"
            " have; remove it from names and descriptions."
        ) from error
