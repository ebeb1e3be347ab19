"""A system of models as an SSP archive: an FMU for each part, wires, parameters, a drawing.

Source: SSP 1.0, section 4.1 (packaging).
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from psa_casadi.export.fmu.archive import export_fmu, write_archive
from psa_casadi.export.ssp.drawing import (
    OUTSIDE,
    Port,
    Wire,
    WiredParts,
    layout_of,
    save_wiring,
    wiring_picture,
)
from psa_casadi.export.ssp.steps import master_step
from psa_casadi.export.ssp.structure import parameter_files, structure_description
from psa_casadi.files import atomic_path, temporary_folder
from psa_casadi.model.system import System
from psa_casadi.variables import Publication

__all__ = ["export_ssp", "layout_of", "save_wiring", "wiring_of"]

#: Where the archive carries the picture of the wiring.
PICTURE_ENTRY = "documentation/wiring.svg"
#: What is simulated by default [s].
STOP_TIME = 0.1


def export_ssp(
    system: System,
    path: str | os.PathLike[str],
    *,
    platforms: Sequence[str] = ("host",),
    stop_time: float = STOP_TIME,
    publication: Publication | None = None,
) -> Path:
    """Write a system as an SSP archive (SSP 1.0, FMUs of FMI 2.0) and return its path.

    The archive holds `SystemStructure.ssd` with units, connectors, wires and their drawing; in
    `resources` the FMU of each part and the parameter sets; the picture of the wiring as SVG. The
    same system gives the same bytes. `platforms` are those of `export_fmu`. `publication` says who
    made the system and on what terms it is passed on; a part that says nothing of it says the same.

    Raises what `connect` and `export_fmu` raise.
    """
    system.model()
    wiring = wiring_of(system)
    if publication is not None:
        parts = {
            name: part if part.publication.stated else replace(part, publication=publication)
            for name, part in wiring.parts.items()
        }
        wiring = replace(wiring, parts=parts, publication=publication)
    layout = layout_of(wiring)
    entries, bindings = parameter_files(wiring.parts, wiring.name)
    description = structure_description(
        wiring, layout, bindings, stop_time, master_step(wiring, stop_time)
    )
    entries["SystemStructure.ssd"] = description.encode("utf-8")
    entries[PICTURE_ENTRY] = wiring_picture(wiring, layout, "svg")
    with temporary_folder() as folder:
        for name, model in wiring.parts.items():
            fmu = export_fmu(
                model, folder / f"{name}.fmu", name=name, include_sensor=True,
                platforms=platforms,
            )  # fmt: skip
            entries[f"resources/{name}.fmu"] = fmu.read_bytes()
    with atomic_path(path) as temporary:
        write_archive(temporary, entries)
    return Path(path)


def wiring_of(system: System) -> WiredParts:
    """Return the parts with all wires, those from and to the surroundings too.

    An input that has no wire and no name outside is no connector: it rests at its start value.
    """

    def port(text: str) -> Port:
        return Port(*text.split(".", 1))

    wires = [Wire(Port(OUTSIDE, name), port(end)) for name, end in system.inputs.items()]
    wires += [Wire(port(start), port(end)) for start, end in system.wires]
    wires += [Wire(port(start), Port(OUTSIDE, name)) for name, start in system.outputs.items()]
    return WiredParts(system.name, system.parts, tuple(wires))
