"""An FMU of another tool with what was found around it, as an SSP that system tools run.

u -> before (effects of inputs) -> original FMU -> behind (effects of outputs) -> y
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np

from psa_casadi.component import Component, Equations, OnDemand, Symbols
from psa_casadi.errors import InputError
from psa_casadi.export.fmu.archive import export_fmu, write_archive
from psa_casadi.export.importer.archive import Archive
from psa_casadi.export.importer.fmu import CO_SIMULATION, Fmu
from psa_casadi.export.importer.start_values import fmu_starts, fmu_values, start_set
from psa_casadi.export.nested import nested
from psa_casadi.export.ssp import (
    OUTSIDE,
    PICTURE_ENTRY,
    Binding,
    Port,
    Wire,
    WiredParts,
    layout_of,
    parameter_files,
    structure_description,
    wiring_picture,
)
from psa_casadi.files import atomic_path, temporary_folder
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import Opened, ported
from psa_casadi.simulation.start import start_for
from psa_casadi.variables import Input, Output, State

_BEFORE, _ORIGINAL, _BEHIND = "before", "original", "behind"
_PARAMETERS = "resources/original.ssv"


@dataclass(frozen=True, eq=False)
class _Passed:
    """Outputs that are inputs, by name; a state that does nothing, as an FMU needs one."""

    pairs: tuple[tuple[str, str], ...]
    still: str

    def __call__(self, s: Symbols) -> Equations:
        return Equations(out={o: getattr(s, i) for o, i in self.pairs}, der={self.still: ca.SX(0)})


def export_extended(
    model: Model,
    path: str | os.PathLike[str],
    *,
    step: float | None = None,
    platforms: Sequence[str] = ("host",),
) -> Path:
    """Write the model of an FMU with effects at its inputs and outputs, and return its path.

    NAME.ssp is an archive (SSP 1.0) of the FMU as it is, its parameters as a set, and FMUs of FMI
    2.0 with the effects of inputs and of outputs. A master steps the parts: what one shows acts on
    the next one `step` [s] later, by default the FMU's step size.

    NAME.fmu is one FMU of FMI 2.0 for co-simulation, for this machine's platform, with the others
    in its resources. It steps them in turn, each with a line of what the one before shows: nothing
    is late. The FMU in it must be of FMI 2.0.

    Raises InputError for a model that is of no FMU, one without co-simulation, and for effects in
    rates, which are inside; and as `export_fmu`.
    """
    items = [c for c in model.components if c.foreign]
    if not items or items[0].foreign is None:
        raise InputError(f"The model '{model.name}' is of no FMU; write it with psa.export_fmu.")
    component, file = items[0], items[0].foreign.fmu.file
    target, place = Path(path), Path(items[0].foreign.place)
    single = target.suffix.lower() == ".fmu"
    with Archive(place) as archive:
        if archive.description.coSimulation is None:
            raise InputError(f"{file} has no co-simulation, which can stand between effects.")
        if single and archive.version != 2:
            raise InputError(f"{file} is of FMI 3.0, which no FMU holds here; write NAME.ssp.")
    wiring = _wired(model, component, _by_place(model, component))
    with temporary_folder() as folder:
        fmus = {_ORIGINAL: place}
        for name, part in wiring.parts.items():
            if name != _ORIGINAL:
                fmus[name] = export_fmu(
                    part, folder / f"{name}.fmu", name=name, include_sensor=True,
                    platforms=platforms,
                )  # fmt: skip
        if single:
            entries = nested(wiring, fmus, fmu_starts(model, component))
        else:
            entries = _system(model, component, wiring, step)
            entries |= {f"resources/{n}.fmu": f.read_bytes() for n, f in fmus.items()}
    with atomic_path(target) as temporary:
        write_archive(temporary, entries)
    return target


def _system(
    model: Model, component: Component, wiring: WiredParts, step: float | None
) -> dict[str, bytes]:
    """Return the description of an SSP, its parameter sets and picture."""
    with Archive(Path(component.foreign.place if component.foreign else "")) as archive:
        size = step or archive.step_size
        stop = getattr(archive.description.defaultExperiment, "stopTime", None)
    layout = layout_of(wiring)
    others = {name: part for name, part in wiring.parts.items() if name != _ORIGINAL}
    entries, bindings = parameter_files(others, model.name)
    if fmu_starts(model, component):
        entries[_PARAMETERS] = start_set(model, component).encode("utf-8")
        bindings = (*bindings, Binding(_ORIGINAL, _PARAMETERS))
    text = structure_description(wiring, layout, bindings, float(stop or 1000 * size), size)
    entries["SystemStructure.ssd"] = text.encode("utf-8")
    entries[PICTURE_ENTRY] = wiring_picture(wiring, layout, "svg")
    return entries


def _by_place(model: Model, component: Component) -> dict[str, list[Component]]:
    """Return the effects before and behind an FMU. Raises InputError for any others."""
    places = {f"applied_{i.name}": _BEFORE for i in component.inputs}
    places |= {f"shown_{o.name}": _BEHIND for o in component.outputs}
    table: dict[str, list[Component]] = {_BEFORE: [], _BEHIND: []}
    for effect in model.effects:
        added = {places.get(name) for name in effect.equations(OnDemand()).add}
        if len(added) != 1 or None in added:
            raise InputError(
                f"The effect '{effect.name}' acts inside the FMU; only effects at its inputs and"
                " outputs can stand around it."
            )
        table[str(added.pop())].append(effect)
    return table


def _wired(model: Model, component: Component, groups: dict[str, list[Component]]) -> WiredParts:
    """Return the parts and their wires; a side without effects has none."""
    foreign, played = component.foreign, component.played
    inputs, outputs = component.inputs, component.outputs
    plain = model.with_components([component])
    parts: dict[str, Model] = {_ORIGINAL: plain}
    wires: list[Wire] = []
    if groups[_BEFORE]:
        displayed = tuple(Output(f"given_{i.name}", i.unit, i.description) for i in inputs)
        pairs = tuple((o.name, i.name) for o, i in zip(displayed, inputs, strict=True))
        parts[_BEFORE] = _side(model, component, _BEFORE, inputs, displayed, pairs, groups[_BEFORE])
    if groups[_BEHIND]:
        starts = zip(outputs, _first_outputs(model, component), strict=True)
        read = tuple(Input(f"played_{o.name}", o.unit, o.description, v) for o, v in starts)
        pairs = tuple((o.name, i.name) for o, i in zip(outputs, read, strict=True))
        parts[_BEHIND] = _side(model, component, _BEHIND, read, outputs, pairs, groups[_BEHIND])
    for i in inputs:
        end = Port(_ORIGINAL, i.name)
        first = Port(_BEFORE, i.name) if groups[_BEFORE] else end
        wires.append(Wire(Port(OUTSIDE, i.name), first))
        if groups[_BEFORE]:
            wires.append(Wire(Port(_BEFORE, f"given_{i.name}"), end))
    for o in outputs:
        start = Port(_ORIGINAL, o.name)
        last = Port(_BEHIND, o.name) if groups[_BEHIND] else start
        if groups[_BEHIND]:
            wires.append(Wire(start, Port(_BEHIND, f"played_{o.name}")))
        wires.append(Wire(last, Port(OUTSIDE, o.name)))
    names: dict[Port, str] = {}
    if foreign is not None and played is not None:
        item = [v.name for v in inputs] + [v.name for v in outputs]
        there = zip(item, (*played.inputs, *played.outputs), strict=True)
        names = {Port(_ORIGINAL, name): known for name, known in there}
    order = [n for n in (_BEFORE, _ORIGINAL, _BEHIND) if n in parts]
    return WiredParts(model.name, {n: parts[n] for n in order}, tuple(wires), names=names)


def _side(
    model: Model, component: Component, name: str, inputs: Sequence[Input],
    outputs: Sequence[Output], pairs: tuple[tuple[str, str], ...], effects: Sequence[Component],
) -> Model:  # fmt: skip
    """Return the model of one side: what goes in comes out, but for its effects."""
    still = f"{name}_still"
    passing = Component(
        name=name,
        description=f"effects {name} the FMU",
        source=component.source,
        equations=_Passed(pairs, still),
        states=(State(still, "1", "nothing; an FMU has a state", 1.0),),
        inputs=tuple(inputs),
        outputs=tuple(outputs),
    )
    opened = component.equations
    kind = "input" if name == _BEFORE else "output"
    ports = [p for p in opened.ports if p.kind == kind] if isinstance(opened, Opened) else []
    made = model.with_components([ported(passing, frozenset(ports)), *effects])
    first = np.array([[i.start for i in inputs]] * 2)
    rest = start_for(made, np.array([0.0, 1.0]), first, {}).x.tolist()
    made = made.with_starts(dict(zip(made.state_names, rest, strict=True)))
    return replace(made, name=name, description=f"effects {name} the FMU")


def _first_outputs(model: Model, component: Component) -> list[float]:
    """Return what an FMU shows at its start, with the values of a model."""
    foreign, played = component.foreign, component.played
    if foreign is None or played is None:
        return [0.0 for _ in component.outputs]
    values = {**dict(played.fixed), **fmu_values(model, component)}
    values |= {n: i.start for n, i in zip(played.inputs, component.inputs, strict=True)}
    with Fmu(Path(foreign.place)) as fmu, fmu.start(CO_SIMULATION, values=values) as instance:
        return [float(v) for v in instance.get(played.outputs)]
