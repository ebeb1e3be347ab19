"""The files of an FMU of either version, unpacked, and its description.

FMUs and SSPs come from anywhere: an archive is looked through before anything of it is written.
"""

import math
import os
import re
import stat
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Self

import fmpy

from psa_casadi.common.errors import InputError, Problems, quoted
from psa_casadi.common.files import temporary_folder

#: Most entries of an archive, and most bytes of all of them.
MOST_ENTRIES, MOST_BYTES = 10_000, 1 << 30
#: How often larger than packed an archive may be, once larger than this.
MOST_GROWTH, SMALL_BYTES = 100, 8 << 20
#: Longest text that is read as a whole [bytes], and which these are.
LONGEST_TEXT = 64 << 20
_TEXTS = ("modelDescription.xml", "resources/model.json")
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z_0-9]*")
_FLAG = "providesDirectionalDerivatives"
#: What the standard library raises on a damaged archive.
_DAMAGE = (
    zipfile.BadZipFile, zlib.error, struct.error, EOFError, ArithmeticError, LookupError,
    MemoryError, OSError, RuntimeError, ValueError,
)  # fmt: skip


def archive_problems(path: Path) -> dict[str, tuple[str, ...]]:
    """Return why a zip archive must not be unpacked, by the row of the check; nothing is written.

    Where names or sizes are wrong the content is not looked at. Raises nothing for any content.
    """
    problems = {row: Problems() for row in ("archive names", "archive size", "archive intact")}
    names, size, damage = problems.values()
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            for sentence in _wrong_names(entries):
                names.add(sentence)
            for sentence in _wrong_sizes(entries, path.stat().st_size):
                size.add(sentence)
            if not names and not size and (bad := archive.testzip()):
                damage.add(f"{bad!a} is damaged")
    except _DAMAGE as error:
        damage.add(f"the archive is damaged ({' '.join(ascii(str(error))[1:-1].split())})")
    return {row: listed.sentences() for row, listed in problems.items()}


def _wrong_names(entries: list[zipfile.ZipInfo]) -> Iterator[str]:
    """Yield entries that are no plain files at separate places inside the folder."""
    for entry in entries:
        name, mode = entry.orig_filename, entry.external_attr >> 16
        quoted = ascii(name[:80])
        if name.startswith("/") or "\\" in name or ":" in name or ".." in name.split("/"):
            yield f"{quoted} leads outside the archive's folder"
        if not name.isprintable():
            yield f"{quoted} has control characters"
        if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
            yield f"{quoted} is a link or a device"
        if entry.flag_bits & 0x1:
            yield f"{quoted} is encrypted"
    same = {(e.filename.removesuffix("/"), e.CRC, e.file_size) for e in entries}  # a repeat is none
    for place, count in Counter(name.casefold() for name, *_ in same).items():
        if count > 1:
            yield f"{place[:80]!a} names {count} entries on some file systems"


def _wrong_sizes(entries: list[zipfile.ZipInfo], packed: int) -> Iterator[str]:
    """Yield what would fill the disk or the memory."""
    if len(entries) > MOST_ENTRIES:
        yield f"it has {len(entries)} entries, more than {MOST_ENTRIES}"
    total = sum(e.file_size for e in entries)
    if total > MOST_BYTES:
        yield f"unpacked it has {total} bytes, more than {MOST_BYTES}"
    if total > max(SMALL_BYTES, MOST_GROWTH * packed):
        yield f"unpacked it is {total / packed:.0f} times as large, more than {MOST_GROWTH} times"


def unpack(path: Path, folder: Path) -> None:
    """Unpack a zip archive into an empty folder.

    Raises InputError, before anything is written, if the archive has any of `archive_problems`.
    """
    problems = [p for result in archive_problems(path).values() for p in result]
    if problems:
        raise InputError(f"{path}: {'; '.join(problems)}.")
    try:
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
    except _DAMAGE as error:
        raise InputError(f"{path}: cannot be unpacked ({str(error)!a}).") from error


#: Types whose values are no numbers.
_NO_NUMBERS = ("String", "Binary", "Clock")


