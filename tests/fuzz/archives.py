"""FMUs as archives that are unpacked and described: hostile zips, damaged descriptions."""

import io
import stat
import zipfile
from collections.abc import Callable, Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from random import Random

from lxml import etree  # type: ignore[import-untyped]

from psa_casadi.export.importer.archive import Archive
from tests.fmu_models import entries
from tests.fuzz.mutators import WORDS, damaged_bytes, damaged_words
from tests.fuzz.target import FALSE_PASS, LEFT_OVER, Found, Target

ROOM = "archives"
STACK, _XML = "P-885.51", "modelDescription.xml"
_NAMES = ("../evil", "../../evil", "/tmp/psa_fuzz_evil", "C:\\evil", "..\\evil", "a/../../evil", "",
          ".", "..", "/", "a\0b", "x" * 300, "a/" * 200 + "b", "CON", "ä\u202e", _XML + "/", _XML,
          "binaries", "binaries/linux64", "resources/model.json", "sources/\n", " ")  # fmt: skip


@cache
def _small(fmi: int) -> dict[str, bytes]:
    """Return an FMU without what is long: description, model, a binary that is none."""
    kept = ("modelDescription.xml", "resources/")
    found = {n: c for n, c in entries(STACK, fmi).items() if n.startswith(kept)}
    return {**found, "binaries/linux64/P_885_51.so": b"\x7fELF" + bytes(60)}


def _zip(rng: Random) -> bytes:
    return hostile(_small(rng.choice((2, 3))), rng)


def hostile(content: dict[str, bytes], rng: Random) -> bytes:
    """Return an archive that is damaged, or made to harm who unpacks it."""
    if rng.random() < 0.003:
        return _bomb(dict(content), rng)
    ways = (_broken, _broken, _named, _linked, _lying, _twice, _stuffed)
    return rng.choice(ways)(dict(content), rng)


def _packed(
    content: dict[str, bytes], more: Callable[[zipfile.ZipFile], None] = lambda _: None
) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(zipfile.ZipInfo(name), data)
        more(archive)
    return buffer.getvalue()


