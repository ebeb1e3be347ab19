"""The readers of records, column maps, units, models and paths: damaged input, a sound thing out.

Or a sentence: what is refused is right.
"""

import io
import json
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch
from xml.etree import ElementTree as ET

import numpy as np

import psa_casadi as psa
from psa_casadi.common.units import convert, parse_unit, si_unit
from psa_casadi.design.tracking.targets import read_target
from psa_casadi.export.fmu.description import model_description
from psa_casadi.export.fmu.evidence import evidence_texts
from psa_casadi.model.model_file import dumps
from psa_casadi.model.ports import with_ports
from psa_casadi.model.variables import Interval, Provenance
from psa_casadi.records.read import apart
from psa_casadi.records.read.columns import parse_columns
from psa_casadi.records.record import COLUMNS
from tests.any_model.own_models import cylinder, motor, oscillator, oven, pair, tanks
from tests.export.fmu_models import model_named
from tests.model.evidence_models import evident_model
from tests.records.laboratory_bytes import gcs, hdf5, lvm, mat, named, npy, npz, parquet, tdms, xlsx
from tests.records.record_files import read_by_fork
from tests.studies.fuzz.campaign import FALSE_PASS, Finding, Target
from tests.studies.fuzz.damage import (
    WORDS,
    damaged_bytes,
    damaged_json,
    damaged_table,
    damaged_words,
)

_UNIT_TEXTS = ("N.s/m", "um", "V/degC", "kg.m2/s3", "N/(V.s)", "1/A", "counts/um", "%", "MOhm")
_UNIT_WORDS = ("m", "s", "V", "1", "%", "/", ".", "(", ")", "-", "+", "^", "2", "-2", "99999999",
               "1" * 400, "µ", "Ω", "°", "²", "degC", "counts", " ", "", "k", "m-3")  # fmt: skip
_MAPS = (
    "time=t:ms,voltage=log.u,displacement=y",
    "time=t,voltage=log.u:kV,displacement=y[nm],load_force=F,current=I:mA",
)
_MAP_WORDS = (*WORDS, *COLUMNS, "=", ":", ",", ".", "time=", ":ms", "[um]", "m.1", "Load-Force")
#: Marks of the formats, put in where they do not belong.
_MARKS = (b"time [s]", b"\xff\xfe", b"\xef\xbb\xbf", b"\0", b"TDSm", b"TREE", b"HEAP", b"OHDR",
          b"f8", b"wf_", b"PAR1", b"PK\x03\x04")  # fmt: skip
#: A file whose header names the columns as the column maps do.
_OTHER_NAMES = "y [nm],t,log.u,F [N],I,theta [K]"

_N = 18
_T = np.arange(_N) / 8.0
_U = np.round(50.0 * np.sin(_T), 3)
_Y = np.round(5.0 * np.cos(_T), 4)
_HEADER = ["time [s]", "voltage [V]", "displacement [um]"]


