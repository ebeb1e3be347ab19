"""Archives that aim outside their folder, hold links, are bombs or damaged: nothing is unpacked."""

import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psa_casadi.errors import InputError
from psa_casadi.export.check.check import check_fmu
from psa_casadi.export.importer import archive as importer
from psa_casadi.export.importer import unpack as limits
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.unpack import archive_problems, unpack
from psa_casadi.export.ssp.read_archive import SspArchive
from tests.hostile_fmus import hostile_fmu

Change = Callable[[zipfile.ZipFile], None]


def _archive(path: Path) -> Path:
    return hostile_fmu(path, 2, b"a library that is never loaded")


def _named(*names: str) -> Change:
    def add(archive: zipfile.ZipFile) -> None:
        for name in names:
            entry = zipfile.ZipInfo("x")
            entry.filename = entry.orig_filename = name  # as it is, with what ZipInfo would mend
            archive.writestr(entry, b"text")

    return add


def _of_kind(mode: int) -> Change:
    def add(archive: zipfile.ZipFile) -> None:
        entry = zipfile.ZipInfo("resources/elsewhere")
        entry.create_system, entry.external_attr = 3, (mode | 0o777) << 16
        archive.writestr(entry, "/etc/passwd")

    return add


def _zeros(size: int) -> Change:
    return lambda archive: archive.writestr("resources/z", bytes(size), zipfile.ZIP_DEFLATED, 9)


NAMES: dict[str, tuple[Change, str]] = {
    "a folder above": (_named("../../outside"), "leads outside"),
    "a folder above, inside": (_named("resources/../../outside"), "leads outside"),
    "absolute": (_named("/tmp/outside"), "absolute path"),
    "a drive": (_named("C:/outside"), "names a drive"),
    "backslashes": (_named("..\\outside"), "has a backslash"),
    "control characters": (_named("resources/a\x1b[2Jb"), "control characters"),
    "twice": (_named("resources/a", "resources/a"), "stands for 2 entries"),
    "other case": (_named("resources/a", "resources/A"), "stands for 2 entries"),
    "a file and a folder": (_named("resources/a", "resources/a/b"), "is a file and a folder"),
    "too long": (_named("resources/" + "a" * 300), "too long"),
    "a link": (_of_kind(stat.S_IFLNK), "is a link"),
    "a device": (_of_kind(stat.S_IFCHR), "is a device"),
    "a method FMI does not have": (
        lambda archive: archive.writestr("resources/a", b"text", zipfile.ZIP_BZIP2), "method 12"),
}  # fmt: skip
SIZES: dict[str, tuple[Change, str]] = {
    "a bomb": (_zeros(20 << 20), "grows"),
    "many entries": (_named(*(f"resources/{k}" for k in range(40))), "more than 30"),
}


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize("what", NAMES | SIZES)
def test_such_an_archive_is_neither_unpacked_nor_run(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MOST_ENTRIES", 30)
    monkeypatch.setattr(limits, "SMALL_BYTES", 1 << 20)
    change, said = (NAMES | SIZES)[what]
    path = _archive(tmp_path / "h.fmu")
    assert archive_problems(path).sentences == ()
    with zipfile.ZipFile(path, "a") as archive:
        change(archive)
    report = check_fmu(path)
    row = "archive names" if what in NAMES else "archive size"
    assert [(r.name, said in r.remark) for r in report.failures] == [(row, True)]
    assert all(r.name.startswith("archive") for r in report.rows)
    assert all(r.remark.isprintable() for r in report.rows)
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(InputError, match=said):
        unpack(path, folder)
    assert list(folder.iterdir()) == []
    for reader in (Archive, SspArchive):
        with pytest.raises(InputError, match=r"h\.fmu"):
            reader(path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "h.fmu"]


def test_sizes_of_all_entries_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _archive(tmp_path / "h.fmu")
    monkeypatch.setattr(limits, "MOST_BYTES", 100)
    assert "more than 100" in archive_problems(path).sentences[0]


def test_a_list_of_entries_that_would_fill_the_memory(tmp_path: Path) -> None:
    """Seen at the end of the file, before Python's reader makes an object for each of them."""
    path = _archive(tmp_path / "h.fmu")
    content = path.read_bytes()
    place = content.rfind(b"PK\5\6")
    path.write_bytes(content[: place + 12] + struct.pack("<I", 1 << 30) + content[place + 16 :])
    assert archive_problems(path).size == ("its list of entries has 1073741824 bytes, too many",)


def _damaged(path: Path, how: str) -> None:
    content = bytearray(path.read_bytes())
    if how == "cut off":
        del content[-40:]
    elif how == "checksum":
        content[content.index(b"fmiModelDescription") + 30] ^= 1
    else:
        for place, shift in ((content.index(b"PK\3\4"), 6), (content.index(b"PK\1\2"), 8)):
            content[place + shift] |= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("how", "row", "said"),
    [
        ("cut off", "archive intact", "the archive is damaged"),
        ("checksum", "archive intact", "'modelDescription.xml' is damaged (Bad CRC-32"),
        ("encrypted", "archive names", "'modelDescription.xml' is encrypted"),
    ],
)
def test_damage(how: str, row: str, said: str, tmp_path: Path) -> None:
    path = _archive(tmp_path / "h.fmu")
    _damaged(path, how)
    report = check_fmu(path)
    assert [(r.name, said in r.remark) for r in report.failures] == [(row, True)], report.rows
    assert len(report.rows) == 3


def test_a_description_that_names_a_library_elsewhere(tmp_path: Path) -> None:
    path = tmp_path / "h.fmu"
    with zipfile.ZipFile(_archive(tmp_path / "good.fmu")) as good:
        text = good.read("modelDescription.xml").replace(b'Identifier="h"', b'Identifier="../../h"')
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
    with pytest.raises(InputError, match="is no name in C"):
        Archive(path)


def test_a_description_that_would_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importer, "LONGEST_TEXT", 100)
    with pytest.raises(InputError, match=r"modelDescription\.xml has more than"):
        Archive(_archive(tmp_path / "h.fmu"))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.data())
def test_any_change_of_bytes_is_told_or_harmless(data: st.DataObject) -> None:
    content = bytearray(_small())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = _SCRATCH / "a.zip"
    path.write_bytes(content[: data.draw(st.integers(1, len(content)))])
    archive_problems(path)


@pytest.fixture(autouse=True, scope="module")
def _scratch(tmp_path_factory: pytest.TempPathFactory) -> None:
    global _SCRATCH  # noqa: PLW0603 - hypothesis calls a test many times, without fixtures of a call
    _SCRATCH = tmp_path_factory.mktemp("scratch")


_SCRATCH = Path()


def _small() -> bytes:
    path = _SCRATCH / "small.zip"
    if not path.exists():
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("modelDescription.xml", "<a/>", zipfile.ZIP_DEFLATED)
            archive.writestr("binaries/linux64/h.so", bytes(100))
    return path.read_bytes()
