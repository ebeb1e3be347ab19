"""The binary of an FMU, loaded."""

import ctypes
from ctypes import c_char_p, c_int, c_void_p
from pathlib import Path

from psa_casadi.errors import InputError
from psa_casadi.export.importer.archive import FUNCTIONS, Archive
from psa_casadi.export.importer.binary_file import read_binary

#: Functions that do not return a status, by what they return.
_POINTERS = (
    "Instantiate", "InstantiateModelExchange", "InstantiateCoSimulation",
    "InstantiateScheduledExecution",
)  # fmt: skip
_RETURNS = {**dict.fromkeys(_POINTERS, c_void_p), "FreeInstance": None,
            "GetVersion": c_char_p, "GetTypesPlatform": c_char_p}  # fmt: skip


class Library(Archive):
    """An extracted FMU with its binary loaded; a context manager that removes the extracted files.

    Raises InputError if the file is no FMU, or has no binary for this machine, or a damaged one.
    """

    def __init__(self, path: Path, unpacked: Path | None = None) -> None:
        super().__init__(path, unpacked)
        try:
            self.library = self._load()
        except InputError:
            self._held.close()
            raise
        for name in FUNCTIONS[self.version]:
            if hasattr(self.library, self.prefix + name):
                returned = _RETURNS.get(name, c_int)
                getattr(self.library, self.prefix + name).restype = returned

    def _load(self) -> ctypes.CDLL:
        binary = self.host_binary()
        if binary is None:
            raise InputError(
                f"{self.path}: has no binary for this machine; export it for this platform."
            )
        read_binary(binary)
        try:
            return ctypes.CDLL(str(binary))
        except OSError as error:
            raise InputError(
                f"{self.path}: its binary cannot be loaded ({error}); export it here."
            ) from error
