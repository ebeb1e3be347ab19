"""What a shared library of Linux exports and needs: a small reader of ELF files of 32 and 64 bits.

Sources: System V gABI 4.1 with the GNU symbol versions.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from psa_casadi.export.importer.file_parts import part_of, require_at_most, require_part, text_at

_MOST_SYMBOLS = 1_000_000  # far above what compilers write
#: Names of FMI 3's platform tuples, by machine and whether addresses have 64 bits.
_MACHINES = {
    (3, False): "x86",
    (40, False): "aarch32",
    (62, True): "x86_64",
    (183, True): "aarch64",
    (243, True): "riscv64",
}


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
        return b"" if self.kind in (0, 8) else part_of(data, self.offset, self.size)


def read_elf(data: bytes) -> tuple[str, frozenset[str], frozenset[str]]:
    """Return machine, exported functions and needed versions of an ELF file.

    Raises ValueError, struct.error or IndexError if it is damaged.
    """
    wide, order = data[4] == 2, "<" if data[5] == 1 else ">"
    machine = _MACHINES.get((struct.unpack_from(order + "18xH", data)[0], wide), "unknown")
    sections = _elf_sections(data, wide, order)
    symbols = _only(sections, 11)
    if symbols is None:
        raise ValueError("it has no table of symbols")
    names = _linked(data, sections, symbols)
    exports = frozenset(_elf_exports(symbols.content(data), names, wide, order))
    versions = _only(sections, 0x6FFFFFFE)  # those of other libraries
    if versions is None:
        return machine, exports, frozenset()
    names = _linked(data, sections, versions)
    return machine, exports, frozenset(_elf_needs(versions, data, names, order))


def _only(sections: list[_Section], kind: int) -> _Section | None:
    """Return the section of a kind; the loader knows one table of each."""
    found = [s for s in sections if s.kind == kind]
    require_at_most(len(found), 1, f"sections of kind {kind:#x}")
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
        require_part(data, offset, length)
    require_part(data, table, number * entry)
    sections = []
    for k in range(number):
        form = order + ("4xI16x2Q2I" if wide else "4xI8x2I2I")
        kind, offset, length, link, info = struct.unpack_from(form, data, table + k * entry)
        if kind not in (0, 8):
            require_part(data, offset, length)
        sections.append(_Section(kind, link, info, offset, length))
    return sections


def _elf_exports(symbols: bytes, names: bytes, wide: bool, order: str) -> Iterator[str]:
    """Yield the symbols that are defined here and visible to others."""
    form = order + ("IBBH16x" if wide else "I8xBBH")
    require_at_most(len(symbols) // struct.calcsize(form), _MOST_SYMBOLS, "symbols")
    for fields in struct.iter_unpack(form, symbols):
        name, bind, other, section = fields
        if section and bind >> 4 in (1, 2, 10) and other & 3 in (0, 3) and name:
            yield text_at(names, name)


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
            yield text_at(names, name)
            if step < 16 and k < count - 1:
                raise ValueError("its table of versions leads nowhere")
            inner += step
        place += following
