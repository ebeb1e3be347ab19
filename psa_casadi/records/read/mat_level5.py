"""The arrays of a MATLAB level 5 file (-v6, -v7), every tag checked before it is believed.

The elements are walked here rather than in SciPy, whose compiled reader trusts the types and sizes
that a file states: one wrong byte may end the whole process there.

Source: MathWorks, "MAT-File Format", level 5 (tags, array flags, classes, storage types).
"""

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psa_casadi.records.read.file_bytes import check_size

#: An array of numbers, a structure of named ones, several structures, a text, or None for others.
Tree = NDArray[np.generic] | Mapping[str, "Tree"] | tuple["Tree", ...] | str | None

_MATRIX, _COMPRESSED = 14, 15
_INT8, _INT32, _UINT32, _NAMES = 1, 5, 6, (1, 2, 16)
_CELL, _STRUCT, _CHARS = 1, 2, 4
#: How texts are stored, as Python calls it. No name or unit is longer than this, in bytes.
_CODES = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
_LONGEST = 10_000
#: Objects, sparse matrices, functions and opaque ones: no arrays of numbers.
_LEFT_OUT = (3, 5, 16, 17)
#: Classes of arrays of numbers, and storage types of numbers, as NumPy calls them.
_CLASSES = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
_STORED = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_COMPLEX = 0x800
_MOST_DIMENSIONS = 32
#: Structures lie in each other no deeper than this.
_DEEPEST = 32
#: More names than this in one place are no record's.
_MOST_NAMES = 100_000


def byte_order(data: bytes) -> str:
    """Return "<" or ">" where a file's content begins as level 5 does, else nothing."""
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128], "")
    return order if order and struct.unpack(f"{order}H", data[124:126])[0] == 0x0100 else ""


def level5_arrays(path: str, data: bytes) -> dict[str, Tree]:
    """Return the variables of a level 5 file by name.

    Raises:
        InputError: the compressed variables are larger than a record may be.
        ValueError: the content is damaged; the text says how.
    """
    order = byte_order(data)
    found: dict[str, Tree] = {}
    unpacked = 0
    for kind, content in _elements(memoryview(data)[128:], order):
        variable = content
        if kind == _COMPRESSED:
            variable = _unpacked(path, content, order, unpacked)
            unpacked += len(variable)
        elif kind != _MATRIX:
            raise ValueError(f"a variable has the type {kind}")
        _keep(found, *_array(variable, order))
    return found


