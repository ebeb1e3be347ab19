"""An FMU: description, binaries and sources of a model in one archive of fixed bytes."""

import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_path
from psa_casadi.export.common.icon import ICONS, drawing_of, png
from psa_casadi.export.common.parameter_sets import SAMPLES
from psa_casadi.export.common.publication import LICENSE_ENTRY, license_text, refuse_foreign
from psa_casadi.export.fixed_step.export import FixedStep, fixed_step
from psa_casadi.export.fmu.documentation import ENTRY as DOCUMENTATION_ENTRY
from psa_casadi.export.fmu.documentation import documentation
from psa_casadi.export.fmu.evidence import evidence_files, related_files, with_validity
from psa_casadi.export.fmu.platforms import chosen_platforms, compile_library
from psa_casadi.export.fmu.reference_run import held_step, reference_entries
from psa_casadi.export.fmu.sources import FACES, FIXED_ENTRY, exported_texts, fixed_entry, use_of
from psa_casadi.export.fmu.terminals import terminal_entries
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import dumps
from psa_casadi.simulation.stepper import SimulationError

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
    fmi: int = 2,
    parameter_sets: int = SAMPLES,
    validity_output: bool = False,
    step: float | None = None,
) -> Path:
    """Write a model as an FMU (co-simulation and model exchange) and return its path.

    `fmi` is the version of the standard, 2 (FMI 2.0) or 3 (FMI 3.0). Sensor and environment stay
    out unless `include_sensor`. `name` is the model identifier, a C identifier; by default the
    model's name. `platforms` are names of `PLATFORMS`, "host" or "all". The same model gives the
    same bytes. The file is written whole or not at all.

    A model with evidence (identified or diagnosed) takes it along: a page, meta data, a run to
    repeat, and `parameter_sets` random sets of its parameters within their uncertainty, next to
    their mean and sigma points (0: none of them). `validity_output` adds the output
    `outside_validity`: how far a run has left the range of the records.

    With a `step` [s] the FMU is for co-simulation only and takes steps of this fixed length and of
    constant cost, as `export_c` writes them: communication steps are multiples of it and parameters
    are constants. The description states the error that was measured.

    Raises InputError for an impossible name, an unknown platform or version, a model without
    states, or one that does not fit a fixed step, and MachineError if a compiler fails.
    """
    refuse_foreign(model.structure, "an FMU")
    identifier = name or model.name
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", identifier):
        raise InputError(
            f"'{identifier}' cannot name an FMU; use letters, digits, underscores, no digit first."
        )
    if fmi not in FACES:
        raise InputError(f"FMI {fmi} is not known; choose 2 (FMI 2.0) or 3 (FMI 3.0).")
    targets = chosen_platforms(platforms)
    exported = model if include_sensor else model.plant()
    if validity_output:
        exported = with_validity(exported)
    fixed = None if step is None else planned_step(exported, identifier, fmi, step)
    _, texts, xml = exported_texts(exported, identifier, fmi, fixed)
    entries = {
        "modelDescription.xml": xml.encode("utf-8"),
        **_companions(exported, fmi, parameter_sets, fixed),
    }
    entries |= {f"sources/{n}": t.encode("utf-8") for n, t in texts.items()}
    for target in targets:
        folder = target.binaries(fmi)
        entries[f"binaries/{folder}/{identifier}{target.suffix}"] = compile_library(
            texts, identifier, target
        )
    with atomic_path(path) as temporary:
        write_archive(temporary, entries)
    return Path(path)


def planned_step(model: Model, identifier: str, fmi: int, step: float) -> FixedStep:
    """Return the fixed step [s] of an FMU, its errors as its importers get them.

    They hold inputs over a step in FMI 3.0, which has no derivatives of inputs. Raises as
    `fixed_step`.
    """
    if model.structure.sampled:
        raise InputError(
            f"The model '{model.name}' has sampled states, for which an FMU has no fixed step;"
            " export it with the adaptive solver, which takes their instants exactly."
        )
    hold = "zero" if fmi == 3 else "linear"
    return fixed_step(model, name=identifier, step=step, hold=hold)


def _companions(model: Model, fmi: int, samples: int, fixed: FixedStep | None) -> dict[str, bytes]:
    """Return the files other than description, sources and binaries, for people and other tools.

    A model that cannot be simulated with its values is exported without a reference run, and so
    is one with a fixed step, which takes neither the run's parameters nor any step of its rows.
    """
    evidence: dict[str, bytes] = {}
    entries: dict[str, bytes] = {}
    step, use = None, ""
    with suppress(SimulationError):
        evidence = evidence_files(model, samples)
        related = related_files(model, evidence)
        entries, step = reference_entries(model, related), held_step(model)
    entries = {**entries, **evidence}
    if fixed is not None:
        entries, use = {FIXED_ENTRY: fixed_entry(fixed)}, use_of(fixed)
    page = documentation(model, places=entries, step=step, use=use)
    entries[DOCUMENTATION_ENTRY] = page.encode("utf-8")
    entries[LICENSE_ENTRY] = license_text(model, fmi).encode("utf-8")
    drawing = png(ICONS[drawing_of(model)])
    entries |= {"model.png": drawing} if fmi == 2 else terminal_entries(model)
    entries[MODEL_ENTRY] = dumps(model).encode("utf-8")
    return entries


def write_archive(path: Path, entries: Mapping[str, bytes]) -> None:
    """Write a zip archive with sorted entries and fixed dates and permissions.

    The entries are stored: what a compressor makes of them depends on the version of its library.
    """
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, content in sorted(entries.items()):
            entry = zipfile.ZipInfo(name, _FIXED_DATE)
            entry.create_system = 3
            executable = name.startswith("binaries/")
            entry.external_attr = (0o100755 if executable else 0o100644) << 16
            archive.writestr(entry, content)
