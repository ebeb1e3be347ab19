"""The folder of a batch's results: a folder for each device, and tables over all of them.

    RESULTS/
      DEVICE/device.json          how its work ended, for which files and options
      DEVICE/identification.json  or diagnosis.json: what was found
      DEVICE/model.json           the model
      summary.csv                 one row for each device; summary.parquet where pyarrow is

Every file is written whole or not at all, device.json last: without it a device is done again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from psa_casadi.component import Component
from psa_casadi.devices.jobs import DeviceOutcome, Job, Options
from psa_casadi.errors import InputError
from psa_casadi.files import atomic_write
from psa_casadi.population.finding import Finding
from psa_casadi.report.documents.device_file import (
    FORMAT,
    DeviceFile,
    DeviceRecord,
    damage,
    hash_of,
)
from psa_casadi.report.documents.findings import DEVICE_FILE, device_finding
from psa_casadi.report.documents.read_document import read_document
from psa_casadi.strict_json import json_text, parse_json, read_json_text
from psa_casadi.version import __version__


class Results:
    """The results in a folder, which is made where it is not there.

    Raises:
        InputError: the folder cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        _make(folder)

    def kept(self, job: Job, key: str) -> DeviceFile | None:
        """Return how a device ended if that holds for the same files and options, else None."""
        told = self.told(job.device)
        if told is None or told.key != key or told.status == "failed":
            return None
        whole = len(told.sha256) == len(told.files) and not damage(self.folder / job.device, told)
        return told if whole else None

    def told(self, device: str) -> DeviceFile | None:
        """Return how a device ended, None where that is not known."""
        path = self.folder / device / DEVICE_FILE
        try:
            content = parse_json(read_json_text(path), str(path), "the device is done again.")
            return read_document(DeviceFile, content, str(path))
        except (OSError, ValueError):  # never done, or damaged
            return None

    def write(self, job: Job, options: Options, key: str, outcome: DeviceOutcome) -> DeviceFile:
        """Write the files of a device, and last how it ended.

        Raises:
            InputError: they cannot be written.
        """
        here = self.folder / job.device
        _make(here)
        (here / DEVICE_FILE).unlink(missing_ok=True)
        for name, text in outcome.files:
            atomic_write(here / name, text)
        told = DeviceFile(
            FORMAT,
            job.device,
            job.batch,
            job.day.isoformat() if job.day else "",
            options.work,
            outcome.status,
            outcome.problems,
            round(outcome.seconds, 3),
            key,
            __version__,
            tuple(DeviceRecord(name, sha) for name, sha in outcome.records),
            tuple(name for name, _ in outcome.files),
            tuple(hash_of(text.encode()) for _, text in outcome.files),
        )
        atomic_write(here / DEVICE_FILE, json_text(asdict(told)))
        return told

    def restated(self, job: Job, told: DeviceFile) -> DeviceFile:
        """Return how a kept device ended with the batch and date that it has now, written too."""
        day = job.day.isoformat() if job.day else ""
        if (told.batch, told.date) == (job.batch, day):
            return told
        told = replace(told, batch=job.batch, date=day)
        atomic_write(self.folder / job.device / DEVICE_FILE, json_text(asdict(told)))
        return told

    def findings(
        self, devices: Sequence[DeviceFile], effects: Sequence[Component] = ()
    ) -> Iterator[tuple[DeviceFile, Finding | None]]:
        """Yield devices with what was found, None where nothing was.

        A device whose files are damaged has failed, with what is wrong among its problems.
        """
        for told in devices:
            found = None
            if told.status == "done":
                try:
                    found = device_finding(self.folder / told.device, told, effects)
                except ValueError as error:
                    yield replace(told, status="failed", problems=(str(error),)), None
                    continue
            yield told, found


def read_results(
    folder: Path, effects: Sequence[Component] = ()
) -> tuple[tuple[Finding, ...], tuple[tuple[str, str, str], ...]]:
    """Return the findings in a folder of results, and device, status and problems of the others.

    Raises:
        InputError: there are no devices in it.
    """
    results = Results(folder)
    names = sorted(d.name for d in folder.iterdir() if (d / DEVICE_FILE).is_file())
    devices = {name: results.told(name) for name in names}
    if not devices:
        raise InputError(
            f"{folder}: holds no results of devices; give the folder that `psa batch` wrote to, or"
            " two files or more."
        )
    rows = list(results.findings([d for d in devices.values() if d is not None], effects))
    unknown = [
        (n, "failed", f"{folder / n / DEVICE_FILE}: is damaged; run `psa batch` again.")
        for n, d in devices.items()
        if d is None
    ]
    lost = [(d.device, d.status, " ".join(d.problems)) for d, f in rows if f is None]
    return tuple(f for _, f in rows if f is not None), tuple(sorted(lost + unknown))


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be created ({error.strerror}); name another folder."
        ) from error
