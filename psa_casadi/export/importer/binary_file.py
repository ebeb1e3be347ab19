"""What a shared library exports and needs: a small reader of ELF, PE and Mach-O files.

The file may be hostile: counts, sizes and offsets are bounded before they are followed, so that the
work grows no faster than the file.

Sources: Microsoft's PE format, Apple's loader.h; of ELF, see `elf_file`.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from psa_casadi.errors import InputError
from psa_casadi.export.importer.elf_file import read_elf
from psa_casadi.export.importer.file_parts import part_of, require_at_most, require_part, text_at

#: What Apple's linker exports from every library.
_LINKER = {"__mh_dylib_header", "___dso_handle", "__mh_execute_header"}

# Bounds far above what compilers write.
_MOST_SYMBOLS = 1_000_000
_MOST_SECTIONS_PE = 96  # what Windows loads
_MOST_NAMES_PE = 65_536  # an ordinal has 16 bits
_MOST_COMMANDS = 10_000

# Names of FMI 3's platform tuples for the machines of the headers.
_PE_MACHINES = {0x14C: "x86", 0x8664: "x86_64", 0xAA64: "aarch64"}
_MACHO_MACHINES = {0x0100_0007: "x86_64", 0x0100_000C: "aarch64"}


@dataclass(frozen=True)
class Binary:
    """A library: format, platform, functions it exports, versions of libraries it needs.

    `format` is "ELF", "PE" or "Mach-O"; `platform` is FMI 3's tuple, such as "riscv64-linux", or
    starts with "unknown". `needs` has names such as GLIBC_2.2.5 and is empty for other formats
    than ELF.
    """

    format: str
    platform: str
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
            machine, exports, needs = read_elf(data)
            return Binary("ELF", f"{machine}-linux", exports, needs)
        if data[:2] == b"MZ":
            machine = _PE_MACHINES.get(_pe_machine(data), "unknown")
            return Binary("PE", f"{machine}-windows", frozenset(_pe_exports(data)), frozenset())
        if data[:4] == b"\xcf\xfa\xed\xfe":
            machine = _MACHO_MACHINES.get(struct.unpack_from("<4xI", data)[0], "unknown")
            exports = frozenset(_macho_exports(data))
            return Binary("Mach-O", f"{machine}-darwin", exports, frozenset())
    except (struct.error, ValueError, IndexError, OverflowError) as error:
        raise InputError(
            f"{name}: the binary is damaged or cut off ({error}); export the FMU again."
        ) from error
    raise InputError(f"{name}: is no binary of a known format; export the FMU again.")


def _pe_header(data: bytes) -> int:
    """Return where the header is."""
    start = int(struct.unpack_from("<I", data, 0x3C)[0])
    if data[start : start + 4] != b"PE\0\0":
        raise ValueError("it has no PE header")
    return start


def _pe_machine(data: bytes) -> int:
    return int(struct.unpack_from("<H", data, _pe_header(data) + 4)[0])


def _pe_exports(data: bytes) -> Iterator[str]:
    """Yield the names in the export directory; every section must lie within the file."""
    start = _pe_header(data)
    count, size = struct.unpack_from("<2xH12xH", data, start + 4)
    optional = start + 24
    require_at_most(count, _MOST_SECTIONS_PE, "sections")
    wide = struct.unpack_from("<H", data, optional)[0] == 0x20B
    directory = struct.unpack_from("<I", data, optional + (112 if wide else 96))[0]
    sections = []
    for k in range(count):
        form = "<8x4I"
        fields = struct.unpack_from(form, data, optional + size + 40 * k)
        require_part(data, fields[3], fields[2])
        sections.append(fields)

    def place(address: int) -> int:
        for virtual, begin, length, offset in sections:
            if begin <= address < begin + max(virtual, length):
                return int(address - begin + offset)
        raise ValueError(f"the address {address:#x} is in no section")

    if directory:
        number, table = struct.unpack_from("<24xI4xI", data, place(directory))
        require_at_most(number, _MOST_NAMES_PE, "exported names")
        for address in struct.unpack_from(f"<{number}I", data, place(table)):
            yield text_at(data, place(address))


def _macho_exports(data: bytes) -> Iterator[str]:
    """Yield the external symbols, without their underscore; all segments must be in the file."""
    place, tables = 32, []
    commands = struct.unpack_from("<I", data, 16)[0]
    require_at_most(commands, _MOST_COMMANDS, "load commands")
    for _ in range(commands):
        command, size = struct.unpack_from("<2I", data, place)
        if size < 8:
            raise ValueError("a load command has no length")
        if command == 0x19:  # a segment
            require_part(data, *struct.unpack_from("<40x2Q", data, place))
        elif command == 2:  # the table of symbols
            tables.append(struct.unpack_from("<8x4I", data, place))
        place += size
    require_at_most(len(tables), 1, "tables of symbols")
    for symbols, count, strings, length in tables:
        require_at_most(count, _MOST_SYMBOLS, "symbols")
        names = part_of(data, strings, length)
        for name, kind in struct.iter_unpack("<IB11x", part_of(data, symbols, 16 * count)):
            if kind & 1 and kind & 0x0E and not kind & 0xF0:
                found = text_at(names, name)
                if found not in _LINKER:
                    yield found.removeprefix("_")
