"""What `psa batch` keeps of a device: how its work ended, of which files and options."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

FORMAT: Literal["psa_casadi.device/1"] = "psa_casadi.device/1"
Work = Literal["identify", "diagnose"]
Status = Literal["done", "refused", "failed"]


@dataclass(frozen=True)
class DeviceRecord:
    """A record of the device, with the SHA-256 of its file."""

    name: str
    sha256: str


@dataclass(frozen=True)
class DeviceFile:
    """A device of a batch run: how its work ended, and the hash of files and options it is for.

    `refused` says that the records cannot be used, `failed` that something else went wrong; it is
    tried again by the next run. `sha256` are those of `files`, as they were written.
    """

    format: Literal["psa_casadi.device/1"]
    device: str
    batch: str
    date: str
    work: Work
    status: Status
    problems: tuple[str, ...]
    seconds: float
    key: str
    package_version: str
    records: tuple[DeviceRecord, ...]
    files: tuple[str, ...]
    sha256: tuple[str, ...] = ()


def damage(folder: Path, told: DeviceFile) -> str:
    """Return what is wrong with the files in a device's folder; "" where they are as written."""
    for name, sha256 in zip(told.files, told.sha256, strict=False):
        path = folder / name
        try:
            found = hash_of(path.read_bytes())
        except OSError as error:
            return f"{path}: cannot be read ({error.strerror}); run `psa batch` again."
        if found != sha256:
            return f"{path}: is damaged, as it is not what was written; run `psa batch` again."
    return ""


def hash_of(content: bytes) -> str:
    """Return the SHA-256 by which the content of a file is known again."""
    return hashlib.sha256(content).hexdigest()
