"""What a shared library exports and needs: a small reader of ELF, PE and Mach-O files.

The file may be hostile: counts, sizes and offsets are bounded before they are followed, so that the
work grows no faster than the file.

Sources: System V gABI 4.1 with the GNU symbol versions, Microsoft's PE format, Apple's loader.h.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from psa_casadi.errors import InputError

#: What Apple's linker exports from every library.
_LINKER = {"__mh_dylib_header", "___dso_handle", "__mh_execute_header"}

# Bounds far above what compilers write.
_LONGEST_NAME = 4096
_MOST_SYMBOLS = 1_000_000
_MOST_SECTIONS_PE = 96  # what Windows loads
_MOST_NAMES_PE = 65_536  # an ordinal has 16 bits
_MOST_COMMANDS = 10_000


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
    return parse_binary(path.read_bytes(), path.name)


def parse_binary(data: bytes, name: str) -> Binary:
    """Return what the bytes of a library export and need; `name` is for the message.

    Raises InputError if they are no library of a known format, or damaged; nothing else.
    """
    try:
        if data[:4] == b"\x7fELF":
            return _elf(data)
        if data[:2] == b"MZ":
            return Binary("PE", frozenset(_pe_exports(data)), frozenset())
        if data[:4] == b"\xcf\xfa\xed\xfe":
            return Binary("Mach-O", frozenset(_macho_exports(data)), frozenset())
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise InputError(
            f"{name}: the binary is damaged or cut off ({error}); export the FMU again."
        ) from error
    raise InputError(f"{name}: is no binary of a known format; export the FMU again.")


def _require_part(data: bytes, offset: int, size: int) -> None:
    """Raise ValueError if the file ends before a part of it does; nothing is copied."""
    if offset + size > len(data):
        raise ValueError(f"it has {len(data)} bytes, a part of it ends at {offset + size}")


def _require_at_most(count: int, most: int, what: str) -> None:
    if count > most:
        raise ValueError(f"it announces {count} {what}, more than {most}")


def _part(data: bytes, offset: int, size: int) -> bytes:
    """Return a part of a file; raises ValueError if the file ends before it does."""
    _require_part(data, offset, size)
    return data[offset : offset + size]


def _text(data: bytes, offset: int) -> str:
    """Return the string that ends with a zero byte."""
    end = data.find(b"\0", offset, offset + _LONGEST_NAME + 1)
    if end < 0:
        raise ValueError(f"a name of it does not end within {_LONGEST_NAME} bytes")
    return data[offset:end].decode("ascii", "replace")


@dataclass(frozen=True)
class _Section:
    """A section of an ELF file, and where it lies."""

    kind: int
    link: int
    info: int
    offset: int
    size: int

    def content(self, data: bytes) -> bytes:
        """Return its bytes; those without any in the file are empty."""
        return b"" if self.kind in (0, 8) else _part(data, self.offset, self.size)


def _elf(data: bytes) -> Binary:
    wide, order = data[4] == 2, "<" if data[5] == 1 else ">"
    sections = _elf_sections(data, wide, order)
    symbols = _only(sections, 11)
    if symbols is None:
        raise ValueError("it has no table of symbols")
    names = _linked(data, sections, symbols)
    exports = frozenset(_elf_exports(symbols.content(data), names, wide, order))
    versions = _only(sections, 0x6FFFFFFE)  # those of other libraries
    if versions is None:
        return Binary("ELF", exports, frozenset())
    names = _linked(data, sections, versions)
    return Binary("ELF", exports, frozenset(_elf_needs(versions, data, names, order)))


def _only(sections: list[_Section], kind: int) -> _Section | None:
    """Return the section of a kind; the loader knows one table of each."""
    found = [s for s in sections if s.kind == kind]
    _require_at_most(len(found), 1, f"sections of kind {kind:#x}")
    return found[0] if found else None


def _linked(data: bytes, sections: list[_Section], section: _Section) -> bytes:
    """Return the strings that a section names things with."""
    return sections[section.link].content(data) if section.link < len(sections) else b""


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
        _require_part(data, offset, length)
    _require_part(data, table, number * entry)
    sections = []
    for k in range(number):
        form = order + ("4xI16x2Q2I" if wide else "4xI8x2I2I")
        kind, offset, length, link, info = struct.unpack_from(form, data, table + k * entry)
        if kind not in (0, 8):
            _require_part(data, offset, length)
        sections.append(_Section(kind, link, info, offset, length))
    return sections


def _elf_exports(symbols: bytes, names: bytes, wide: bool, order: str) -> Iterator[str]:
    """Yield the symbols that are defined here and visible to others."""
    form = order + ("IBBH16x" if wide else "I8xBBH")
    _require_at_most(len(symbols) // struct.calcsize(form), _MOST_SYMBOLS, "symbols")
    for fields in struct.iter_unpack(form, symbols):
        name, bind, other, section = fields
        if section and bind >> 4 in (1, 2, 10) and other & 3 in (0, 3) and name:
            yield _text(names, name)


def _elf_needs(section: _Section, data: bytes, names: bytes, order: str) -> Iterator[str]:
    """Yield the names of the versions that are needed of other libraries.

    Libraries and their versions are chains of entries of 16 bytes that lead forward; a chain that
    stands still, or has more entries than fit, is damage.
    """
    content = section.content(data)
    left = len(content) // 16
    place = 0
    for _ in range(section.info):
        count, first, following = struct.unpack_from(order + "2xH4x2I", content, place)
        inner = place + first
        left -= 1 + count
        if left < 0:
            raise ValueError("its table of versions has more entries than fit into it")
        for k in range(count):
            name, step = struct.unpack_from(order + "8x2I", content, inner)
            yield _text(names, name)
            if step < 16 and k < count - 1:
                raise ValueError("its table of versions leads nowhere")
            inner += step
        place += following


def _pe_exports(data: bytes) -> Iterator[str]:
    """Yield the names in the export directory; every section must lie within the file."""
    start = struct.unpack_from("<I", data, 0x3C)[0]
    if data[start : start + 4] != b"PE\0\0":
        raise ValueError("it has no PE header")
    count, size = struct.unpack_from("<2xH12xH", data, start + 4)
    optional = start + 24
    _require_at_most(count, _MOST_SECTIONS_PE, "sections")
    wide = struct.unpack_from("<H", data, optional)[0] == 0x20B
    directory = struct.unpack_from("<I", data, optional + (112 if wide else 96))[0]
    sections = []
    for k in range(count):
        form = "<8x4I"
        fields = struct.unpack_from(form, data, optional + size + 40 * k)
        _require_part(data, fields[3], fields[2])
        sections.append(fields)

    def place(address: int) -> int:
        for virtual, begin, length, offset in sections:
            if begin <= address < begin + max(virtual, length):
                return int(address - begin + offset)
        raise ValueError(f"the address {address:#x} is in no section")

    if directory:
        number, table = struct.unpack_from("<24xI4xI", data, place(directory))
        _require_at_most(number, _MOST_NAMES_PE, "exported names")
        for address in struct.unpack_from(f"<{number}I", data, place(table)):
            yield _text(data, place(address))


def _macho_exports(data: bytes) -> Iterator[str]:
    """Yield the external symbols, without their underscore; all segments must be in the file."""
    place, tables = 32, []
    commands = struct.unpack_from("<I", data, 16)[0]
    _require_at_most(commands, _MOST_COMMANDS, "load commands")
    for _ in range(commands):
        command, size = struct.unpack_from("<2I", data, place)
        if size < 8:
            raise ValueError("a load command has no length")
        if command == 0x19:  # a segment
            _require_part(data, *struct.unpack_from("<40x2Q", data, place))
        elif command == 2:  # the table of symbols
            tables.append(struct.unpack_from("<8x4I", data, place))
        place += size
    _require_at_most(len(tables), 1, "tables of symbols")
    for symbols, count, strings, length in tables:
        _require_at_most(count, _MOST_SYMBOLS, "symbols")
        names = _part(data, strings, length)
        for name, kind in struct.iter_unpack("<IB11x", _part(data, symbols, 16 * count)):
            if kind & 1 and kind & 0x0E and not kind & 0xF0:
                found = _text(names, name)
                if found not in _LINKER:
                    yield found.removeprefix("_")
