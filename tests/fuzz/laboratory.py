"""The readers of laboratory files: workbooks, TDMS, HDF5, NumPy and LabVIEW's text, damaged."""

import io
import zipfile
from collections.abc import Callable
from functools import cache, partial
from random import Random

import numpy as np

from tests.fuzz.archives import damaged_xml
from tests.fuzz.mutators import damaged_bytes, damaged_table
from tests.fuzz.readers import ROOM, read
from tests.fuzz.target import Target
from tests.laboratory_bytes import gcs, hdf5, lvm, named, npy, npz, tdms, xlsx

_N = 18
_T = np.arange(_N) / 8.0
_U = np.round(50.0 * np.sin(_T), 3)
_Y = np.round(5.0 * np.cos(_T), 4)
_ROWS: list[list[float]] = np.column_stack([_T, _U, _Y]).tolist()
_NAMED = {"time": _T, "voltage": _U, "displacement_um": _Y}
_STATED = {"Voltage": {"unit_string": "V"}, "Position": {"unit_string": "um"}}


@cache
def sound_files() -> dict[str, tuple[bytes, ...]]:
    """Return files that are read as they are, by their ending."""
    header = ["Time (s)", "Voltage (V)", "Position (um)"]
    waves = {n: {**u, "wf_increment": 0.125} for n, u in _STATED.items()}
    channels = {"Voltage": _U, "Position": _Y}
    fields = named(_T, _U, _Y)
    units = {"a/t": "s", "a/u": "V", "a/x": "um"}
    return {
        ".xlsx": (xlsx([header, *_ROWS]), xlsx([["gain", 2]], [[], header, *_ROWS])),
        ".tdms": (
            tdms(channels, waves),
            tdms({"Time": _T, **channels}, {"Time": {"unit_string": "s"}, **_STATED}),
        ),
        ".h5": (
            hdf5(dict(zip(units, (_T, _U, _Y), strict=True)), units),
            hdf5({"log": fields}, {}, {"fs": 8.0}, compression="gzip", chunks=(6,)),
        ),
        ".npz": (npz(_NAMED), npz({"log": fields}, zipfile.ZIP_STORED)),
        ".npy": (npy(fields),),
        ".lvm": (
            lvm(["Voltage", "Position"], _ROWS, units=["V", "um"]),
            lvm(["Voltage (V)", "Position (um)"], _ROWS, columns="Multi"),
            lvm(
                ["Voltage", "Position"],
                [r[1:] for r in _ROWS],
                columns="No",
                units=["V", "um"],
                step=0.125,
            ),
        ),
        ".dat": (gcs(["voltage [V]", "Current Position of axis 1 [um]"], [r[1:] for r in _ROWS]),),
    }


def _raw(suffix: str, rng: Random) -> bytes:
    return damaged_bytes(rng.choice(sound_files()[suffix]), rng, (b"TDSm", b"TREE", b"f8", b"wf_"))


def _text(suffix: str, rng: Random) -> bytes:
    text = rng.choice(sound_files()[suffix]).decode()
    return damaged_table(text, rng).encode("utf-8", "replace")


def _zipped(suffix: str, rng: Random) -> bytes:
    """Damage a part of an archive, which is packed again; or the archive."""
    data = rng.choice(sound_files()[suffix])
    if rng.random() < 0.3:
        return damaged_bytes(data, rng)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(parts))
    by_words = name.endswith((".xml", ".rels")) and rng.random() < 0.7
    parts[name] = damaged_xml(parts[name], rng) if by_words else damaged_bytes(parts[name], rng)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for own, content in parts.items():
            archive.writestr(zipfile.ZipInfo(own), content)
    return stream.getvalue()


def _target(suffix: str, make: Callable[[str, Random], bytes], share: float) -> Target:
    return Target(
        f"records-{suffix[1:]}",
        ROOM,
        suffix,
        partial(make, suffix),
        partial(read, f"r{suffix}"),
        share,
        prepare=sound_files,
    )


TARGETS = (
    _target(".xlsx", _zipped, 2.0),
    _target(".tdms", _raw, 1.5),
    _target(".h5", _raw, 0.5),
    _target(".npz", _zipped, 0.5),
    _target(".npy", _raw, 0.5),
    _target(".lvm", _text, 1.0),
    _target(".dat", _text, 0.5),
)
