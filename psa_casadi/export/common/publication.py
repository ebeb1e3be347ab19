"""Who made an exported model, on what terms, and the notices that its C code must carry.

The C code of every export is this package's (BSD 3-Clause) and the headers are those of the FMI
standard (BSD 2-Clause): both licences ask that their notice goes with binaries too.

Source: FMI 2.0.5, section 2.3, and FMI 3.0.2, section 2.5.1.2 (documentation/licenses).
"""

from importlib.resources import files

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.export.common.templates import filled
from psa_casadi.model.compose import Model
from psa_casadi.model.structure import Structure
from psa_casadi.simulation.compiler import sources_directory

#: Entry point of the licence information in both versions of the standard.
LICENSE_ENTRY = "documentation/licenses/license.txt"
#: The notice of the C code, in the folder of the sources.
SOURCES_NOTICE = "LICENSE.txt"
_CODE_LICENSE = f"C code: BSD 3-Clause, see {LICENSE_ENTRY}"
_HEADERS = {2: "fmi2Functions.h", 3: "fmi3Functions.h"}


def published(model: Model) -> dict[str, str]:
    """Return author, version, copyright and license, by these names, for a description.

    What the model does not say is left out, but for copyright and licence: then of the C code.
    """
    return {**terms_of_code(), **model.publication.stated}


def terms_of_code() -> dict[str, str]:
    """Return copyright and license of the C code, for a model that states none."""
    return {"copyright": f"C code: {copyright_line()}", "license": _CODE_LICENSE}


def code_license() -> str:
    """Return the licence text of this package, with its copyright notice."""
    folder = sources_directory()
    for path in (folder / "LICENSE", folder.parent / "LICENSE"):
        if path.is_file():
            return path.read_text(encoding="utf-8").replace("\r\n", "\n")
    raise PsaError("The LICENSE is missing from this installation; reinstall psa_casadi.")


def copyright_line() -> str:
    """Return the line of this package's licence that names the holder of the copyright."""
    return next(line for line in code_license().splitlines() if line.startswith("Copyright"))


def license_text(model: Model, fmi: int) -> str:
    """Return the text of documentation/licenses/license.txt: terms and notices of all parts."""
    lines = [f"   {name}: {text}\n" for name, text in model.publication.stated.items()]
    header = (files("fmpy") / "c-code" / _HEADERS[fmi]).read_text(encoding="utf-8")
    notice = header[header.index("Copyright") :].partition("*/")[0].splitlines()  # first comment
    return filled(
        "license.txt",
        name=model.name,
        model="".join(lines) or "   no terms are stated: ask whoever gave you this FMU\n",
        code=code_license(),
        headers="\n".join(line.strip() for line in notice).rstrip(),
    )


def refuse_foreign(structure: Structure, what: str) -> None:
    """Raise InputError for a model with an FMU in it; `what` it would become, as "an FMU"."""
    if structure.foreign:
        part = next(c for c in structure.components if c.foreign)
        raise InputError(
            f"The model has an FMU in it ('{part.name}': {part.source}), which is a binary without"
            f" equations to write as {what}. Effects at its inputs and outputs can stand around it"
            " in an SSP: psa.export_extended, or psa export ssp --model MODEL.json."
        )
