"""The readers of records, column maps and units: damaged files in, a sound record or a sentence."""

import json
import math
import os
import signal
import struct
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.records import Record, read_record
from psa_casadi.records.read import apart
from psa_casadi.records.read.column_map import parse_columns
from psa_casadi.records.read.columns import COLUMNS
from psa_casadi.units import convert, parse_unit, si_unit
from tests.fuzz.mutators import WORDS, damaged_bytes, damaged_table, damaged_words
from tests.fuzz.target import FALSE_PASS, Found, Target
from tests.fuzz.valid_files import csv_texts, hdf5_files, mat_files, parquet_files, recompressed

ROOM = "readers"
_UNIT_TEXTS = ("N.s/m", "um", "V/degC", "kg.m2/s3", "N/(V.s)", "1/A", "counts/um", "%", "MOhm")
_UNIT_WORDS = ("m", "s", "V", "1", "%", "/", ".", "(", ")", "-", "+", "^", "2", "-2", "99999999",
               "1" * 400, "µ", "Ω", "°", "²", "degC", "counts", " ", "", "k", "m-3")  # fmt: skip
_MAPS = (
    "time=t:ms,voltage=log.u,displacement=y",
    "time=t,voltage=log.u:kV,displacement=y[nm],load_force=F,current=I:mA",
)
_MAP_WORDS = (*WORDS, *COLUMNS, "=", ":", ",", ".", "time=", ":ms", "[um]", "m.1", "Load-Force")
_HEADERS = (b"time [s]", b"displacement [um]", b"voltage", b"\xff\xfe", b"\xef\xbb\xbf", b"\0")


#: A file whose header names the columns as the sound column maps do.
_OTHER_NAMES = csv_texts()[3].replace(
    csv_texts()[3].split("\n")[0], "y [nm],t,log.u,F [N],I,theta [K]"
)


def _csv(rng: Random) -> bytes:
    text = rng.choice(csv_texts())
    kind = rng.random()
    if kind < 0.7:
        text = damaged_table(text, rng)
    data = text.encode(rng.choice(("utf-8", "utf-8", "utf-8", "cp1252", "utf-16")), "replace")
    return damaged_bytes(data, rng, _HEADERS) if kind > 0.6 else data


def _mat(rng: Random) -> bytes:
    data = rng.choice(mat_files())
    if data[:6] == b"MATLAB" and rng.random() < 0.6:
        return _damaged_element(data, rng)
    return damaged_bytes(data, rng)


def _damaged_element(data: bytes, rng: Random) -> bytes:
    """Return a MATLAB file with a type code or a size of one of its elements changed.

    What is compressed is damaged inside and compressed again.
    """
    places = []
    place = 128
    while place + 8 <= len(data):
        places.append(place)
        place += 8 + struct.unpack_from("<I", data, place + 4)[0]
    place = rng.choice(places)
    kind, size = struct.unpack_from("<II", data, place)
    if kind == 15:
        inner = zlib.decompress(data[place + 8 : place + 8 + size])
        return recompressed(data, place, _damaged_tags(inner, 0, rng))
    return _damaged_tags(data, place, rng)


def _damaged_tags(data: bytes, place: int, rng: Random) -> bytes:
    """Change a tag at a place, or one of the first that lie inside of it; or any byte after it."""
    at = place + rng.choice((0, 8, 16, 24, 32, 40, 48, 56))
    if at + 8 > len(data) or rng.random() < 0.3:
        return data[:place] + damaged_bytes(data[place:], rng)
    kind, size = struct.unpack_from("<II", data, at)
    if rng.random() < 0.5:
        kind = rng.choice((*range(20), 0x10001, 0x40005, 0xFFFF, kind ^ 256, kind + 512))
    else:
        size = rng.choice((0, 1, 3, size - 1, size + 1, size * 2, 0x7FFFFFFF, 0xFFFFFFFF, 8, 6, 17))
    return data[:at] + struct.pack("<II", kind % 2**32, size % 2**32) + data[at + 8 :]


def _hdf5(rng: Random) -> bytes:
    return damaged_bytes(rng.choice(hdf5_files()), rng, (b"time", b"HEAP", b"TREE", b"OHDR"))


def _parquet(rng: Random) -> bytes:
    data = rng.choice(parquet_files())
    length = struct.unpack_from("<I", data, len(data) - 8)[0]
    start = len(data) - 8 - length
    match rng.randrange(4):
        case 0 | 1:  # what describes the columns, with its own length
            footer = damaged_bytes(data[start:-8], rng)
            return data[:start] + footer + struct.pack("<I", len(footer)) + b"PAR1"
        case 2:  # the pages
            return damaged_bytes(data[:start], rng)[:start].ljust(start, b"\0") + data[start:]
    return damaged_bytes(data, rng)