@cache
def sound_files() -> dict[str, tuple[bytes, ...]]:
    """Return files that are read unchanged, by their extension."""
    rows: list[list[float]] = np.column_stack([_T, _U, _Y]).tolist()
    stated = {"Voltage": {"unit_string": "V"}, "Position": {"unit_string": "um"}}
    waves = {n: {**u, "wf_increment": 0.125} for n, u in stated.items()}
    clock = {"Time": {"unit_string": "s"}, **stated}
    channels = {"Voltage": _U, "Position": _Y}
    arrays: dict[str, Any] = {"time": _T, "voltage": _U, "displacement_um": _Y}
    log = {"log": {"u": _U.astype("f4"), "name": "piezo", "m": np.column_stack([_T, _U])}}
    more: dict[str, Any] = {**arrays, **log, "cells": np.array(["a", 1.0], dtype=object)}
    fields = named(_T, _U, _Y)
    units = {"a/t": "s", "a/u": "V", "a/x": "um"}
    columns = dict(zip(_HEADER, (_T, _U, _Y), strict=True))
    lines = [r[1:] for r in rows]
    return {
        ".csv": _texts(rows),
        ".mat": (
            mat(arrays, "4"), mat(arrays), mat(more, do_compression=True, oned_as="column"),
            hdf5({n: np.atleast_2d(a) for n, a in arrays.items()}, {}, userblock_size=512),
        ),
        ".parquet": (
            parquet(columns, compression="none"),
            parquet(columns, compression="snappy", use_dictionary=False, row_group_size=7),
            parquet({**columns, "note": ["x"] * _N}, compression="gzip",
                    data_page_version="2.0", write_page_checksum=True),
        ),
        ".xlsx": (xlsx([_HEADER, *rows]), xlsx([["gain", 2]], [[], _HEADER, *rows])),
        ".tdms": (tdms(channels, waves), tdms({"Time": _T, **channels}, clock)),
        ".h5": (
            hdf5(dict(zip(units, (_T, _U, _Y), strict=True)), units),
            hdf5({"log": fields}, {}, {"fs": 8.0}, compression="gzip", chunks=(6,)),
        ),
        ".npz": (npz(arrays), npz({"log": fields}, zipfile.ZIP_STORED)),
        ".npy": (npy(fields),),
        ".lvm": (
            lvm(["Voltage", "Position"], rows, units=["V", "um"]),
            lvm(["Voltage (V)", "Position (um)"], rows, columns="Multi"),
            lvm(["Voltage", "Position"], lines, columns="No", units=["V", "um"], step=0.125),
        ),
        ".dat": (gcs(["voltage [V]", "Current Position of axis 1 [um]"], lines),),
    }  # fmt: skip


def _texts(rows: list[list[float]]) -> tuple[bytes, ...]:
    """Return CSV files: units, separators, decimals, comments, quotes, missing cells, columns."""
    plain = "\n".join(f"{t},{u},{y}" for t, u, y in rows)
    comma = plain.replace(",", ";").replace(".", ",")
    wide = "\n".join(f"{y},{t},{u},{u / 9:.3f},0.5,{20 + y}" for t, u, y in rows)
    holes = "\n".join(f"{t},{u},{y if k not in (3, 4) else ''}" for k, (t, u, y) in enumerate(rows))
    quoted = "\n".join(f'"{t}","{u}","{y}"' for t, u, y in rows)
    header = ",".join(_HEADER)
    texts = (
        f"{header}\n{plain}\n",
        f"# made by hand\n\ntime [ms],voltage [mV],displacement [nm]\n{plain}\n",
        f"{header.replace(',', ';')}\n{comma}\n",
        "displacement [um],time [s],voltage [V],load_force [N],current [A],temperature [K]\n"
        + wide,
        f"{header}\n{holes}\n",
        f'"time [s]","voltage [V]","displacement [counts]"\n{quoted}\n',
        "time [min]\tvoltage [kV]\tdisplacement [µm]\n" + plain.replace(",", "\t"),
    )
    return tuple(text.encode() for text in texts)


def _record_file(suffix: str, rng: Random) -> bytes:
    """Damage a file as its form asks for: by cells, by parts of an archive, by its footer."""
    data = rng.choice(sound_files()[suffix])
    kind = rng.random()
    if suffix in (".csv", ".lvm", ".dat") and kind < 0.7:
        return damaged_table(data.decode(), rng)
    if suffix in (".xlsx", ".npz") and kind < 0.7:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = {name: archive.read(name) for name in archive.namelist()}
        name = rng.choice(list(parts))
        parts[name] = damaged_bytes(parts[name], rng, (b"<", b">", b"&", b'"', b"<row>", b"f8"))
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
            for part, content in parts.items():
                archive.writestr(zipfile.ZipInfo(part), content)
        return stream.getvalue()
    if suffix == ".parquet" and kind < 0.7:  # what describes the columns, with its length
        start = len(data) - 8 - struct.unpack_from("<I", data, len(data) - 8)[0]
        footer = damaged_bytes(data[start:-8], rng)
        return data[:start] + footer + struct.pack("<I", len(footer)) + b"PAR1"
    return damaged_bytes(data, rng, _MARKS)