def _unpacked(path: str, content: memoryview, order: str, before: int) -> memoryview:
    """Return the content of a compressed variable, of the size that it states.

    Together with the `before` bytes of others it must not be too large.
    """
    stream = zlib.decompressobj()
    try:
        tag = stream.decompress(content, 8)
        kind, size = struct.unpack(f"{order}II", tag) if len(tag) == 8 else (0, 0)
        if kind != _MATRIX:
            raise ValueError(f"a compressed variable has the type {kind}")
        check_size(path, before + size, "unpacked, its variables hold")
        unpacked = stream.decompress(stream.unconsumed_tail, size + 8)
    except zlib.error as error:
        raise ValueError(f"a compressed variable is damaged: {error}") from error
    if len(unpacked) < size or not stream.eof:
        raise ValueError(f"a compressed variable does not have the {size} bytes that it states")
    return memoryview(unpacked)[:size]


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield type and content of the elements that lie one after the other."""
    at = 0
    while at < len(data):
        if len(data) - at < 8:
            raise ValueError(f"{len(data) - at} bytes stand where an element should begin")
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start, room = at + 8, len(data) - at - 8
        if kind >> 16:  # a small element: type and size share a word, the content is the next
            kind, size, start, room = kind & 0xFFFF, kind >> 16, at + 4, 4
        if size > room:
            raise ValueError(f"an element of {size} bytes begins where {room} are left")
        yield kind, data[start : start + size]
        at = start + size if kind == _COMPRESSED else start + size + -(start + size - at) % 8


@dataclass(frozen=True)
class _Parts:
    """The parts of one array, taken in their order."""

    elements: Iterator[tuple[int, memoryview]]
    order: str
    depth: int

    def next(self, *wanted: int) -> tuple[int, memoryview]:
        """Return type and content of the next part, whose type must be a wanted one."""
        kind, content = next(self.elements, (0, memoryview(b"")))
        if kind not in wanted:
            raise ValueError(f"an array has the type {kind} where it should have {wanted[0]}")
        return kind, content

    def integers(self, *wanted: int) -> list[int]:
        """Return the next part as integers of 32 bits."""
        kind, content = self.next(*wanted)
        if len(content) > 4 * _MOST_DIMENSIONS:
            raise ValueError(f"{len(content)} bytes stand where a few integers should")
        return [int(n) for n in np.frombuffer(content, self.order + _STORED[kind])]

    def array(self) -> Tree:
        """Return the next part as an array."""
        return _array(self.next(_MATRIX)[1], self.order, self.depth + 1)[1]


def _array(content: memoryview, order: str, depth: int = 0) -> tuple[str, Tree]:
    """Return name and value of one array; those within structures have no name."""
    if not content and depth:
        return "", None  # an empty field
    if depth > _DEEPEST:
        raise ValueError(f"structures lie more than {_DEEPEST} deep in each other")
    parts = _Parts(_elements(content, order), order, depth)
    flags = parts.integers(_UINT32)
    kind = flags[0] & 0xFF if len(flags) == 2 else 0
    if kind in _LEFT_OUT:
        return "", None
    if kind not in (_CELL, _STRUCT, _CHARS, *_CLASSES):
        raise ValueError(f"an array has the class {kind}")
    shape = parts.integers(_INT32, _UINT32)
    if len(shape) < 2 or min(shape) < 0:
        raise ValueError(f"an array has the dimensions {shape[:8]}")
    name = _text(parts.next(*_NAMES)[1])
    if kind in _CLASSES:
        numbers = _numbers(parts, kind, shape)
        return name, None if flags[0] & _COMPLEX else numbers
    if kind == _CHARS:
        return name, _characters(parts)
    count = math.prod(shape)
    if kind == _STRUCT and count:
        several = _structures(parts, count)
        return name, several if count > 1 else several[0]
    return name, parts.array() if kind == _CELL and count == 1 else None


def _numbers(parts: _Parts, kind: int, shape: list[int]) -> NDArray[np.generic]:
    stored, content = parts.next(*_STORED)
    given, held = np.dtype(parts.order + _STORED[stored]), np.dtype(_CLASSES[kind])
    # floats are stored as integers to save room, integers as smaller ones
    room = 4 if held.kind == "f" and given.kind != "f" else held.itemsize
    if given.itemsize > room or (given.kind == "f") > (held.kind == "f"):
        raise ValueError(f"an array of {held.name} is stored as {given.name}")
    if len(content) != math.prod(shape) * given.itemsize:
        raise ValueError(f"an array of the dimensions {shape[:8]} has {len(content)} bytes")
    return np.frombuffer(content, given).reshape(shape, order="F")


def _structures(parts: _Parts, count: int) -> tuple[dict[str, Tree], ...]:
    """Return structures of the same fields; what lies in them stands one after the other."""
    lengths = parts.integers(_INT32)
    names = bytes(parts.next(_INT8)[1])
    length = lengths[0] if len(lengths) == 1 else 0
    if length < 1 or len(names) % length:
        raise ValueError(f"the names of a structure have {len(names)} bytes of {length} each")
    if count > _MOST_NAMES:
        raise ValueError(f"{count} structures stand in one place")
    found: list[dict[str, Tree]] = [{} for _ in range(count if names else 1)]
    for own in found:
        for at in range(0, len(names), length):
            _keep(own, _text(names[at : at + length].split(b"\0")[0]), parts.array())
    return tuple(found)


def _characters(parts: _Parts) -> str | None:
    """Return a short text, None for another."""
    stored, content = parts.next(*_CODES, *_STORED)
    code = _CODES.get(stored, "")
    if not code or len(content) > _LONGEST:
        return None
    ends = {"<": "-le", ">": "-be"}[parts.order] if code in ("utf-16", "utf-32") else ""
    text = bytes(content).decode(code + ends, errors="replace")
    return text if text.isprintable() else None


def _text(name: bytes | memoryview) -> str:
    text = bytes(name).rstrip(b"\0").decode("utf-8", errors="replace")
    if not text.isprintable():
        raise ValueError(f"an array has the name {text[:40]!r}")
    return text


def _keep(found: dict[str, Tree], name: str, value: Tree) -> None:
    """Put a value under its name; under a name that stands twice, nobody knows which is meant."""
    if len(found) == _MOST_NAMES:
        raise ValueError(f"more than {_MOST_NAMES} arrays have names")
    if name:
        found[name] = None if name in found else value
