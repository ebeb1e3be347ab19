"""MATLAB level 5 content put together element by element, and whether content is refused."""

import struct
import zlib

import numpy as np
import pytest
from numpy.typing import ArrayLike

from psa_casadi.errors import InputError
from psa_casadi.records.read.mat_file import load_arrays
from tests.mutations import sentences

MATRIX, COMPRESSED = 14, 15
DOUBLE, STRUCT = 6, 2


def header(order: str = "<") -> bytes:
    """Return the 128 bytes before the first element."""
    return (
        b"MATLAB 5.0".ljust(124) + struct.pack(f"{order}H", 0x0100) + (b"IM", b"MI")[order == ">"]
    )


def element(kind: int, content: bytes, order: str = "<") -> bytes:
    """Return an element with its tag and padding, which a compressed one does not have."""
    padding = b"" if kind == COMPRESSED else bytes(-len(content) % 8)
    return struct.pack(f"{order}II", kind, len(content)) + content + padding


def small(kind: int, content: bytes, order: str = "<") -> bytes:
    """Return a small element: type and size in one word."""
    return struct.pack(f"{order}I", len(content) << 16 | kind) + content.ljust(4, b"\0")


def matrix(
    name: str,
    values: ArrayLike,
    *,
    order: str = "<",
    kind: int = DOUBLE,
    stored: tuple[int, str] = (9, "f8"),
) -> bytes:
    """Return an upright vector; `stored` is its storage type and NumPy's name of that."""
    array = np.asarray(values)
    begin = small if len(name) <= 4 else element
    parts = [
        element(6, struct.pack(f"{order}II", kind, 0), order),
        element(5, struct.pack(f"{order}ii", array.size, 1), order),
        begin(1, name.encode(), order),
        element(stored[0], array.astype(order + stored[1]).tobytes(), order),
    ]
    return element(MATRIX, b"".join(parts), order)


def structure(name: str, fields: list[tuple[str, bytes]], count: int = 1) -> bytes:
    """Return a structure, or `count` of them, of fields given as elements."""
    parts = [
        element(6, struct.pack("<II", STRUCT, 0)),
        element(5, struct.pack("<ii", count, 1)),
        element(1, name.encode()),
        small(5, struct.pack("<i", 8)),
        element(1, b"".join(field.encode().ljust(8, b"\0") for field, _ in fields)),
        *(content for _, content in fields),
    ]
    return element(MATRIX, b"".join(parts))


def compressed(inner: bytes) -> bytes:
    """Return an element that holds another one, deflated."""
    return element(COMPRESSED, zlib.compress(inner))


def refusal(data: bytes) -> str:
    """Return the sentence with which a content is refused."""
    with pytest.raises(InputError) as caught:
        load_arrays("a.mat", data)
    (problem,) = caught.value.problems
    assert problem.startswith("a.mat: ")
    return problem


def refused(data: bytes) -> bool:
    """Whether a content is refused as it should be; else it is read."""
    said = sentences(lambda: load_arrays("a.mat", data))
    assert all(p.startswith("a.mat: ") and p.endswith(".") for p in said)
    return bool(said)
