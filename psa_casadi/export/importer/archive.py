"""The files of an FMU of either version, extracted, and what its description says."""

import math
import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import fmpy

from psa_casadi.errors import InputError
from psa_casadi.export.importer import fmi2_functions, fmi3_functions
from psa_casadi.export.importer.unpack import unpack
from psa_casadi.scratch import temporary_folder

#: The functions of each version of the standard, without their prefix.
FUNCTIONS = {2: fmi2_functions.FUNCTIONS, 3: fmi3_functions.FUNCTIONS}
#: Longest text that is read as a whole [bytes], and which these are.
LONGEST_TEXT = 64 << 20
_TEXTS = ("modelDescription.xml", "resources/model.json")
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z_0-9]*")
_LIBRARY = re.compile(r".*\.(so|dll|dylib)")


class Archive:
    """An extracted FMU; a context manager that removes the extracted files.

    One that is unpacked already, in the folder `unpacked`, is left there.

    `version` is 2 or 3, `description` fmpy's record of the XML. `references`, `nominals` and
    `bounds` map the names of variables to value references, nominal values, and the least and the
    greatest value, infinite where there is no bound. `step_size` is that of the default experiment
    [s], 1 ms if there is none.

    Raises InputError if the file is no FMU of FMI 2.0 or FMI 3.0, or must not be unpacked.
    """

    def __init__(self, path: Path, unpacked: Path | None = None) -> None:
        self.path = path
        self._held = ExitStack()
        try:
            self.directory = unpacked or self._unpacked()
            self._require_readable()
            self.description: Any = fmpy.read_model_description(str(self.directory), validate=False)
            self._read()
        except Exception as error:  # fmpy raises it for any damage
            self._held.close()
            if isinstance(error, InputError):
                raise
            problem = f"{path}: cannot be read as an FMU ({error}); export it again."
            raise InputError(problem) from error

    def _unpacked(self) -> Path:
        """Return a temporary folder with the files of the archive."""
        place = self._held.enter_context(temporary_folder())
        unpack(self.path, place)
        return place

    def _require_readable(self) -> None:
        """Raise InputError if a text is so long that what is read of it would fill the memory."""
        for name in _TEXTS:
            place = self.directory / name
            if place.is_file() and place.stat().st_size > LONGEST_TEXT:
                raise InputError(
                    f"{self.path}: {name} has more than {LONGEST_TEXT >> 20} MiB and is not read;"
                    " export the FMU again."
                )

    def _read(self) -> None:
        """Read what the description says first; raises InputError if it is of no known kind."""
        said = str(self.description.fmiVersion)
        interface = self.description.coSimulation or self.description.modelExchange
        if said[:2] not in ("2.", "3.") or interface is None:
            raise InputError(
                f"{self.path}: is of FMI {said} or has no interface that is known; export it again"
                " with --fmi 2 or --fmi 3."
            )
        self.version = int(said[0])
        self.identifier = str(interface.modelIdentifier)
        if not _IDENTIFIER.fullmatch(self.identifier):  # it names the file that is loaded
            raise InputError(
                f"{self.path}: its model identifier {self.identifier!a} is no name in C; export it"
                " again."
            )
        self.references = {v.name: int(v.valueReference) for v in self.description.modelVariables}
        self.nominals = {
            v.name: 1.0 if v.nominal is None else float(v.nominal)
            for v in self.description.modelVariables
        }
        self.bounds = {
            v.name: (
                -math.inf if v.min is None else float(v.min),
                math.inf if v.max is None else float(v.max),
            )
            for v in self.description.modelVariables
        }
        experiment = self.description.defaultExperiment
        self.step_size = float(getattr(experiment, "stepSize", None) or 1e-3)
        self._states = [str(u.variable.derivative.name) for u in self.description.derivatives]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def interfaces(self) -> tuple[int, ...]:
        """Return which of co-simulation (1) and model exchange (0) the description announces."""
        said = ((1, self.description.coSimulation), (0, self.description.modelExchange))
        return tuple(kind for kind, announced in said if announced is not None)

    @property
    def resources(self) -> Path:
        """The folder of the FMU's own files, absolute; it need not exist."""
        return self.directory.absolute() / "resources"

    @property
    def prefix(self) -> str:
        """What the names of all C functions start with."""
        return f"fmi{self.version}"

    @property
    def token(self) -> str:
        """The GUID (FMI 2.0) or instantiation token (FMI 3.0)."""
        return str(self.description.guid)

    def tunable(self) -> list[str]:
        """Return the names of the parameters that may be set between steps."""
        return [v.name for v in self.description.modelVariables if v.variability == "tunable"]

    def constants(self) -> list[str]:
        """Return the names of the constants."""
        return [v.name for v in self.description.modelVariables if v.variability == "constant"]

    def names(self, causality: str) -> list[str]:
        """Return the names of the variables of one causality, in the order of the description."""
        return [v.name for v in self.description.modelVariables if v.causality == causality]

    def states(self) -> list[str]:
        """Return the names of the continuous states, in the order of the state vector."""
        return list(self._states)

    def sampled(self) -> list[str]:
        """Return the names of the sampled states: local variables that are discrete."""
        variables = self.description.modelVariables
        found = (v for v in variables if v.causality == "local" and v.variability == "discrete")
        return [v.name for v in found]

    def indicators(self) -> list[str]:
        """Return the names of the variables that repeat the event indicators, in their order."""
        names = (v.name for v in self.description.modelVariables)
        return [n for n in names if n.startswith("switch.")]

    def indicator_count(self) -> int:
        """Return how many event indicators the description announces."""
        if self.version == 3:
            return len(self.description.eventIndicators)
        return int(self.description.numberOfEventIndicators or 0)

    def binaries(self) -> Iterator[Path]:
        """Yield the paths of the libraries for all platforms, sorted."""
        for path in sorted((self.directory / "binaries").rglob("*")):
            if path.is_file() and _LIBRARY.fullmatch(path.name):
                yield path

    def host_binary(self) -> Path | None:
        """Return the path of the library for this machine, if there is one."""
        folders = (fmpy.platform_tuple, fmpy.platform)[: 1 if self.version == 3 else 2]
        name = self.identifier + fmpy.sharedLibraryExtension
        places = [self.directory / "binaries" / folder / name for folder in folders]
        return next((p for p in places if p.is_file()), None)
