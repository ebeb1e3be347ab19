"""The arrays of NumPy's files: one (`.npy`) or several by name (`.npz`)."""

import io
import zipfile
from collections.abc import Iterator

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.records.read.arrays import Array, Numbers, collected, series
from psa_casadi.records.read.file_bytes import check_size, reason_of

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def npy_arrays(path: str, data: bytes) -> dict[str, Array]:
    """Return the series in a NumPy file: of a matrix the columns, of an archive all by name.

    Nothing is unpickled.

    Raises:
        InputError: the file is no NumPy file, is damaged, or is too large when unpacked.
    """
    try:
        if not data.startswith(b"PK"):
            return collected(series("", _array(data)))
        return collected(_members(path, data))
    except InputError:
        raise
    except Exception as error:  # NumPy may raise anything on a damaged file
        raise InputError(
            f"{path}: is no readable NumPy file ({reason_of(error)}); save it again with"
            " numpy.savez(path, time=..., voltage=..., displacement_um=...)."
        ) from error


def _members(path: str, data: bytes) -> Iterator[tuple[str, Array]]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [m for m in archive.infolist() if m.filename.endswith(".npy")]
        check_size(path, sum(m.file_size for m in members), "its arrays hold")
        for member in members:
            yield from series(member.filename.removesuffix(".npy"), _array(archive.read(member)))


def _array(data: bytes) -> Numbers:
    """Return the array in the content of a `.npy` file, which must hold as much as it states."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version[0]}.{version[1]} of the format is not read")
    shape, by_columns, kind = _HEADERS[version](stream)
    if kind.hasobject:
        raise ValueError("it holds Python objects, not numbers")
    numbers = np.frombuffer(data, kind, int(np.prod(shape, dtype=object)), stream.tell())
    return numbers.reshape(shape, order="F" if by_columns else "C")