def _read(suffix: str, data: bytes, folder: Path) -> Iterator[Finding]:
    """Read a record and yield what is unsound in it."""
    path = folder / f"r{suffix}"
    path.write_bytes(data)
    with patch.object(apart, "read_apart", read_by_fork):
        record = psa.read_record(path)
    yield from _unsound(record)


def _unsound(record: psa.Record) -> Iterator[Finding]:
    """Yield what a record that was read may not be: short, uneven, not finite, back in time."""
    for name in COLUMNS:
        values = getattr(record, name)
        if values is None:
            continue
        if values.shape != record.time.shape or values.dtype != np.float64:
            yield Finding(FALSE_PASS, f"the {name} has shape {values.shape} and {values.dtype}")
        elif np.isinf(values).any() or (name != "displacement" and np.isnan(values).any()):
            yield Finding(FALSE_PASS, f"the {name} of a record that was read is not finite")
    if record.time.size < 16 or not (np.diff(record.time) > 0).all():
        yield Finding(
            FALSE_PASS, "the time of a record that was read does not increase or is short"
        )
    if record.displacement is None or np.isfinite(record.displacement).sum() < 16:
        yield Finding(FALSE_PASS, "a record that was read has too few displacements")


def _words(texts: tuple[str, ...], words: tuple[str, ...], rng: Random) -> bytes:
    return damaged_words(rng.choice(texts), rng, words).encode("utf-8", "replace")


def _parse_unit(data: bytes, _: Path) -> Iterator[Finding]:
    text = data.decode()
    unit = parse_unit(text)
    if not (unit.ratio > 0 and unit.name and math.isfinite(unit.factor)):
        yield Finding(FALSE_PASS, f"a unit has the factor {unit.factor}")
    coherent = si_unit(text)
    if convert(convert(1.0, text, coherent), coherent, text) - 1.0 > 1e-9:
        yield Finding(FALSE_PASS, "a unit does not convert back")


def _parse_map(data: bytes, folder: Path) -> Iterator[Finding]:
    """Read a column map, then a sound file with it."""
    for name, source in parse_columns(data.decode()).items():
        if name not in COLUMNS or not source.array:
            yield Finding(FALSE_PASS, f"a column map holds {name!r}={source.array!r}")
    path = folder / "mapped.csv"
    rows = sound_files()[".csv"][3].decode().partition("\n")[2]
    path.write_text(f"{_OTHER_NAMES}\n{rows}", encoding="utf-8")
    yield from _unsound(psa.read_record(path, columns=data.decode()))


@cache
def model_trees() -> tuple[Any, ...]:
    """Return the content of sound model files: stacks, effects, parts, other models, evidence."""
    base = model_named("manipulator")
    origin = Provenance(
        identified_from=(("a.csv", "0" * 64),), package_version="0.1.0", free=("A", "C_p"),
        intervals={"A": Interval(0.1, 0.2)}, force_scale="measured", notes=("µm", ""),
    )  # fmt: skip
    models = [
        base,
        base.with_values({}, provenance=origin),
        base.with_starts({base.state_names[0]: 1e-9, "voltage": 3.0}),
        evident_model(),
        *(model_named(name) for name in ("single_mass", "flexure", "every_effect")),
        *(base.with_effect(e) for e in psa.EFFECTS.values()),
        *(psa.stack_model(name) for name in psa.STACKS),
        *(psa.part_model(name) for name in psa.PARTS),
        *(with_ports(make()) for make in (cylinder, motor, oscillator, oven, pair, tanks)),
    ]
    trees = [json.loads(dumps(m)) for m in models]
    return (*trees, {"format": "psa_casadi.diagnosis/1", "verdict": "adequate", "causes": []})


