"""FMUs that are damaged or made to harm, checked by the command; states of FMUs as bytes, damaged.

`psa check` ends in order and passes none that differs. A state is refused or harmless.
"""

import io
import stat
import struct
import zipfile
from collections.abc import Callable, Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import fmpy
from fmpy.fmi1 import FMICallException
from lxml import etree  # type: ignore[import-untyped]

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.export.fmu.archive import MODEL_ENTRY
from psa_casadi.model.model_file import dumps, loads
from tests.export.fmu_models import entries, exported
from tests.studies.fuzz.campaign import FALSE_PASS, Finding, Target
from tests.studies.fuzz.commands import LIMIT_S, left_files, misbehaved, psa
from tests.studies.fuzz.damage import WORDS, damaged_bytes, damaged_words

_STACK, _XML = "P-885.51", "modelDescription.xml"
_NAMES = ("../evil", "../../evil", "/tmp/psa_fuzz_evil", "C:\\evil", "..\\evil", "a/../../evil", "",
          ".", "..", "/", "a\0b", "x" * 300, "a/" * 200 + "b", "CON", "ä\u202e", _XML + "/", _XML,
          "binaries", "binaries/linux64", "resources/model.json", "sources/\n", " ")  # fmt: skip


def _fmu(rng: Random) -> bytes:
    """Return a whole FMU that is hostile, or damaged in its description, model, sources, binary."""
    content = dict(entries(_STACK, rng.choice((2, 3))))
    kind = rng.randrange(5)
    if kind == 0:
        return rng.choice(_HOSTILE)(content, rng)
    starts = ("", _XML, "resources/", "sources/", "binaries/")[kind]
    name = rng.choice([n for n in content if n.startswith(starts)])
    content[name] = (_damaged_xml if kind == 1 else damaged_bytes)(content[name], rng)
    return _packed(content, zipfile.ZIP_STORED)


def _packed(
    content: dict[str, bytes],
    kind: int = zipfile.ZIP_DEFLATED,
    more: Callable[[zipfile.ZipFile], None] = lambda _: None,
) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        for name, data in content.items():
            archive.writestr(zipfile.ZipInfo(name), data, kind)
        more(archive)
    return buffer.getvalue()


