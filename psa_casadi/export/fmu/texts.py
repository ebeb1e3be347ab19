"""The texts of an FMU: its sources and its description, and the token that ties them together."""

import hashlib
import uuid
from collections.abc import Mapping
from pathlib import Path

from psa_casadi.export.fixed_step.planning import FixedStep
from psa_casadi.export.fmu.fixed import fixed_description, fixed_sources
from psa_casadi.export.fmu.model_description import model_description
from psa_casadi.export.fmu.model_description3 import model_description3
from psa_casadi.export.fmu.sources import compiled_files, source_files
from psa_casadi.files import atomic_write
from psa_casadi.model.compose import Model

#: The writer of modelDescription.xml of each version of the standard.
DESCRIPTIONS = {2: model_description, 3: model_description3}


def exported_texts(
    model: Model,
    identifier: str,
    fmi: int = 2,
    fixed: FixedStep | None = None,
    given: Mapping[str, str] | None = None,
) -> tuple[str, dict[str, str], str]:
    """Return token, sources by file name, and description of an export.

    The token (GUID) is a hash of the description and the sources that were made with an empty one.
    `fixed` is the step of an FMU with a fixed step, `given` are sources that are taken as they are.
    """

    def sources(token: str) -> dict[str, str]:
        texts = source_files(model, identifier, token, fmi)
        return (fixed_sources(texts, fixed) if fixed else texts) | dict(given or {})

    bare = sources("")
    names = compiled_files(bare)
    plain = DESCRIPTIONS[fmi](model, identifier, "", names)
    digest = hashlib.sha256(plain.encode("utf-8"))
    for name, text in sorted(bare.items()):
        digest.update(name.encode("utf-8") + b"\0" + text.encode("utf-8") + b"\0")
    token = "{" + str(uuid.UUID(bytes=digest.digest()[:16])) + "}"
    xml = DESCRIPTIONS[fmi](model, identifier, token, names)
    return token, sources(token), fixed_description(xml, fixed) if fixed else xml


def write_sources(
    model: Model, directory: Path, *, name: str | None = None, fmi: int = 2
) -> list[Path]:
    """Write all sources of a model's FMU to a folder and return the paths, sorted.

    The folder is made if it does not exist. The sources compile alone; its README.txt has the line.
    """
    directory.mkdir(parents=True, exist_ok=True)
    written = []
    _, texts, _ = exported_texts(model, name or model.name, fmi)
    for file_name, text in sorted(texts.items()):
        atomic_write(directory / file_name, text)
        written.append(directory / file_name)
    return written
