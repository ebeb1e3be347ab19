"""The arrays of a MATLAB level 4 file (-v4), every header checked before it is believed.

Source: MathWorks, "MAT-File Format", level 4 (the five integers before each matrix).
"""

import struct

import numpy as np
from numpy.typing import NDArray

_HEADER = 20
#: Storage types, and how a matrix is used: full, text, sparse.
_STORED = ("f8", "f4", "i4", "i2", "u2", "u1")
_FULL, _USES = 0, 3


def level4_arrays(data: bytes) -> dict[str, NDArray[np.generic] | None]:
    """Return the full real matrices of a level 4 file by name; None where a name stands twice.

    Raises:
        ValueError: the content is damaged, or of no MATLAB file; the text says how.
    """
    found: dict[str, NDArray[np.generic] | None] = {}
    at = 0
    while at < len(data):
        kind, order, shape, parts, name_size = _header(data, at)
        start = at + _HEADER + name_size
        name = data[at + _HEADER : start]
        plain = name[:-1].decode("ascii", errors="replace")
        if len(name) < name_size or name[-1:] != b"\0" or not plain.isprintable():
            raise ValueError(f"byte {at + 1}: a matrix has the name {name[:40]!r}")
        twice = plain in found
        stored = np.dtype(order + _STORED[kind // 10 % 10])
        one = shape[0] * shape[1] * stored.itemsize
        at = start + parts * one
        if at > len(data):
            raise ValueError(f"the matrix '{plain}' of {parts * one} bytes has {len(data) - start}")
        found[plain] = None
        if kind % 10 == _FULL and parts == 1 and not twice:
            found[plain] = np.frombuffer(data[start:at], stored).reshape(shape, order="F")
    return found


def _header(data: bytes, at: int) -> tuple[int, str, tuple[int, int], int, int]:
    """Return kind, byte order, shape, number of parts (2: complex) and length of the name."""
    if len(data) - at < _HEADER:
        raise ValueError(f"byte {at + 1}: {len(data) - at} bytes stand where a matrix should begin")
    for machine, order in enumerate("<>"):
        kind, rows, columns, imaginary, name = struct.unpack_from(f"{order}5i", data, at)
        if kind // 1000 != machine:
            continue
        known = kind // 100 % 10 == 0 and kind // 10 % 10 < len(_STORED) and kind % 10 < _USES
        if known and rows >= 0 and columns >= 0 and imaginary in (0, 1) and name > 0:
            return kind, order, (rows, columns), 1 + imaginary, name
    raise ValueError(f"byte {at + 1}: no matrix begins here")
