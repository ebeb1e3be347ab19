"""Public records of piezo stacks, each with source, licence and SHA-256.

    import psa_casadi as psa

    records = psa.datasets.micromanipulator()

A record is taken from `$PSA_CASADI_DATA/NAME/` where that variable is set, and otherwise downloaded
once from its authors and kept in the user's cache folder. Either way the file must have the SHA-256
that `DATASETS` gives. Where the authors publish another format, what is kept is the CSV file that
the conversion stated with the record makes of it, byte for byte.
"""

from psa_casadi.datasets.devices import DATASETS, Dataset, DatasetFile
from psa_casadi.datasets.fetching import copy, find, origin_text, originals, paths
from psa_casadi.records import Record, read_records

__all__ = [
    "DATASETS",
    "Dataset",
    "DatasetFile",
    "copy",
    "find",
    "load",
    "micromanipulator",
    "origin_text",
    "originals",
    "paths",
    "steering_mirror",
]


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
