"""An FMU: description, binaries and sources of a model in one archive of fixed bytes."""

import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from psa_casadi.components import COMPONENTS
from psa_casadi.effects import EFFECTS
from psa_casadi.errors import InputError
from psa_casadi.export.model_description import model_description
from psa_casadi.export.platforms import chosen_platforms, compile_library
from psa_casadi.export.sources import compiled_files, export_token, source_files
from psa_casadi.files import atomic_path
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import dumps

#: Where an FMU carries the model it was made from.
MODEL_ENTRY = "resources/model.json"
_FIXED_DATE = (1980, 1, 1, 0, 0, 0)


def export_fmu(
    model: Model,
    path: str | os.PathLike[str],
    *,
    name: str | None = None,
    include_sensor: bool = False,
    platforms: Sequence[str] = ("host",),
) -> Path:
    """Write a model as an FMU (FMI 2.0, co-simulation and model exchange) and return its path.

    Sensor and environment stay out unless `include_sensor`. `name` is the model identifier, a C
    identifier; by default the model's name. `platforms` are names of `PLATFORMS`, "host" or "all".
    The same model gives the same bytes. The file is written whole or not at all.

    Raises InputError for an impossible name, an unknown platform or a model without states, and
    PsaError if a compiler fails.
    """
    identifier = name or model.name
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", identifier):
        raise InputError(
            f"'{identifier}' cannot name an FMU; use letters, digits, underscores, no digit first."
        )
    targets = chosen_platforms(platforms)
    exported = model if include_sensor else model.plant()
    token = export_token(exported, identifier)
    texts = source_files(exported, identifier, token)
    xml = model_description(exported, identifier, token, compiled_files(texts))
    entries: dict[str, bytes] = {"modelDescription.xml": xml.encode("utf-8")}
    entries |= {f"sources/{n}": t.encode("utf-8") for n, t in texts.items()}
    if all(c in (*COMPONENTS.values(), *EFFECTS.values()) for c in exported.components):
        entries[MODEL_ENTRY] = dumps(exported).encode("utf-8")
    for target in targets:
        entries[f"binaries/{target.folder}/{identifier}{target.suffix}"] = compile_library(
            texts, identifier, target
        )
    with atomic_path(path) as temporary:
        write_archive(temporary, entries)
    return Path(path)


def write_archive(path: Path, entries: Mapping[str, bytes]) -> None:
    """Write a zip archive with sorted entries and fixed dates and permissions."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(entries.items()):
            entry = zipfile.ZipInfo(name, _FIXED_DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.create_system = 3
            executable = name.startswith("binaries/")
            entry.external_attr = (0o100755 if executable else 0o100644) << 16
            archive.writestr(entry, content)
