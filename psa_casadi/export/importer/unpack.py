"""An archive looked through before it is unpacked: names, links, size, damage.

FMUs and SSPs come from anywhere: an entry may aim outside the folder, be a link, or be a bomb.
"""

import os
import stat
import struct
import unicodedata
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from psa_casadi.errors import InputError, Problems

#: Most entries of an archive, most bytes of all of them, longest name and part of a name [bytes].
MOST_ENTRIES, MOST_BYTES, LONGEST_NAME, LONGEST_PART = 10_000, 1 << 30, 1000, 255
#: How often larger than packed an entry, and all together, may be, once larger than this.
MOST_GROWTH, SMALL_BYTES = 100, 8 << 20
#: Longest list of entries [bytes]; Python's reader holds all of it, so it is looked at before.
_LONGEST_LIST = 256 * MOST_ENTRIES

_CHUNK = 1 << 16
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
#: What the standard library raises on a damaged archive.
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, struct.error, EOFError, NotImplementedError, RuntimeError,
    ValueError, OverflowError, LookupError, OSError,
)  # fmt: skip


class ArchiveProblems(NamedTuple):
    """What is wrong with an archive, in sentences: its bytes, names and links, its size."""

    damage: tuple[str, ...]
    names: tuple[str, ...]
    size: tuple[str, ...]

    @property
    def sentences(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.names, *self.size, *self.damage)


def archive_problems(path: Path) -> ArchiveProblems:
    """Return why a zip archive must not be unpacked; nothing is written, at most 1 GiB is read.

    Where names or sizes are wrong the content is not looked at. Raises nothing for any content.
    """
    try:
        long = _list_size(path)
        if long > _LONGEST_LIST:
            return ArchiveProblems((), (), (f"its list of entries has {long} bytes, too many",))
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            names, size = _listed(_wrong_names(entries)), _listed(_wrong_sizes(entries, path))
            damage = () if names or size else _listed(_damage(archive, entries))
    except _DAMAGE as error:
        return ArchiveProblems((f"the archive is damaged ({_said(error)})",), (), ())
    return ArchiveProblems(damage, names, size)


def unpack(path: Path, folder: Path) -> None:
    """Unpack a zip archive into an empty folder.

    Raises InputError, before anything is written, if the archive has any of `archive_problems`.
    """
    problems = archive_problems(path).sentences
    if problems:
        raise InputError(f"{path}: {'; '.join(problems)}.")
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                _write(archive, entry, folder.joinpath(*PurePosixPath(entry.filename).parts))
    except _DAMAGE as error:
        raise InputError(f"{path}: cannot be unpacked ({_said(error)}).") from error


def _list_size(path: Path) -> int:
    """Return the size of the list of entries [bytes] that the end of an archive announces."""
    with path.open("rb") as file:
        file.seek(-min(path.stat().st_size, 76 + 22 + 0xFFFF), os.SEEK_END)
        tail = file.read()
    place = tail.rfind(b"PK\5\6")
    if place < 0:
        raise zipfile.BadZipFile("it has no list of entries")
    if tail[:place][-20:-16] == b"PK\6\7":  # the large form stands before it
        return int(struct.unpack_from("<40xQ", tail, max(place - 76, 0))[0])
    return int(struct.unpack_from("<12xI", tail, place)[0])


def _write(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path) -> None:
    """Write one entry to a place where nothing is yet."""
    if entry.is_dir():
        target.mkdir(parents=True, exist_ok=True)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    with target.open("xb") as file:
        for part in _content(archive, entry):
            file.write(part)