def _load_model(data: bytes, folder: Path) -> Iterator[Finding]:
    """Load a model, which is saved and loads equal; some are described as FMUs, which is slow."""
    first, second = folder / "first.json", folder / "second.json"
    first.write_bytes(data)
    model = psa.load_model(first)
    psa.save_model(model, second)
    again = psa.load_model(second)
    for what in ("values", "provenance", "evidence", "name", "description"):
        if getattr(again, what) != getattr(model, what):
            yield Finding(FALSE_PASS, f"a model that was loaded is saved with other {what}")
    if [c.name for c in again.components] != [c.name for c in model.components]:
        yield Finding(FALSE_PASS, "a model that was loaded is saved with other components")
    if again.changed_starts() != model.changed_starts():
        yield Finding(FALSE_PASS, "a model that was loaded is saved with other starts")
    if dumps(again) != second.read_text(encoding="utf-8"):
        yield Finding(FALSE_PASS, "a model that was loaded is saved in another way the second time")
    if zlib.crc32(data) % 16 == 0:
        plant = model.plant()
        texts = {f"FMI {n}": model_description(plant, "m", "x", ["m.c"], n) for n in (2, 3)}
        files = evidence_texts(plant, 2).items()
        texts |= {n: text for n, text in files if n.endswith((".ssv", ".srmd", ".exp"))}
        yield from _not_in_numbers(texts)


def _not_in_numbers(texts: dict[str, str]) -> Iterator[Finding]:
    """Yield which of the files that an FMU has are no XML, or hold no finite numbers."""
    for name, text in texts.items():
        try:
            root = ET.fromstring(text.encode("utf-8"))
        except (ET.ParseError, UnicodeEncodeError) as error:
            yield Finding(FALSE_PASS, f"{name} is no XML: '{error}'")
            continue
        keys = ("start", "nominal", "min", "max") if name.startswith("FMI") else ("value",)
        values = [float(e.get(key, "0").split()[0]) for e in root.iter() for key in keys]
        if not np.isfinite(values).all():
            yield Finding(FALSE_PASS, f"{name} has a value that is not finite")


def _path_text(rng: Random) -> bytes:
    rows = [(k / 100, round(5 - 5 * math.cos(k / 2), 3)) for k in range(12)]
    plain = "time [s],displacement [um]\n" + "\n".join(f"{t},{y}" for t, y in rows)
    comma = plain.replace(",", ";").replace(".", ",")
    return damaged_table(rng.choice((plain, comma)), rng)


def _read_path(data: bytes, folder: Path) -> Iterator[Finding]:
    file = folder / "target.csv"
    file.write_bytes(data)
    target = read_target(file)
    if not (np.isfinite(target.time).all() and np.isfinite(target.displacement).all()):
        yield Finding(FALSE_PASS, "a path that was read is not finite")
    elif target.time.size < 10 or not (np.diff(target.time) > 0.0).all():
        yield Finding(FALSE_PASS, "the time of a path that was read does not increase or is short")
    elif not (0.0 < target.span < np.inf):
        yield Finding(FALSE_PASS, "a path that was read has no finite span")


_SHARES = {".csv": 4.0, ".mat": 4.0, ".parquet": 1.5, ".xlsx": 2.0, ".tdms": 1.5, ".h5": 0.5,
           ".npz": 0.5, ".npy": 0.5, ".lvm": 1.0, ".dat": 0.5}  # fmt: skip
TARGETS = (
    *(
        Target(f"records-{suffix[1:]}", "readers", suffix, partial(_record_file, suffix),
               partial(_read, suffix), share, prepare=sound_files)
        for suffix, share in _SHARES.items()
    ),
    Target("column-maps", "readers", ".txt", partial(_words, _MAPS, _MAP_WORDS), _parse_map,
           prepare=sound_files),
    Target("units", "readers", ".txt", partial(_words, _UNIT_TEXTS, _UNIT_WORDS), _parse_unit),
    Target("models", "files", ".json", lambda rng: damaged_json(rng.choice(model_trees()), rng),
           _load_model, 3.0, prepare=model_trees),
    Target("paths", "files", ".csv", _path_text, _read_path),
)  # fmt: skip
