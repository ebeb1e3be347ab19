"""The command `psa check` on hostile and damaged FMUs: it ends in order and passes none of them."""

import json
import struct
import zipfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from random import Random

from psa_casadi.errors import PsaError
from psa_casadi.export.fmu.archive import MODEL_ENTRY
from psa_casadi.export.fmu.platforms import compile_library, host_platform
from psa_casadi.model.model_file import dumps, loads
from tests.fmu_models import entries
from tests.fuzz.archives import STACK, damaged_xml, hostile, stored
from tests.fuzz.commands import left_files, misbehaved, psa
from tests.fuzz.mutators import EDGES, damaged_bytes
from tests.fuzz.target import FALSE_PASS, Found, Target

ROOM = "archives"


def _whole(rng: Random) -> bytes:
    """Return a whole FMU that is hostile, or damaged in its description, model, sources, binary."""
    content = dict(entries(STACK, rng.choice((2, 3))))
    kind = rng.randrange(5)
    if kind == 0:
        return hostile(content, rng)
    starts = ("", "modelDescription.xml", "resources/", "sources/", "binaries/")[kind]
    name = rng.choice([n for n in content if n.startswith(starts)])
    damage = {1: damaged_xml, 4: damaged_library}.get(kind, damaged_bytes)
    content[name] = damage(content[name], rng)
    return stored(content)


