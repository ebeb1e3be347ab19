"""Public records of piezo stacks, each with source, licence and SHA-256.

    import psa_casadi as psa

    records = psa.datasets.micromanipulator()

A record is taken from `$PSA_CASADI_DATA/NAME/` where that variable is set, and otherwise downloaded
once from its authors and kept in the user's cache folder. Either way the file must have the SHA-256
that `DATASETS` gives. Where the authors publish another format, what is kept is the CSV file that
the conversion stated with the record makes of it, byte for byte.
"""

import difflib
import hashlib
import os
from pathlib import Path

from psa_casadi.common.cache import writable_room
from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.files import atomic_write, make_folder
from psa_casadi.datasets.devices import DATASETS as DATASETS
from psa_casadi.datasets.devices import Dataset as Dataset
from psa_casadi.datasets.devices import DatasetFile as DatasetFile
from psa_casadi.datasets.devices import Original
from psa_casadi.records import Record, read_records

#: Names the folder with the records of a machine that downloads nothing.
DATA_VARIABLE = "PSA_CASADI_DATA"


def micromanipulator() -> list[Record]:
    """Return the measured records of a piezo micromanipulator (Aye and Ang 2018).

    Raises:
        InputError: a file in `$PSA_CASADI_DATA` is missing or is not the published one.
        PsaError: a file cannot be downloaded, or what came is not the published one.
    """
    return load("micromanipulator")


def steering_mirror() -> list[Record]:
    """Return one record of each axis and level of a steering mirror (Floren et al. 2024).

    Raises: as `micromanipulator`.
    """
    return load("steering_mirror")


def load(name: str) -> list[Record]:
    """Return the records of a dataset, in its order.

    Raises:
        InputError: no such dataset, or a file in `$PSA_CASADI_DATA` is missing or differs.
        PsaError: a file cannot be downloaded, or what came differs from what was published.
    """
    return list(read_records(paths(name)))


def find(name: str) -> Dataset:
    """Return the dataset of that name. Raises InputError: there is none."""
    if name not in DATASETS:
        near = difflib.get_close_matches(name.lower(), DATASETS, n=1, cutoff=0.4)
        meant = f"did you mean {near[0]}?" if near else f"there are {', '.join(DATASETS)}."
        raise InputError(f"There is no dataset named '{name}'; {meant}")
    return DATASETS[name]


def paths(name: str) -> list[Path]:
    """Return the verified CSV files of a dataset, downloaded where that is needed.

    Raises:
        InputError: no such dataset, or a file in `$PSA_CASADI_DATA` is missing or differs.
        PsaError: a file cannot be downloaded, or what came differs from what was published.
    """
    dataset = find(name)
    return [_path(dataset, file) for file in dataset.files]


def copy(name: str, folder: str | os.PathLike[str]) -> list[Path]:
    """Write the CSV files of a dataset to a folder, with source and licence; return what is there.

    Raises:
        InputError: as `paths`, or the folder cannot be written to.
        PsaError: as `paths`.
    """
    dataset, target = find(name), Path(folder)
    make_folder(target)
    content: dict[str, bytes | str] = {path.name: path.read_bytes() for path in paths(name)}
    content[f"{name}_licence.txt"] = origin_text(dataset)
    for file, data in content.items():
        atomic_write(target / file, data)
    return [target / file for file in content]


def originals(name: str) -> dict[str, Path]:
    """Return the verified originals of a dataset by name, downloaded where that is needed.

    Raises:
        InputError: no such dataset, or a file in `$PSA_CASADI_DATA` is missing or differs.
        PsaError: a file cannot be downloaded, or what came differs from what was published.
    """
    dataset = find(name)
    data = os.environ.get(DATA_VARIABLE)
    folder = Path(data) / name if data else _room(dataset)
    return {
        k: _from_folder(folder, dataset, k, o.sha256, f"download {o.url} to it")
        if data
        else _download(o, folder)
        for k, o in dataset.originals.items()
    }


def origin_text(dataset: Dataset) -> str:
    """Return source, citation, what was taken, and licence, as they go with every copy."""
    files = "\n".join(f"{o.url} (SHA-256 {o.sha256})" for o in dataset.originals.values())
    taken = "\n".join(
        f"{f.name}: {f.description}. From {', '.join(o.name for o in f.originals)}:"
        f" {f.conversion.words}."
        for f in dataset.files
    )
    return (
        f"{dataset.name}: {dataset.description}.\nSource: {dataset.source}\n"
        f"Citation: {dataset.citation}\n\n{taken}\n\n{files}\n\n{dataset.licence_text}"
    )


def _path(dataset: Dataset, file: DatasetFile) -> Path:
    data = os.environ.get(DATA_VARIABLE)
    if data:
        folder = Path(data) / dataset.name
        how = f"run `psa datasets {dataset.name} -o {folder}` without {DATA_VARIABLE}"
        return _from_folder(folder, dataset, file.name, file.sha256, how)
    room = _room(dataset)
    kept = room / file.name
    if kept.is_file() and _sha256(kept.read_bytes()) == file.sha256:
        return kept
    content = file.conversion.csv([_download(o, room).read_bytes() for o in file.originals])
    if _sha256(content) != file.sha256:
        raise PsaError(
            f"{file.name}: the conversion of {file.originals[-1].url} has changed; report it."
        )
    atomic_write(kept, content)
    return kept


def _room(dataset: Dataset) -> Path:
    return writable_room("datasets") / dataset.name


def _from_folder(folder: Path, dataset: Dataset, name: str, sha256: str, how: str) -> Path:
    path = folder / name
    if not path.is_file():
        raise InputError(
            f"{path}: there is no such file, but {DATA_VARIABLE} names its folder; {how}"
            f" on a machine with a network, or unset {DATA_VARIABLE}."
        )
    if _sha256(path.read_bytes()) != sha256:
        raise InputError(
            f"{path}: is not the published record, its SHA-256 differs from {sha256}; it was"
            f" changed or damaged: fetch it again from {dataset.source}."
        )
    return path


def _download(original: Original, folder: Path) -> Path:
    """Return the path of the original in `folder`, downloaded and verified."""
    import pooch  # noqa: PLC0415 - slow to import, and needed for a download only

    pooch.get_logger().setLevel("WARNING")
    try:
        sha, name = f"sha256:{original.sha256}", original.name
        return Path(pooch.retrieve(original.url, sha, fname=name, path=folder))
    except ValueError as error:
        raise PsaError(
            f"{original.url}: what was downloaded is not the published file, its SHA-256 differs"
            f" from {original.sha256}; a proxy's page in its place is the likely cause: try again,"
            f" or open the address in a browser."
        ) from error
    except OSError as error:
        raise PsaError(
            f"{original.url}: cannot be downloaded ({type(error).__name__}); connect to a network,"
            f" or set {DATA_VARIABLE} to a folder that holds the records (`psa datasets --help`)."
        ) from error


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
