"""What a shared library exports and needs: a small reader of ELF, PE and Mach-O files.

Sources: System V gABI 4.1 with the GNU symbol versions, Microsoft's PE format, Apple's loader.h.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from psa_casadi.errors import InputError

#: What Apple's linker exports from every library.
_LINKER = {"__mh_dylib_header", "___dso_handle", "__mh_execute_header"}


@dataclass(frozen=True)
class Binary:
    """A library: its format ("ELF", "PE" or "Mach-O"), functions it exports, versions it needs.

    `needs` has names such as GLIBC_2.2.5 and is empty for other formats than ELF.
    """

    format: str
    exports: frozenset[str]
    needs: frozenset[str]


def read_binary(path: Path) -> Binary:
    """Return what a library exports and needs.

    Raises InputError if the file is no library of a known format, or is cut off: a part that its
    headers announce lies beyond its end, so that loading it could end the process.
    """
    data = path.read_bytes()
    try:
        if data[:4] == b"\x7fELF":
            return _elf(data)
        if data[:2] == b"MZ":
            return Binary("PE", frozenset(_pe_exports(data)), frozenset())
        if data[:4] == b"\xcf\xfa\xed\xfe":
            return Binary("Mach-O", frozenset(_macho_exports(data)), frozenset())
    except (struct.error, ValueError, IndexError) as error:
        raise InputError(
            f"{path.name}: the binary is damaged or cut off ({error}); export the FMU again."
        ) from error
    raise InputError(f"{path.name}: is no binary of a known format; export the FMU again.")


def _part(data: bytes, offset: int, size: int) -> bytes:
    """Return a part of a file; raises ValueError if the file ends before it does."""
    if offset + size > len(data):
        raise ValueError(f"it has {len(data)} bytes, a part of it ends at {offset + size}")
    return data[offset : offset + size]


def _text(data: bytes, offset: int) -> str:
    """Return the string that ends with a zero byte."""
    return data[offset : data.index(b"\0", offset)].decode("ascii", "replace")


@dataclass(frozen=True)
class _Section:
    """A section of an ELF file."""

    kind: int
    link: int
    info: int
    content: bytes


def _elf(data: bytes) -> Binary:
    wide, order = data[4] == 2, "<" if data[5] == 1 else ">"
    sections = _elf_sections(data, wide, order)
    exports: set[str] = set()
    needs: set[str] = set()
    for section in sections:
        names = sections[section.link].content if section.link < len(sections) else b""
        if section.kind == 11:  # the dynamic symbols
            exports |= set(_elf_exports(section.content, names, wide, order))
        elif section.kind == 0x6FFFFFFE:  # the versions of other libraries
            needs |= set(_elf_needs(section, names, order))
    if not any(s.kind == 11 for s in sections):
        raise ValueError("it has no table of symbols")
    return Binary("ELF", frozenset(exports), frozenset(needs))


def _elf_sections(data: bytes, wide: bool, order: str) -> list[_Section]:
    """Return all sections; every segment and section must lie within the file."""
    head = order + ("16x2H4x3Q4x6H" if wide else "16x2H4x3I4x6H")
    fields = struct.unpack_from(head, data)
    program, table, (size, count, entry, number) = fields[3], fields[4], fields[6:10]
    for k in range(count):
        if wide:
            offset, length = struct.unpack_from(order + "8xQ16xQ", data, program + k * size)
        else:
            offset, length = struct.unpack_from(order + "4xI8xI", data, program + k * size)
        _part(data, offset, length)
    _part(data, table, number * entry)
    sections = []
    for k in range(number):
        form = order + ("4xI16x2Q2I" if wide else "4xI8x2I2I")
        kind, offset, length, link, info = struct.unpack_from(form, data, table + k * entry)
        content = b"" if kind in (0, 8) else _part(data, offset, length)
        sections.append(_Section(kind, link, info, content))
    return sections


def _elf_exports(symbols: bytes, names: bytes, wide: bool, order: str) -> Iterator[str]:
    """Yield the symbols that are defined here and visible to others."""
    for fields in struct.iter_unpack(order + ("IBBH16x" if wide else "I8xBBH"), symbols):
        name, bind, other, section = fields
        if section and bind >> 4 in (1, 2, 10) and other & 3 in (0, 3) and name:
            yield _text(names, name)


def _elf_needs(section: _Section, names: bytes, order: str) -> Iterator[str]:
    """Yield the names of the versions that are needed of other libraries."""
    place = 0
    for _ in range(section.info):
        count, first, following = struct.unpack_from(order + "2xH4x2I", section.content, place)
        inner = place + first
        for _ in range(count):
            name, step = struct.unpack_from(order + "8x2I", section.content, inner)
            yield _text(names, name)
            inner += step
        place += following


def _pe_exports(data: bytes) -> Iterator[str]:
    """Yield the names in the export directory; every section must lie within the file."""
    start = struct.unpack_from("<I", data, 0x3C)[0]
    if data[start : start + 4] != b"PE\0\0":
        raise ValueError("it has no PE header")
    count, size = struct.unpack_from("<2xH12xH", data, start + 4)
    optional = start + 24
    wide = struct.unpack_from("<H", data, optional)[0] == 0x20B
    directory = struct.unpack_from("<I", data, optional + (112 if wide else 96))[0]
    sections = []
    for k in range(count):
        form = "<8x4I"
        fields = struct.unpack_from(form, data, optional + size + 40 * k)
        _part(data, fields[3], fields[2])
        sections.append(fields)

    def place(address: int) -> int:
        for virtual, begin, length, offset in sections:
            if begin <= address < begin + max(virtual, length):
                return int(address - begin + offset)
        raise ValueError(f"the address {address:#x} is in no section")

    if directory:
        number, table = struct.unpack_from("<24xI4xI", data, place(directory))
        for address in struct.unpack_from(f"<{number}I", data, place(table)):
            yield _text(data, place(address))


def _macho_exports(data: bytes) -> Iterator[str]:
    """Yield the external symbols, without their underscore; all segments must be in the file."""
    place = 32
    for _ in range(struct.unpack_from("<I", data, 16)[0]):
        command, size = struct.unpack_from("<2I", data, place)
        if size < 8:
            raise ValueError("a load command has no length")
        if command == 0x19:  # a segment
            _part(data, *struct.unpack_from("<40x2Q", data, place))
        elif command == 2:  # the table of symbols
            symbols, count, strings, length = struct.unpack_from("<8x4I", data, place)
            names = _part(data, strings, length)
            table = _part(data, symbols, 16 * count)
            for name, kind in struct.iter_unpack("<IB11x", table):
                if kind & 1 and kind & 0x0E and not kind & 0xF0:
                    found = _text(names, name)
                    if found not in _LINKER:
                        yield found.removeprefix("_")
        place += size
