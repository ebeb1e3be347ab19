"""Archives that aim outside their folder, hold links, are bombs or damaged: nothing is unpacked."""

import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from psa_casadi.errors import InputError
from psa_casadi.export.check.check import check_fmu
from psa_casadi.export.importer import archive as limits
from psa_casadi.export.importer.archive import Archive, archive_problems
from tests.export.hostile_fmus import hostile_fmu
from tests.export.ssp_master import SspArchive

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


def _zeros(archive: zipfile.ZipFile) -> None:
    archive.writestr("resources/z", bytes(20 << 20), zipfile.ZIP_DEFLATED, 9)


NAMES: dict[str, tuple[Change, str]] = {
    "a folder above": (_named("resources/../../outside"), "leads outside"),
    "absolute": (_named("/tmp/outside"), "leads outside"),
    "a drive": (_named("C:/outside"), "leads outside"),
    "backslashes": (_named("..\\outside"), "leads outside"),
    "control characters": (_named("resources/a\x1b[2Jb"), "control characters"),
    "other case": (_named("resources/a", "resources/A"), "stands for 2 entries"),
    "a link": (_of_kind(stat.S_IFLNK), "is a link or a device"),
    "a device": (_of_kind(stat.S_IFCHR), "is a link or a device"),
}
SIZES: dict[str, tuple[Change, str]] = {
    "a bomb": (_zeros, "times as large"),
    "many entries": (_named(*(f"resources/{k}" for k in range(40))), "more than 30"),
}


@pytest.mark.parametrize("what", NAMES | SIZES)
def test_such_an_archive_is_neither_unpacked_nor_run(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MOST_ENTRIES", 30)
    change, said = (NAMES | SIZES)[what]
    path = _archive(tmp_path / "h.fmu")
    assert not any(archive_problems(path).values())
    with zipfile.ZipFile(path, "a") as archive:
        change(archive)
    report = check_fmu(path)
    row = "archive names" if what in NAMES else "archive size"
    assert [(r.name, said in r.remark) for r in report.failures] == [(row, True)]
    assert all(r.name.startswith("archive") for r in report.rows)
    assert all(r.remark.isprintable() for r in report.rows)
    for reader in (Archive, SspArchive):
        with pytest.raises(InputError, match=r"h\.fmu"):
            reader(path)
    assert [p.name for p in tmp_path.iterdir()] == ["h.fmu"]


def test_sizes_of_all_entries_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MOST_BYTES", 100)
    (said,) = archive_problems(_archive(tmp_path / "h.fmu"))["archive size"]
    assert "more than 100" in said


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
        ("checksum", "archive intact", "'modelDescription.xml' is damaged"),
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
    monkeypatch.setattr(limits, "LONGEST_TEXT", 100)
    with pytest.raises(InputError, match=r"modelDescription\.xml has more than"):
        Archive(_archive(tmp_path / "h.fmu"))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.data())
def test_any_change_of_bytes_is_told_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("scratch") / "a.zip"
    content = bytearray(_archive(path).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(1, len(content)))])
    archive_problems(path)