def read(name: str, data: bytes, folder: Path) -> Iterator[Found]:
    """Read a record and yield what is unsound in it."""
    path = folder / name
    path.write_bytes(data)
    with patch.object(apart, "_told", _told_by_fork):
        record = read_record(path)
    yield from unsound(record)


def _told_by_fork(path: str, asked: dict[str, Any]) -> dict[str, Any]:
    """Return what the process apart tells of a file: a fork of this one, which starts at once.

    As there, one that a library crashes or that does not end has met a damaged file.
    """
    answer = Path(path).with_suffix(".json")
    child = os.fork()
    if not child:
        signal.setitimer(signal.ITIMER_REAL, 5.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        answer.write_text(json.dumps(apart.answered({"path": path, **asked})))
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        raise InputError(f"{path}: is damaged.")
    found: dict[str, Any] = json.loads(answer.read_text())
    if "refused" in found:
        raise InputError(found["refused"])
    return found


def unsound(record: Record) -> Iterator[Found]:
    """Yield what a record that was read may not be: short, uneven, not finite, back in time."""
    columns = {n: getattr(record, n) for n in COLUMNS}
    for name, values in columns.items():
        if values is None:
            continue
        if values.shape != record.time.shape or values.dtype != np.float64:
            yield Found(FALSE_PASS, f"the {name} has shape {values.shape} and {values.dtype}")
        elif np.isinf(values).any() or (name != "displacement" and np.isnan(values).any()):
            yield Found(FALSE_PASS, f"the {name} of a record that was read is not finite")
    if record.time.size < 16 or not (np.diff(record.time) > 0).all():
        yield Found(FALSE_PASS, "the time of a record that was read stands still or is short")
    if record.displacement is None or np.isfinite(record.displacement).sum() < 16:
        yield Found(FALSE_PASS, "a record that was read has too few displacements")


def _unit_text(rng: Random) -> bytes:
    text = damaged_words(rng.choice(_UNIT_TEXTS), rng, _UNIT_WORDS)
    return text.encode("utf-8", "replace")


def _parse_unit(data: bytes, _: Path) -> Iterator[Found]:
    text = data.decode()
    unit = parse_unit(text)
    if not (unit.ratio > 0 and unit.name):
        yield Found(FALSE_PASS, f"a unit has the factor {unit.factor}")
    coherent = si_unit(text)
    if convert(convert(1.0, text, coherent), coherent, text) - 1.0 > 1e-9:
        yield Found(FALSE_PASS, "a unit does not convert back")
    if not math.isfinite(unit.factor):
        yield Found(FALSE_PASS, "a unit has an infinite factor")


def _map_text(rng: Random) -> bytes:
    text = damaged_words(rng.choice(_MAPS), rng, _MAP_WORDS)
    return text.encode("utf-8", "replace")


def _parse_map(data: bytes, _: Path) -> Iterator[Found]:
    found = parse_columns(data.decode())
    for name, source in found.items():
        if name not in COLUMNS or not source.array:
            yield Found(FALSE_PASS, f"a column map holds {name!r}={source.array!r}")


def _mapped(data: bytes, folder: Path) -> Iterator[Found]:
    """Read a sound file with a damaged column map."""
    path = folder / "mapped.csv"
    path.write_text(_OTHER_NAMES, encoding="utf-8")
    yield from unsound(read_record(path, columns=data.decode()))


TARGETS = (
    Target("records-csv", ROOM, ".csv", _csv, partial(read, "r.csv"), 4.0),
    Target("records-mat", ROOM, ".mat", _mat, partial(read, "r.mat"), 3.0, prepare=mat_files),
    Target("records-hdf5", ROOM, ".mat", _hdf5, partial(read, "r.mat"), 1.5,
           prepare=hdf5_files),
    Target("records-parquet", ROOM, ".parquet", _parquet, partial(read, "r.parquet"), 1.5,
           prepare=parquet_files),
    Target("column-maps", ROOM, ".txt", _map_text, _parse_map, 0.5),
    Target("mapped-records", ROOM, ".txt", _map_text, _mapped, 0.5),
    Target("units", ROOM, ".txt", _unit_text, _parse_unit, 1.0),
)  # fmt: skip
