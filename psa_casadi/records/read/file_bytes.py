"""The bytes of a record's file, or a sentence that says why there are none."""

import gzip
import hashlib
import io
import os
import zlib
from collections.abc import Callable
from pathlib import Path

from psa_casadi.errors import InputError

#: The most bytes that a record may have, in its file or unpacked in memory.
MOST_BYTES = 2**30
_BLOCK = 2**20
#: Bytes in memory of the fewest columns that a record has: a time and one number.
_LEAST_ON_A_LINE = 16


def check_there(path: str | os.PathLike[str]) -> None:
    """Refuse what is no file that can be read and holds something.

    Raises:
        InputError: the file is missing, a directory, unreadable or empty.
    """
    try:
        with Path(path).open("rb") as stream:
            is_empty = not stream.read(_BLOCK).strip()
    except FileNotFoundError:
        raise InputError(
            f"{path}: there is no such file; check the name and the directory it is in."
        ) from None
    except IsADirectoryError:
        raise InputError(f"{path}: is a directory; name the CSV files in it.") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check that you may read it."
        ) from error
    if is_empty:
        raise InputError(f"{path}: the file is empty; export the record again.")


def read_text(path: str | os.PathLike[str]) -> tuple[bytes, str]:
    """Return the content of a file of text, unpacked where it is gzipped, and the file's SHA-256.

    Raises:
        InputError: it is larger than `MOST_BYTES`, or damaged.
    """
    with Path(path).open("rb") as stream:
        data = content = _most(stream.read)
    check_size(path, len(data), "holds")
    if data.startswith(b"\x1f\x8b"):
        try:
            with gzip.GzipFile(fileobj=io.BytesIO(data)) as unpacked:
                content = _most(unpacked.read)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"{path}: is a damaged gzip file ({error}); pack it again.") from error
        check_size(path, len(content), "holds")
    lines = max(content.count(b"\n"), content.count(b"\r"))
    check_size(path, _LEAST_ON_A_LINE * lines, "its lines need")
    return content, hashlib.sha256(data).hexdigest()


def _most(read: Callable[[int], bytes]) -> bytes:
    """Return the content that is read, or more than `MOST_BYTES` of it; takes no more memory."""
    blocks, size = [], 0
    while size <= MOST_BYTES and (block := read(_BLOCK)):
        blocks.append(block)
        size += len(block)
    return b"".join(blocks)


def check_size(path: str | os.PathLike[str], size: int, what: str) -> None:
    """Refuse more than `MOST_BYTES`; `what` begins the sentence, such as "its columns hold".

    Raises:
        InputError: `size` is larger.
    """
    if size > MOST_BYTES:
        raise InputError(
            f"{path}: {what} more than {MOST_BYTES / 2**30:.3g} GiB, the most that is read as one "
            f"record; leave out arrays that are not needed, or split the record."
        )
