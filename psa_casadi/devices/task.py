"""What is to be done with every device, and the hash by which a result is known again."""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from psa_casadi.devices.jobs import Job
from psa_casadi.identification.start.ordinary import Hysteresis
from psa_casadi.report.documents.device_file import Status, Work
from psa_casadi.version import __version__

_BLOCK = 2**20


@dataclass(frozen=True)
class Options:
    """How every device is worked on; plain values, so that a process elsewhere can take them.

    `model` is the text of the MODEL.json to start from, `stiffness` in N/m, `columns` and
    `sample_time` [s] as for `read_record`, `modules` those that hold own effects.
    """

    work: Work = "identify"
    model: str | None = None
    stiffness: float | None = None
    hysteresis: Hysteresis | None = None
    columns: str | None = None
    sample_time: float | None = None
    modules: tuple[str, ...] = ()


@dataclass(frozen=True)
class DeviceTask:
    """One device with all that its work needs; `run` names the run that it belongs to."""

    job: Job
    options: Options
    run: str


@dataclass(frozen=True)
class DeviceOutcome:
    """How the work on a device ended: files by their names, or problems in sentences."""

    device: str
    status: Status
    seconds: float
    files: tuple[tuple[str, str], ...] = ()
    problems: tuple[str, ...] = ()
    records: tuple[tuple[str, str], ...] = ()


def key_of(job: Job, options: Options) -> str:
    """Return the SHA-256 of a device's files, the options, and the version of this package.

    Raises:
        OSError: a file cannot be read.
    """
    files = [(Path(name).name, _hash(Path(name))) for name in job.files]
    told = {"version": __version__, "options": asdict(options), "files": files}
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _hash(path: Path) -> str:
    found = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            found.update(block)
    return found.hexdigest()
