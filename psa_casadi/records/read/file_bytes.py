"""The bytes of a record's file, or a sentence that says why there are none."""

import gzip
import os
import zlib
from pathlib import Path

from psa_casadi.errors import InputError


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a file that is meant to hold a record.

    Raises:
        InputError: the file is missing, a directory, unreadable or empty.
    """
    try:
        data = Path(path).read_bytes()
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
    if not data.strip():
        raise InputError(f"{path}: the file is empty; export the record again.")
    return data


def unpacked(data: bytes, path: str | os.PathLike[str]) -> bytes:
    """Return the content of a gzipped file, of any other the data itself.

    Raises:
        InputError: the file is damaged.
    """
    if not data.startswith(b"\x1f\x8b"):
        return data
    try:
        return gzip.decompress(data)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: is a damaged gzip file ({error}); pack it again.") from error
