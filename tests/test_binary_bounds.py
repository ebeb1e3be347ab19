"""Whatever bytes a library has: the reader ends soon, with an answer or the package's error."""

import os
import struct
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psa_casadi.errors import InputError
from psa_casadi.export.importer.binary_file import Binary, parse_binary
from tests.hostile_fmus import library

_HEAD = struct.Struct("<16s2HI3QI6H")


def _elf(sections: list[tuple[int, int, int, bytes]]) -> bytes:
    """Return an ELF file of sections (kind, link, info, content)."""
    data, table = bytearray(_HEAD.size), b""
    for kind, link, info, content in sections:
        form = "<IIQQQQIIQQ"
        table += struct.pack(form, 0, kind, 0, 0, len(data), len(content), link, info, 0, 0)
        data += content
    ident = b"\x7fELF\x02\x01\x01".ljust(16, b"\0")
    fields = (3, 62, 1, 0, 0, len(data), 0, 64, 0, 0, 64, len(sections), 0)
    data[: _HEAD.size] = _HEAD.pack(ident, *fields)
    return bytes(data) + table


_NAMES = b"\0fmi2DoStep\0GLIBC_2.5\0"
_SYMBOLS = struct.pack("<IBBHQQ", 0, 0, 0, 0, 0, 0) + struct.pack("<IBBHQQ", 1, 0x12, 0, 1, 8, 8)


def _with_versions(info: int, content: bytes) -> bytes:
    return _elf([(11, 1, 0, _SYMBOLS), (3, 0, 0, _NAMES), (0x6FFFFFFE, 1, info, content)])


def test_the_small_file_is_read() -> None:
    one = struct.pack("<2H3I", 1, 1, 0, 16, 0) + struct.pack("<I2H2I", 0, 0, 2, 12, 0)
    found = parse_binary(_with_versions(1, one), "h.so")
    names, needs = frozenset({"fmi2DoStep"}), frozenset({"GLIBC_2.5"})
    assert found == Binary("ELF", "x86_64-linux", names, needs)


@pytest.mark.parametrize(
    ("info", "count", "step"), [(0xFFFFFFFF, 0, 0), (0xFFFFFFFF, 1, 0), (1, 65535, 0), (2, 2, 1)]
)
def test_a_table_of_versions_that_leads_nowhere(info: int, count: int, step: int) -> None:
    """It would have been followed four thousand million times."""
    content = struct.pack("<2H3I", 1, count, 0, 16, 0) + struct.pack("<I2H2I", 0, 0, 2, 12, step)
    begin = time.process_time()
    with pytest.raises(InputError, match="table of versions"):
        parse_binary(_with_versions(info, content), "h.so")
    assert time.process_time() - begin < 1.0


def test_many_sections_of_the_whole_file() -> None:
    """Each would have been a copy of the file."""
    sections = [(11, 1, 0, _SYMBOLS), (3, 0, 0, _NAMES), (11, 1, 0, _SYMBOLS)]
    with pytest.raises(InputError, match="2 sections of kind 0xb"):
        parse_binary(_elf(sections), "h.so")


def test_counts_that_no_file_has() -> None:
    pe = bytearray(0x200)
    pe[:2], pe[0x3C:0x40], pe[0x80:0x84] = b"MZ", struct.pack("<I", 0x80), b"PE\0\0"
    struct.pack_into("<2xH12xH", pe, 0x84, 0xFFFF, 0xF0)
    with pytest.raises(InputError, match="65535 sections"):
        parse_binary(bytes(pe), "h.dll")
    macho = struct.pack("<8I", 0xFEEDFACF, 0, 0, 6, 0xFFFFFFFF, 0, 0, 0) + bytes(64)
    with pytest.raises(InputError, match="4294967295 load commands"):
        parse_binary(macho, "h.dylib")
    endless = _elf([(11, 1, 0, _SYMBOLS), (3, 0, 0, b"\0" + b"a" * 10_000)])
    with pytest.raises(InputError, match="does not end"):
        parse_binary(endless, "h.so")


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.sampled_from([b"\x7fELF\x02\x01", b"\x7fELF\x01\x02", b"MZ", b"\xcf\xfa\xed\xfe", b""]),
       st.binary(max_size=400))  # fmt: skip
def test_any_bytes(head: bytes, rest: bytes) -> None:
    _answered(head + rest)


@pytest.mark.skipif(os.name != "posix", reason="the library is for POSIX")
@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.floats(0.0, 1.0), st.binary(min_size=1, max_size=8)), min_size=1,
                max_size=4))  # fmt: skip
def test_any_change_of_a_library(changes: list[tuple[float, bytes]]) -> None:
    """Half of them in the headers at both ends, where the counts and offsets are."""
    content = bytearray(library())
    for place, new in changes:
        size = len(content)
        start = int(place * 256) if place < 0.5 else int(size - 2048 * (1.0 - place))
        content[start : start + len(new)] = new
    _answered(bytes(content))


def _answered(data: bytes) -> None:
    try:
        assert parse_binary(data, Path("h").name).format in ("ELF", "PE", "Mach-O")
    except InputError as error:
        assert "export the FMU again" in str(error)  # noqa: PT017 - an answer is as good