def _broken(content: dict[str, bytes], rng: Random) -> bytes:
    if rng.random() < 0.2:
        content.pop(rng.choice(list(content)))
    data = _packed(content)
    return damaged_bytes(data, rng, (b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06", b"PK\x06\x06"))


def _named(content: dict[str, bytes], rng: Random) -> bytes:
    """Entries that would lie outside of the folder, or cannot lie anywhere."""
    name = rng.choice(_NAMES)
    mark = "?" * len(name.encode("utf-8", "surrogatepass"))
    data = _packed({**content, mark or "x": b"evil"})
    return data.replace((mark or "x").encode(), name.encode(), 2) if mark else data


def _linked(content: dict[str, bytes], rng: Random) -> bytes:
    """A symbolic link, a device or a pipe among the entries; then something below the link."""
    kind = rng.choice((stat.S_IFLNK, stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR, stat.S_IFDIR))

    def more(archive: zipfile.ZipFile) -> None:
        entry = zipfile.ZipInfo(rng.choice(("link", "resources", "binaries/linux64")))
        entry.create_system, entry.external_attr = 3, (kind | 0o777) << 16
        archive.writestr(entry, rng.choice(("..", "/etc", "/dev/zero", "link", "x" * 5000)))
        archive.writestr("link/evil", b"evil")

    return _packed(content, more)


def _bomb(content: dict[str, bytes], rng: Random) -> bytes:
    """Little that becomes much: zeros, entries without number, a description of gigabytes."""
    kind = rng.randrange(3)

    def more(archive: zipfile.ZipFile) -> None:
        if kind == 0:
            archive.writestr("resources/zeros", bytes(64 << 20))
        elif kind == 1:
            for k in range(3000):
                archive.writestr(f"resources/{k}/{k}", b"")

    if kind == 2:
        content[_XML] += b"<!--" + b" " * (32 << 20) + b"-->"
    return _packed(content, more)


def _lying(content: dict[str, bytes], rng: Random) -> bytes:
    """An entry whose header says another size, checksum, method or flag than it has."""
    data = bytearray(_packed(content))
    mark = rng.choice((b"PK\x01\x02", b"PK\x03\x04"))
    places = [k for k in range(len(data) - 46) if data[k : k + 4] == mark]
    place = rng.choice(places)
    field, size = rng.choice(
        ((6, 2), (8, 2), (10, 2), (14, 4), (16, 4), (18, 4), (20, 4), (22, 4), (24, 4), (26, 2),
         (28, 2), (30, 2), (38, 4), (42, 4))
    )  # fmt: skip
    number = rng.choice((0, 1, 9, 99, 0xFFFF, 0xFFFFFFFF, 0x7FFFFFFF, len(data)))
    data[place + field : place + field + size] = (number % (1 << 8 * size)).to_bytes(size, "little")
    return bytes(data)


def _twice(content: dict[str, bytes], rng: Random) -> bytes:
    """The same name twice, or in another case."""
    name = rng.choice(list(content))
    mark = "?" * len(name)
    data = _packed({**content, mark: damaged_bytes(content[name], rng)})
    return data.replace(mark.encode(), rng.choice((name, name.upper(), name)).encode())


def _stuffed(content: dict[str, bytes], rng: Random) -> bytes:
    """Bytes before or behind the archive, or an archive in an archive."""
    data = _packed(content)
    return rng.choice((rng.randbytes(100) + data, data + rng.randbytes(100), data + data,
                       _packed({"a.fmu": data}), b"", b"PK", data[:22]))  # fmt: skip


def _open(data: bytes, folder: Path) -> Iterator[Found]:
    """Unpack and describe; nothing may come to lie beside the folder that is made for it."""
    path, evil = folder / "x.fmu", Path("/tmp/psa_fuzz_evil")
    path.write_bytes(data)
    try:
        with Archive(path) as archive:
            inside = archive.directory.resolve()
            for file in inside.rglob("*"):
                if not file.resolve().is_relative_to(inside):
                    yield Found(FALSE_PASS, "an FMU was unpacked with a link that leads outside")
            _look_at(archive)
    finally:
        if evil.exists() or [p for p in folder.parent.rglob("evil*") if p.is_file()]:
            yield Found(LEFT_OVER, "an FMU wrote outside of its folder")
            evil.unlink(missing_ok=True)


def _look_at(archive: Archive) -> None:
    """Ask for all that the description says."""
    for causality in ("parameter", "input", "output", "local"):
        archive.names(causality)
    archive.states(), archive.sampled(), archive.indicators(), archive.indicator_count()
    list(archive.binaries()), archive.host_binary(), archive.step_size


_ENTITIES = (
    '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
    + "".join(
        f'<!ENTITY {b} "{"&" + a + ";"}{("&" + a + ";") * 9}">' for a, b in pairwise("abcdefghi")
    )
    + "]>",
    '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/hostname">]>',
    '<!DOCTYPE x SYSTEM "http://127.0.0.1:9/x.dtd">',
)


def damaged_xml(data: bytes, rng: Random) -> bytes:
    """Return XML with elements and attributes changed, removed, repeated; or its text damaged."""
    if rng.random() < 0.25:
        return damaged_bytes(data, rng, (b"<", b">", b"&", b'"', b"&#0;", b"\xff", b"<![CDATA["))
    root = etree.fromstring(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        every = list(root.iter(etree.Element))
        element = rng.choice(every)
        parent = element.getparent()
        match rng.randrange(7):
            case 0 | 1 | 2 if element.attrib:
                name = rng.choice(list(element.attrib))
                element.attrib[name] = _attribute(element.attrib[name], rng)
            case 3 if element.attrib:
                del element.attrib[rng.choice(list(element.attrib))]
            case 4 if parent is not None:
                parent.remove(element)
            case 5 if parent is not None:
                parent.append(etree.fromstring(etree.tostring(element)))
            case 6:
                element.tag = rng.choice(("x", rng.choice(every).tag, "Float64", "Real"))
    text: bytes = etree.tostring(
        root, xml_declaration=True, encoding=rng.choice(("UTF-8", "UTF-16"))
    )
    if rng.random() < 0.05:
        text = text.replace(b"<fmi", rng.choice(_ENTITIES).encode() + b"<fmi", 1)
        text = text.replace(b'description="', b'description="&i;&e;', 1)
    if rng.random() < 0.02:
        text = text.replace(b"<ModelStructure", b"<a>" * 20000 + b"<ModelStructure", 1)
    return text


def _attribute(value: str, rng: Random) -> str:
    if rng.random() < 0.5:
        found = rng.choice(
            (*WORDS, "4294967296", "-1", "true", "2.0", "3.0", "1.0", "3.0-rc", "99")
        )
    else:
        found = damaged_words(value, rng, WORDS)
    return "".join(c for c in found if c.isprintable() and c.isascii())[:300]


def _description(rng: Random) -> bytes:
    content = _small(rng.choice((2, 3)))
    return stored({**content, _XML: damaged_xml(content[_XML], rng)})


def stored(content: dict[str, bytes]) -> bytes:
    """Return an archive of entries as they are."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in content.items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return buffer.getvalue()


TARGETS = (
    Target("zips", ROOM, ".fmu", _zip, _open, 2.0, prepare=lambda: (_small(2), _small(3))),
    Target(
        "descriptions", ROOM, ".fmu", _description, _open, 2.0,
        prepare=lambda: (_small(2), _small(3)),
    ),
)  # fmt: skip