@dataclass(frozen=True)
class Element:
    """One number of a variable: an element of an array, or all there is of a scalar.

    `place` is its place among the `count` values of the variable, whose starts are `starts`.
    """

    variable: str
    type: str
    reference: int
    place: int
    count: int
    starts: tuple[float, ...]

    @property
    def start(self) -> float:
        """The start value."""
        return self.starts[self.place]

    @property
    def real(self) -> bool:
        """Whether it is a floating point number."""
        return self.type in ("Real", "Float64", "Float32")


class Archive:
    """An unpacked FMU; a context manager that removes the files.

    One that is unpacked already, in the folder `unpacked`, is left there.

    `version` is 2 or 3, `description` fmpy's record of the XML. `references`, `nominals` and
    `bounds` map the names of variables to value references, nominal values, and the least and the
    greatest value, infinite where there is no bound; the last two those of elements, too.
    `elements` are the numbers of all variables: an array `A` has `A[1,1]`, `A[1,2]` and so on;
    `state_elements` are those of the continuous states, in the order of the state vector.
    `variables` are fmpy's records. `step_size` is that of the default experiment [s], 1 ms if there
    is none.

    Raises InputError if the file is no FMU of FMI 2.0 or FMI 3.0, or must not be unpacked.
    """

    def __init__(self, path: Path, unpacked: Path | None = None) -> None:
        self.path = path
        self._held = ExitStack()
        try:
            self.directory = unpacked or self._held.enter_context(temporary_folder())
            if unpacked is None:
                unpack(path, self.directory)
            self._read()
        except Exception as error:  # fmpy raises it for any damage
            is_ssp = (self.directory / "SystemStructure.ssd").is_file()
            parts = quoted(sorted(p.name for p in self.directory.rglob("*.fmu")))
            self._held.close()
            if isinstance(error, InputError):
                raise
            reason = str(error).replace(f"{self.directory}{os.sep}", "")
            problem = f"cannot be read as an FMU ({reason}); export it again."
            if is_ssp:
                problem = f"is an SSP; unpack it and give one of its FMUs ({parts or 'none'})."
            raise InputError(f"{path}: {problem}") from error

    def _read(self) -> None:
        """Read the description; raises InputError if it is of no known kind."""
        for text in (self.directory / name for name in _TEXTS):
            if text.is_file() and text.stat().st_size > LONGEST_TEXT:
                raise InputError(
                    f"{self.path}: {text.relative_to(self.directory).as_posix()} has more than"
                    f" {LONGEST_TEXT >> 20} MiB and is not read; export the FMU again."
                )
        self.description: Any = fmpy.read_model_description(str(self.directory), validate=False)
        version = str(self.description.fmiVersion)
        interface = self.description.coSimulation or self.description.modelExchange
        if version[:2] not in ("2.", "3.") or interface is None:
            raise InputError(
                f"{self.path}: is of FMI {version} and has"
                f" {'no' if interface is None else 'an'} interface for model exchange or"
                " co-simulation; give one of FMI 2.0 or FMI 3.0 that has one of these."
            )
        self.version = int(version[0])
        self._read_flag()
        self.identifier = str(interface.modelIdentifier)
        if not _IDENTIFIER.fullmatch(self.identifier):  # it names the file that is loaded
            raise InputError(
                f"{self.path}: its model identifier {self.identifier!a} is no name in C; export it"
                " again."
            )
        self.variables: dict[str, Any] = {v.name: v for v in self.description.modelVariables}
        self.references = {n: int(v.valueReference) for n, v in self.variables.items()}
        self.elements = dict(self._elements())
        elements = {n: self.variables[e.variable] for n, e in self.elements.items()}
        every = self.variables | elements
        self.nominals = {n: _stated(v.nominal, 1.0) for n, v in every.items()}
        self.bounds = {
            n: (_stated(v.min, -math.inf), _stated(v.max, math.inf)) for n, v in every.items()
        }
        self.step_size = self.experiment("stepSize") or 1e-3
        self._states = [str(u.variable.derivative.name) for u in self.description.derivatives]
        places = {name: k for k, name in enumerate(self._states)}
        states = [n for n, e in self.elements.items() if e.variable in places]
        self.state_elements = sorted(states, key=lambda n: places[self.elements[n].variable])

    def _read_flag(self) -> None:
        """Note that FMI 3.0 provides directional derivatives: fmpy reads the name of FMI 2.0."""
        text = (self.directory / "modelDescription.xml").read_text("utf-8", errors="replace")
        for name in ("modelExchange", "coSimulation"):
            kind = getattr(self.description, name)
            tag = name[0].upper() + name[1:]
            if kind is not None and re.search(rf"<{tag}\b[^>]*?\s{_FLAG}=[\"'](?:true|1)", text):
                kind.providesDirectionalDerivative = True

    def _elements(self) -> Iterator[tuple[str, Element]]:
        """Yield the numbers of all variables by name."""
        for v in self.description.modelVariables:
            if v.type in _NO_NUMBERS:
                continue
            shape = [_size(d) for d in v.dimensions]
            count, words = math.prod(shape), str(v.start if v.start is not None else "").split()
            starts = [_number(word) for word in words] or [0.0]
            starts = starts if len(starts) == count else starts[:1] * count
            places = product(*(range(1, size + 1) for size in shape))
            for k, place in enumerate(places):
                name = f"{v.name}[{','.join(map(str, place))}]" if shape else v.name
                reference = int(v.valueReference)
                yield str(name), Element(v.name, v.type, reference, k, count, tuple(starts))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

    def interfaces(self) -> tuple[int, ...]:
        """Return which of co-simulation (1) and model exchange (0) the description announces."""
        kinds = ((1, self.description.coSimulation), (0, self.description.modelExchange))
        return tuple(kind for kind, announced in kinds if announced is not None)

    def kind(self, interface: int) -> Any:
        """Return what the description states of co-simulation (1) or model exchange (0)."""
        return (self.description.modelExchange, self.description.coSimulation)[interface]

    def experiment(self, name: str) -> float:
        """Return a number of the default experiment by fmpy's name, 0 if there is none."""
        return float(getattr(self.description.defaultExperiment, name, None) or 0.0)

    @property
    def internal_step(self) -> float:
        """The fixed internal step of co-simulation [s], 0 if there is none."""
        return float(getattr(self.description.coSimulation, "fixedInternalStepSize", None) or 0.0)

    @property
    def takes_lines(self) -> bool:
        """Whether the slope of an input over a step can be set in co-simulation."""
        return bool(getattr(self.description.coSimulation, "canInterpolateInputs", False))

    @property
    def token(self) -> str:
        """The GUID (FMI 2.0) or instantiation token (FMI 3.0)."""
        return str(self.description.guid)

    def names(self, causality: str) -> list[str]:
        """Return the names of the variables of one causality, in the order of the description."""
        return [v.name for v in self.description.modelVariables if v.causality == causality]

    def states(self) -> list[str]:
        """Return the names of the continuous states, in the order of the state vector."""
        return list(self._states)

    def sampled(self) -> list[str]:
        """Return the names of the sampled states: local variables that are discrete."""
        kind = ("local", "discrete")
        every = self.description.modelVariables
        return [v.name for v in every if (v.causality, v.variability) == kind]

    def indicators(self) -> list[str]:
        """Return the names of the variables that repeat the event indicators, in their order."""
        return [name for name in self.references if name.startswith("switch.")]

    def indicator_count(self) -> int:
        """Return how many event indicators the description announces."""
        if self.version == 3:
            return len(self.description.eventIndicators)
        return int(self.description.numberOfEventIndicators or 0)

    def binaries(self) -> Iterator[Path]:
        """Yield the paths of the libraries for all platforms, sorted."""
        for path in sorted((self.directory / "binaries").rglob("*")):
            if path.is_file() and path.suffix in (".so", ".dll", ".dylib"):
                yield path


def _stated(value: Any, other: float) -> float:
    """Return a number of the description, another one where it states none."""
    return other if value is None else float(value)


def _size(dimension: Any) -> int:
    """Return the size of a dimension: its number, or the start of what sets it."""
    sized = dimension if dimension.variable is None else dimension.variable
    return int(sized.start or 0)


def _number(word: str) -> float:
    """Return a start value; a Boolean is 0 or 1."""
    return float({"true": "1", "false": "0"}.get(word.lower(), word))