def _broken(content: dict[str, bytes], rng: Random) -> bytes:
    data = _packed(content)
    return damaged_bytes(data, rng, (b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06", b"PK\x06\x06"))


def _named(content: dict[str, bytes], rng: Random) -> bytes:
    """Entries that would lie outside of the folder, or cannot lie anywhere; or a name twice."""
    name = rng.choice((*_NAMES, *content)).encode("utf-8", "surrogatepass")
    mark = b"?" * len(name) or b"x"
    return _packed({**content, mark.decode(): b"evil"}).replace(mark, name, 2)


def _linked(content: dict[str, bytes], rng: Random) -> bytes:
    """A symbolic link, a device or a pipe among the entries; then something below the link."""
    kind = rng.choice((stat.S_IFLNK, stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR, stat.S_IFDIR))

    def more(archive: zipfile.ZipFile) -> None:
        entry = zipfile.ZipInfo(rng.choice(("link", "resources", "binaries/linux64")))
        entry.create_system, entry.external_attr = 3, (kind | 0o777) << 16
        archive.writestr(entry, rng.choice(("..", "/etc", "/dev/zero", "link", "x" * 5000)))
        archive.writestr("link/evil", b"evil")

    return _packed(content, more=more)


def _bomb(content: dict[str, bytes], rng: Random) -> bytes:
    """Little that becomes much: zeros, entries without number, a description of gigabytes."""
    kind = rng.randrange(3)
    if kind == 0:
        content["resources/zeros"] = bytes(64 << 20)
    elif kind == 1:
        content |= {f"resources/{k}/{k}": b"" for k in range(3000)}
    else:
        content[_XML] += b"<!--" + b" " * (32 << 20) + b"-->"
    return _packed(content)


def _lying(content: dict[str, bytes], rng: Random) -> bytes:
    """An entry whose header has another size, checksum, method or flag than it has."""
    data = bytearray(_packed(content))
    mark = rng.choice((b"PK\x01\x02", b"PK\x03\x04"))
    place = rng.choice([k for k in range(len(data) - 46) if data[k : k + 4] == mark])
    place += rng.choice((6, 8, 10, 14, 16, 18, 20, 22, 24, 26, 28, 30, 38, 42))
    number = rng.choice((0, 1, 9, 99, 0xFFFF, 0xFFFFFFFF, 0x7FFFFFFF, len(data)))
    data[place : place + 4] = number.to_bytes(4, "little")
    return bytes(data)


def _stuffed(content: dict[str, bytes], rng: Random) -> bytes:
    """Bytes before or behind the archive, or an archive in an archive."""
    data = _packed(content)
    return rng.choice((rng.randbytes(100) + data, data + rng.randbytes(100), data + data,
                       _packed({"a.fmu": data}), b"", b"PK", data[:22]))  # fmt: skip


_HOSTILE = (_broken, _broken, _named, _named, _linked, _lying, _stuffed, _bomb)
_ENTITIES = (
    '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
    + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in pairwise("abcdefghi"))
    + "]>",
    '<!DOCTYPE x [<!ENTITY e SYSTEM "file:///etc/hostname">]>',
    '<!DOCTYPE x SYSTEM "http://127.0.0.1:9/x.dtd">',
)


def _damaged_xml(data: bytes, rng: Random) -> bytes:
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
                value = damaged_words(element.attrib[name], rng, WORDS)
                element.attrib[name] = "".join(c for c in value if c.isprintable() and c.isascii())
            case 3 if element.attrib:
                del element.attrib[rng.choice(list(element.attrib))]
            case 4 if parent is not None:
                parent.remove(element)
            case 5 if parent is not None:
                parent.append(etree.fromstring(etree.tostring(element)))
            case 6:
                element.tag = rng.choice(("x", rng.choice(every).tag, "Float64", "Real"))
    coding = rng.choice(("UTF-8", "UTF-16"))
    text: bytes = etree.tostring(root, xml_declaration=True, encoding=coding)
    if rng.random() < 0.05:
        text = text.replace(b"<fmi", rng.choice(_ENTITIES).encode() + b"<fmi", 1)
        text = text.replace(b'description="', b'description="&i;&e;', 1)
    return text


def _check(data: bytes, folder: Path) -> Iterator[Finding]:
    """Let the command check an FMU: it ends in order and passes none that differs."""
    path = folder / "x.fmu"
    path.write_bytes(data)
    ended = psa(["check", path, "--timeout", "100"], folder)
    yield from misbehaved(ended, (0, 1, 2), "psa check")
    yield from left_files(folder, "psa check")
    if ended.code == 0 and (what := _difference(path)):
        yield Finding(FALSE_PASS, f"psa check passes an FMU with {what}")
    if ended.code == 0 and "FAIL" in ended.out:
        yield Finding(FALSE_PASS, "psa check ends with 0 in spite of a row that failed")
    if Path("/tmp/psa_fuzz_evil").exists() or list(folder.parent.rglob("evil*")):
        yield Finding(FALSE_PASS, "an FMU wrote outside of its folder")


def _difference(path: Path) -> str:
    """Return what makes an FMU another one than was exported; of a binary, that it is cut off.

    A byte of a binary that nothing runs or reads makes no difference that a check could see, nor
    does a key of MODEL.json that nothing reads.
    """
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        table = {n: archive.read(n) for n in names}
    sound = next((e for e in (entries(_STACK, 2), entries(_STACK, 3)) if set(e) <= set(table)), {})
    if not sound or len(names) != len(set(names)):
        return "entries that are missing or there twice"
    for name, content in sound.items():
        if name == MODEL_ENTRY and _same_model(table[name], content):
            continue
        if table[name] != content and not name.startswith(("binaries/", "documentation", "extra")):
            return f"another {name.split('/')[0]}"
        if name.startswith("binaries/") and len(table[name]) != len(content):
            return "a binary of another length"
    return ""


def _same_model(one: bytes, other: bytes) -> bool:
    try:
        return dumps(loads(one.decode())) == dumps(loads(other.decode()))
    except (PsaError, ValueError):
        return False


_KINDS = tuple((name, fmi) for name in (_STACK, "every_effect") for fmi in (2, 3))
_STEP = 1e-5
#: Numbers that a state may not hold, and some that it may.
_NUMBERS = (float("nan"), float("inf"), -1e308, 1e308, 5e-324, -0.0, 1e30, 1.0, 2.0**63)


class _Instance:
    """An FMU for co-simulation some steps after its start, and its state there."""

    def __init__(self, name: str, fmi: int) -> None:
        path = str(exported(name, fmi))
        about = fmpy.read_model_description(path)
        self.slave = fmpy.instantiate_fmu(fmpy.extract(path), about, "CoSimulation")
        refs = {v.name: v.valueReference for v in about.modelVariables}
        self.voltage = refs["voltage"]
        self.outputs = [v.valueReference for v in about.modelVariables if v.causality == "output"]
        self.get: Any = self.slave.getReal if fmi == 2 else self.slave.getFloat64
        self.set: Any = self.slave.setReal if fmi == 2 else self.slave.setFloat64
        if fmi == 2:
            self.slave.setupExperiment()
        self.slave.enterInitializationMode()
        self.slave.exitInitializationMode()
        for k in range(5):
            self.step(10.0 * k, k * _STEP)
        state = self.slave.getFMUState()
        self.state: bytes = self.slave.serializeFMUState(state)
        self.slave.freeFMUState(state)

    def step(self, voltage: float, time: float) -> None:
        """Go one step on."""
        self.set([self.voltage], [voltage])
        self.slave.doStep(currentCommunicationPoint=time, communicationStepSize=_STEP)

    def values(self, state: bytes) -> list[float]:
        """Return the outputs after a state was taken."""
        taken = self.slave.deserializeFMUState(state)
        self.slave.setFMUState(taken)
        self.slave.freeFMUState(taken)
        return list(self.get(self.outputs))


_instance = cache(_Instance)


def _state(rng: Random) -> bytes:
    """Return the number of a kind and its damaged state; half of them with the right checksum."""
    number = rng.randrange(len(_KINDS))
    data = _instance(*_KINDS[number]).state
    if rng.random() < 0.5:
        return bytes([number]) + damaged_bytes(data, rng, (b"psasnap\0",))
    state = bytearray(data[32:])
    for _ in range(rng.choice((1, 1, 2, 8))):
        place = 8 * rng.randrange(len(state) // 8)
        whole = struct.pack("<q", rng.choice((0, 1, 2, 3, 255, -1, 2**31, 2**62)))
        number_put = struct.pack("<d", rng.choice(_NUMBERS))
        state[place : place + 8] = rng.choice((number_put, whole, rng.randbytes(8)))
    return bytes([number]) + data[:24] + struct.pack("<Q", _checksum(state)) + bytes(state)


def _checksum(data: bytes | bytearray) -> int:
    """Return FNV-1a of 64 bits, as snapshot.c computes it."""
    value = 14695981039346656037
    for byte in data:
        value = (value ^ byte) * 1099511628211 % 2**64
    return value


def _take(data: bytes, _: Path) -> Iterator[Finding]:
    """Take a damaged state and step from it; a sound one gives the same outputs afterwards."""
    instance, blob = _instance(*_KINDS[data[0]]), data[1:]
    before, taken = instance.values(instance.state), False
    try:
        instance.values(blob)
        taken = True
        instance.step(20.0, 5 * _STEP)  # an error from the FMU is right
    except FMICallException:
        pass
    if taken and struct.unpack_from("<Q", blob, 24)[0] != _checksum(blob[32:]):
        yield Finding(FALSE_PASS, "a state with a wrong checksum is taken")
    if instance.values(instance.state) != before:
        yield Finding(
            FALSE_PASS, "after a damaged state, a sound one does not give the same outputs"
        )
    if not taken:
        raise InputError("the state is refused")


TARGETS = (
    Target("checks", "archives", ".fmu", _fmu, _check, 1.0, 2 * LIMIT_S, None,
           lambda: [entries(_STACK, fmi) for fmi in (2, 3)]),
    Target("states", "blobs", ".blob", _state, _take, 1.0,
           prepare=lambda: [_instance(*kind) for kind in _KINDS]),
)  # fmt: skip
