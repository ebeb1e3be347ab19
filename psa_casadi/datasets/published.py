"""What is published, by whom, under which licence, and the SHA-256 by which it is known."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class Original:
    """A file as its authors publish it."""

    name: str
    url: str
    sha256: str


class Conversion(Protocol):
    """What makes the CSV file of a record of its originals, the same bytes on every machine."""

    @property
    def words(self) -> str:
        """What is taken of the originals, in words."""

    def csv(self, originals: Sequence[bytes]) -> bytes:
        """Return the CSV file of the record."""


@dataclass(frozen=True)
class DatasetFile:
    """One record of a dataset: its CSV file, the originals, and what makes it of them."""

    name: str
    description: str
    sha256: str
    originals: tuple[Original, ...]
    conversion: Conversion


@dataclass(frozen=True)
class Dataset:
    """Public records of one device."""

    name: str
    description: str
    source: str
    citation: str
    licence: str
    licence_text: str
    files: tuple[DatasetFile, ...]
