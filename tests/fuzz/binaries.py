"""Shared libraries as bytes: the package's own reader of ELF, PE and Mach-O on damaged ones."""

import struct
import zipfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from random import Random

from psa_casadi.export.fmu.archive import export_fmu
from psa_casadi.export.importer.binary_file import read_binary
from psa_casadi.model.parts import part_model
from tests.fuzz.mutators import EDGES, damaged_bytes
from tests.fuzz.target import FALSE_PASS, Found, Target

#: One of each format; 32 bits and the other byte order come by damage to the headers.
_PLATFORMS = ("x86_64-linux", "x86_64-windows", "x86_64-darwin", "x86-windows")


@cache
def libraries() -> tuple[bytes, ...]:
    """Return a small FMU's library for each format."""
    import tempfile  # noqa: PLC0415 - the folder of the process that calls

    with tempfile.TemporaryDirectory() as folder:
        path = export_fmu(
            part_model("voltage_amplifier"), Path(folder) / "a.fmu", name="a", platforms=_PLATFORMS
        )
        with zipfile.ZipFile(path) as archive:
            names = sorted(n for n in archive.namelist() if n.startswith("binaries/"))
            return tuple(archive.read(n) for n in names)


def _library(rng: Random) -> bytes:
    return damaged_library(rng.choice(libraries()), rng)


def damaged_library(data: bytes, rng: Random) -> bytes:
    """Return a library with its headers damaged three times out of four, else anything in it."""
    kind = rng.random()
    if kind < 0.25:
        return damaged_bytes(data, rng)
    place, size = rng.choice(_headers(data)) if kind < 0.75 else (0, 4096)
    part = bytearray(data[place : place + size])
    for _ in range(rng.choice((1, 1, 2))):
        width = rng.choice((1, 2, 4, 4, 8))
        at = rng.randrange(max(1, len(part) // width)) * width
        number = rng.choice((*EDGES, len(data), len(data) - 1, rng.randrange(len(data))))
        part[at : at + width] = (number % (1 << 8 * width)).to_bytes(width, "little")
    return data[:place] + bytes(part) + data[place + size :]


def _headers(data: bytes) -> list[tuple[int, int]]:
    """Return where the headers and tables of a sound library lie: place and size of each."""
    if data[:4] == b"\x7fELF":
        table, entry, count = (
            struct.unpack_from("<Q", data, 40)[0], *struct.unpack_from("<2H", data, 58),
        )  # fmt: skip
        found = [(0, 64), (64, 56 * 8), (table, entry * count)]
        for k in range(count):
            kind, offset, size = struct.unpack_from("<4xI16x2Q", data, table + k * entry)
            if kind in (3, 5, 6, 11, 0x6FFFFFFE, 0x6FFFFFFF, 0x6FFFFFF6):
                found.append((offset, size))
        return found
    if data[:2] == b"MZ":
        start = struct.unpack_from("<I", data, 0x3C)[0]
        return [(0, 64), (start, 24 + 240), (start + 24, 240 + 40 * 8), (0x400, 0x400)]
    return [(0, 32), (32, 1024), (len(data) - 4096, 4096)]


def _parse(data: bytes, folder: Path) -> Iterator[Found]:
    path = folder / "library.so"
    path.write_bytes(data)
    found = read_binary(path)
    if len(found.exports) > len(data) or found.format not in ("ELF", "PE", "Mach-O"):
        yield Found(FALSE_PASS, "more names are exported than the library has bytes")


TARGETS = (Target("binaries", "archives", ".bin", _library, _parse, 2.0, prepare=libraries),)