def _content(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Iterator[bytes]:
    """Yield the content in parts, never more than the entry announces; its checksum is compared."""
    with archive.open(entry) as content:
        while part := content.read(_CHUNK):
            yield part


def _damage(archive: zipfile.ZipFile, entries: list[zipfile.ZipInfo]) -> Iterator[str]:
    """Yield the entries that cannot be read, or have another size or checksum than announced."""
    for entry in entries:
        try:
            size = sum(len(part) for part in _content(archive, entry))
        except _DAMAGE as error:
            yield f"{_quoted(entry)} is damaged ({_said(error)})"
            continue
        if size != entry.file_size:
            yield f"{_quoted(entry)} has {size} bytes, not {entry.file_size}"


def _wrong_sizes(entries: list[zipfile.ZipInfo], path: Path) -> Iterator[str]:
    """Yield what would fill the disk or the memory."""
    if len(entries) > MOST_ENTRIES:
        yield f"it has {len(entries)} entries, more than {MOST_ENTRIES}"
    total = sum(e.file_size for e in entries)
    if total > MOST_BYTES:
        yield f"unpacked it has {total} bytes, more than {MOST_BYTES}"
    packed = max(os.stat(path).st_size, 1)
    if total > SMALL_BYTES and total > MOST_GROWTH * packed:
        yield f"unpacked it is {total / packed:.0f} times as large, more than {MOST_GROWTH} times"
    for entry in entries:
        packed = max(entry.compress_size, 1)
        if entry.file_size > SMALL_BYTES and entry.file_size > MOST_GROWTH * packed:
            yield f"{_quoted(entry)} grows {entry.file_size / packed:.0f} times, more than allowed"


def _wrong_names(entries: list[zipfile.ZipInfo]) -> Iterator[str]:
    """Yield entries that are no plain files at a place of their own inside the folder."""
    for entry in entries:
        wrong = [*_wrong_name(entry), *_wrong_kind(entry)]
        if wrong:
            yield f"{_quoted(entry)} {' and '.join(wrong)}"
    places = Counter(_place(e) for e in entries)
    for place, count in places.items():
        if count > 1:
            yield f"{place!a} stands for {count} entries on some file systems"
    files = {_place(e) for e in entries if not e.is_dir()}
    for place in places:
        for k in (i for i, c in enumerate(place) if c == "/"):
            if place[:k] in files:
                yield f"{place[:k]!a} is a file and a folder"


def _wrong_name(entry: zipfile.ZipInfo) -> Iterator[str]:
    """Yield what is wrong with a name; that of the archive, which Python's reader may mend."""
    name = entry.orig_filename
    parts = name.removesuffix("/").split("/")
    if name.startswith("/") or ":" in name:
        yield "is an absolute path or names a drive"
    elif any(part in ("", ".", "..") for part in parts):
        yield "leads outside the archive's folder, or nowhere"
    if "\\" in name:
        yield "has a backslash"
    if any(unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp") for c in name):
        yield "has control characters"
    sizes = [len(part.encode("utf-8", "surrogatepass")) for part in parts]
    if len(name) > LONGEST_NAME or max(sizes) > LONGEST_PART:
        yield "is too long a name"


def _wrong_kind(entry: zipfile.ZipInfo) -> Iterator[str]:
    """Yield why an entry is no plain file or folder that can be read."""
    mode = entry.external_attr >> 16
    if stat.S_ISLNK(mode):
        yield "is a link"
    elif stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
        yield "is a device, a pipe or a socket"
    if entry.flag_bits & 0x1:
        yield "is encrypted"
    if entry.compress_type not in _METHODS:
        yield f"is packed by method {entry.compress_type}, which FMI does not have"


def _place(entry: zipfile.ZipInfo) -> str:
    """Return what a file system that knows no case, and one way of accents, makes of a name."""
    return unicodedata.normalize("NFC", entry.filename.removesuffix("/").casefold())


def _quoted(entry: zipfile.ZipInfo) -> str:
    name = entry.orig_filename
    return ascii(name if len(name) <= 80 else f"{name[:77]}...")


def _said(error: BaseException) -> str:
    return " ".join(ascii(str(error))[1:-1].split()) or type(error).__name__


def _listed(sentences: Iterator[str]) -> tuple[str, ...]:
    """Return the first of them, and how many more there are."""
    problems = Problems()
    for sentence in sentences:
        problems.add(sentence)
    return problems.sentences()
