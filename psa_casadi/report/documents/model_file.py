"""What MODEL.json holds (`psa_casadi.model.model_file` writes and reads it)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from psa_casadi.model.evidence import Evidence
from psa_casadi.variables import Publication


@dataclass(frozen=True)
class ModelParameter:
    """A parameter's value in its unit, its 95 % interval, and whether a fit found it."""

    value: float
    unit: str = ""
    interval: tuple[float, float] | None = None
    free: bool = False


@dataclass(frozen=True)
class OwnEffect:
    """An effect that is not of this package: its module and the hash of what it declares."""

    name: str
    module: str
    sha256: str


@dataclass(frozen=True)
class IdentifiedFrom:
    """A record that the model was fitted to, with the SHA-256 of its file."""

    record: str
    sha256: str


@dataclass(frozen=True)
class ModelFile:
    """A model by the names of its components, with every value, interval and origin."""

    format: Literal["psa_casadi.model/1"]
    components: tuple[str, ...]
    effects: tuple[str | OwnEffect, ...]
    parameters: Mapping[str, ModelParameter]
    name: str = "psa"
    description: str = ""
    publication: Publication = field(default_factory=Publication)
    starts: Mapping[str, float] = field(default_factory=dict)
    interrupted: bool = False
    force_scale: str = "assumed"
    notes: tuple[str, ...] = ()
    identified_from: tuple[IdentifiedFrom, ...] = ()
    package_version: str = ""
    evidence: Evidence | None = None
