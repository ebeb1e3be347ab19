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
    Layout,
    Port,
    Wire,
    arrange,
    save_wiring,
    wiring_picture,
)
from psa_casadi.export.ssp.steps import master_step
from psa_casadi.export.ssp.structure import WiredParts, parameter_files, structure_description
from psa_casadi.files import atomic_path
from psa_casadi.model.system import System
from psa_casadi.scratch import temporary_folder
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
    wiring = _published(wiring_of(system), publication)
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


def _published(wiring: WiredParts, publication: Publication | None) -> WiredParts:
    if publication is None:
        return wiring
    parts = {
        name: part if part.publication.stated else replace(part, publication=publication)
        for name, part in wiring.parts.items()
    }
    return replace(wiring, parts=parts, publication=publication)


def layout_of(wiring: WiredParts) -> Layout:
    """Return the drawing of a system."""
    return arrange(tuple(wiring.parts), wiring.wires)


def wiring_of(system: System) -> WiredParts:
    """Return the parts with all wires, those from and to the surroundings too.

    An input that has no wire and no name outside is no connector: it rests at its start value.
    """
    wires = [Wire(Port(OUTSIDE, name), _port(end)) for name, end in system.inputs.items()]
    wires += [Wire(_port(start), _port(end)) for start, end in system.wires]
    wires += [Wire(_port(start), Port(OUTSIDE, name)) for name, start in system.outputs.items()]
    return WiredParts(system.name, system.parts, tuple(wires))


def _port(text: str) -> Port:
    part, _, name = text.partition(".")
    return Port(part, name)
