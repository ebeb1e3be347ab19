"""What `psa batch` keeps of a device: how its work ended, of which files and options."""

from dataclasses import dataclass
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
    tried again by the next run.
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