def damaged_library(data: bytes, rng: Random) -> bytes:
    """Return a library with its headers damaged three times out of four, else anything in it."""
    kind = rng.random()
    if kind < 0.25:
        return damaged_bytes(data, rng)
    place, size = rng.choice(_headers(data)) if kind < 0.75 else (0, 4096)
    part = bytearray(data[place : place + size])
    for _ in range(rng.choice((1, 1, 2))):
        width = rng.choice((1, 2, 4, 4, 8))
        at = rng.randrange(max(1, len(part) // width)) * width
        number = rng.choice((*EDGES, len(data), len(data) - 1, rng.randrange(len(data))))
        part[at : at + width] = (number % (1 << 8 * width)).to_bytes(width, "little")
    return data[:place] + bytes(part) + data[place + size :]


def _headers(data: bytes) -> list[tuple[int, int]]:
    """Return where the headers and tables of a sound library lie: place and size of each."""
    if data[:4] == b"\x7fELF":
        table, entry, count = (
            struct.unpack_from("<Q", data, 40)[0], *struct.unpack_from("<2H", data, 58),
        )  # fmt: skip
        found = [(0, 64), (64, 56 * 8), (table, entry * count)]
        for k in range(count):
            kind, offset, size = struct.unpack_from("<4xI16x2Q", data, table + k * entry)
            if kind in (3, 5, 6, 11, 0x6FFFFFFE, 0x6FFFFFFF, 0x6FFFFFF6):
                found.append((offset, size))
        return found
    if data[:2] == b"MZ":
        start = struct.unpack_from("<I", data, 0x3C)[0]
        return [(0, 64), (start, 24 + 240), (start + 24, 240 + 40 * 8), (0x400, 0x400)]
    return [(0, 32), (32, 1024), (len(data) - 4096, 4096)]


def _check(data: bytes, folder: Path) -> Iterator[Found]:
    """Let the command check an FMU: it ends in order and passes none that differs."""
    path = folder / "x.fmu"
    path.write_bytes(data)
    ended = psa(["check", path, *_LIMITED], folder, limit_s=_LIMIT_S)
    yield from misbehaved(ended, (0, 1, 2), "psa check")
    yield from left_files(folder, "psa check")
    if ended.code == 0 and (what := _difference(path)):
        yield Found(FALSE_PASS, f"psa check passes an FMU with {what}")
    if ended.code == 0 and "FAIL" in ended.out:
        yield Found(FALSE_PASS, "psa check ends with 0 in spite of a row that failed")


def _same_model(one: bytes, other: bytes) -> bool:
    """Whether two texts of MODEL.json give one model: a key that nothing reads may differ."""
    try:
        return dumps(loads(one.decode())) == dumps(loads(other.decode()))
    except (PsaError, ValueError):
        return False


def _difference(path: Path) -> str:
    """Return what makes an FMU another one than was exported; of a binary, that it is cut off.

    A byte of a binary that nothing runs or reads makes no difference that a check could see.
    """
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        found = {n: archive.read(n) for n in names}
    sound = next((e for e in (entries(STACK, 2), entries(STACK, 3)) if set(e) <= set(found)), {})
    if not sound or len(names) != len(set(names)):
        return "entries that are missing or there twice"
    for name, content in sound.items():
        if name == MODEL_ENTRY and _same_model(found[name], content):
            continue
        if found[name] != content and not name.startswith(("binaries/", "documentation", "extra")):
            return f"another {name.split('/')[0]}"
        if name.startswith("binaries/") and len(found[name]) != len(content):
            return "a binary of another length"
    return ""


#: C that runs as soon as the binary is loaded, or where a function of the standard is called.
_HARM = {
    "exit": "_exit(0);",
    "abort": "abort();",
    "endless": "for (;;) pause();",
    "busy": "volatile int x = 0; for (;;) ++x;",
    "null": "*(volatile int *)0 = 0;",
    "stop": "raise(SIGSTOP);",
    "term": "raise(SIGTERM);",
    "quiet": "close(0); close(1); close(2);",
    "flood": "for (int i = 0; i < 100000; ++i) puts(\"all 33 checks passed\");",
    "stay": "if (!fork()) { setsid(); sleep(3); _exit(0); }",
    "memory": "for (;;) { char *p = malloc(1 << 24); if (!p) abort(); memset(p, 1, 1 << 24); }",
    "stack": "char a[1 << 16]; memset(a, 1, sizeof a); harm();",
    "chdir": "chdir(\"/\"); unsetenv(\"TMPDIR\");",
}  # fmt: skip
_HARMLESS = ("quiet", "flood", "stay", "chdir")  # the FMU works in spite of them
_PLACES = ("load", "instantiate", "step")
_LIMIT_S = 300.0
#: A whole check ends well within that.
_LIMITED = ("--timeout", "100")


def _harm(rng: Random) -> bytes:
    case = {"harm": rng.choice(list(_HARM)), "at": rng.choice(_PLACES), "fmi": rng.choice((2, 3))}
    return json.dumps(case).encode()


@cache
def harmful(harm: str, at: str, fmi: int) -> bytes:
    """Return an FMU whose binary does harm when it is loaded, instantiated or stepped."""
    content = dict(entries(STACK, fmi))
    texts = {
        n.removeprefix("sources/"): c.decode()
        for n, c in content.items()
        if n.startswith("sources/")
    }
    mark = "__attribute__((constructor)) " if at == "load" else ""
    includes = "".join(
        f"#include <{h}.h>\n" for h in ("stdlib", "stdio", "string", "signal", "unistd")
    )
    code = (
        f"#define _GNU_SOURCE\n{includes}"
        f"{mark}void harm(void); void harm(void) {{ {_HARM[harm]} }}\n"
    )
    text = texts["instance.c"]
    if at != "load":
        function = {"instantiate": "void psa_instance_start(", "step": "psa_result psa_do_step("}[
            at
        ]
        body = text.index("{", text.index(function)) + 1
        text = text[:body] + " harm();" + text[body:]
    texts["instance.c"] = code + text
    library = compile_library(texts, STACK.replace("-", "_").replace(".", "_"), host_platform())
    binary = next(n for n in content if n.startswith("binaries/"))
    return stored({**content, binary: library})


def _check_harm(data: bytes, folder: Path) -> Iterator[Found]:
    case = json.loads(data)
    path = folder / "harm.fmu"
    path.write_bytes(harmful(**case))
    what = f"psa check of an FMU that does '{case['harm']}' at {case['at']}"
    ended = psa(["check", path, *_LIMITED], folder, limit_s=_LIMIT_S)
    yield from misbehaved(ended, (0, 1, 2), what)
    yield from left_files(folder, what)
    if ended.code == 0 and case["harm"] not in _HARMLESS:
        yield Found(FALSE_PASS, f"{what} ends with 0")


def _prepare() -> None:
    for fmi in (2, 3):
        entries(STACK, fmi)


TARGETS = (
    Target("checks", ROOM, ".fmu", _whole, _check, 3.0, 2 * _LIMIT_S, None, _prepare),
    Target("harm", ROOM, ".json", _harm, _check_harm, 2.0, 2 * _LIMIT_S, None, _prepare),
)
