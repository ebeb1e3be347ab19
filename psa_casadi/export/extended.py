"""An FMU of another tool with the effects around it, as an SSP that system tools run.

u -> before (effects of inputs) -> original FMU -> behind (effects of outputs) -> y
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_path, temporary_folder
from psa_casadi.export import ssp
from psa_casadi.export.fmu.archive import write_archive
from psa_casadi.export.importer.fmu import CO_SIMULATION
from psa_casadi.export.importer.played import GIVEN, PLAYED
from psa_casadi.export.importer.start_values import FmuPart, fmu_part, start_set
from psa_casadi.export.nested import nested
from psa_casadi.model.component import Component, Equations, OnDemand, Symbols
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import Opened, ported
from psa_casadi.model.variables import Input, Output, State
from psa_casadi.simulation.start import start_for

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
    2.0 with the effects of inputs and of outputs. A master steps the parts: an output acts on the
    next part `step` [s] later, by default the FMU's step size.

    NAME.fmu is one FMU of FMI 2.0 for co-simulation, for this machine's platform, with the others
    in its resources. It steps them in turn, each with a line of the outputs of the one before:
    nothing is late. The FMU in it must be of FMI 2.0.

    Raises InputError for a model that is of no FMU, one without co-simulation, and for effects in
    rates, which are inside; and as `export_fmu`.
    """
    part = fmu_part(model, "write it with psa.export_fmu")
    file, fmu, target = part.foreign.fmu.file, part.fmu, Path(path)
    single = target.suffix.lower() == ".fmu"
    if fmu.description.coSimulation is None:
        raise InputError(f"{file} has no co-simulation, which can stand between effects.")
    if single and fmu.version != 2:
        raise InputError(f"{file} is of FMI 3.0, which no FMU holds here; write NAME.ssp.")
    wiring = _wired(part, _by_place(part))
    with temporary_folder() as folder:
        fmus = {_ORIGINAL: fmu.path}
        for name, side in wiring.parts.items():
            if name != _ORIGINAL:
                fmus[name] = ssp.part_fmu(side, name, folder, platforms)
        if single:
            entries = nested(wiring, fmus, part.starts)
        else:
            entries = _system(part, wiring, step)
            entries |= {f"resources/{n}.fmu": f.read_bytes() for n, f in fmus.items()}
    with atomic_path(target) as temporary:
        write_archive(temporary, entries)
    return target


def _system(part: FmuPart, wiring: ssp.WiredParts, step: float | None) -> dict[str, bytes]:
    """Return the description of an SSP, its parameter sets and picture."""
    size = step or part.fmu.step_size
    stop = part.fmu.experiment("stopTime") or 1000 * size
    others = {name: side for name, side in wiring.parts.items() if name != _ORIGINAL}
    entries, bindings = ssp.parameter_files(others, part.model.name)
    if part.starts:
        entries[_PARAMETERS] = start_set(part).encode("utf-8")
        bindings = (*bindings, ssp.Binding(_ORIGINAL, _PARAMETERS))
    return entries | ssp.system_entries(wiring, bindings, stop, size)


def _by_place(part: FmuPart) -> dict[str, list[Component]]:
    """Return the effects before and behind an FMU. Raises InputError for any others."""
    places = {f"applied_{i.name}": _BEFORE for i in part.component.inputs}
    places |= {f"shown_{o.name}": _BEHIND for o in part.component.outputs}
    table: dict[str, list[Component]] = {_BEFORE: [], _BEHIND: []}
    for effect in part.model.effects:
        added = {places.get(name) for name in effect.equations(OnDemand()).add}
        if len(added) != 1 or None in added:
            raise InputError(
                f"The effect '{effect.name}' acts inside the FMU; only effects at its inputs and"
                " outputs can stand around it. `psa simulate --model` runs it, and Python."
            )
        table[str(added.pop())].append(effect)
    return table


def _wired(part: FmuPart, effects: dict[str, list[Component]]) -> ssp.WiredParts:
    """Return the parts and their wires; a side without effects has none."""
    model, component, played = part.model, part.component, part.component.played
    inputs, outputs = component.inputs, component.outputs
    parts: dict[str, Model] = {}
    wires: list[ssp.Wire] = []
    if effects[_BEFORE]:
        applied = [Output(GIVEN + i.name, i.unit, i.description) for i in inputs]
        parts[_BEFORE] = _side(part, _BEFORE, inputs, applied, effects[_BEFORE])
    parts[_ORIGINAL] = model.with_components([component])
    if effects[_BEHIND]:
        starts = zip(outputs, _first_outputs(part), strict=True)
        read = [Input(PLAYED + o.name, o.unit, o.description, v) for o, v in starts]
        parts[_BEHIND] = _side(part, _BEHIND, read, outputs, effects[_BEHIND])
    for i in inputs:
        outer, end = ssp.Port(ssp.OUTSIDE, i.name), ssp.Port(_ORIGINAL, i.name)
        if effects[_BEFORE]:
            wires.append(ssp.Wire(outer, ssp.Port(_BEFORE, i.name)))
            outer = ssp.Port(_BEFORE, GIVEN + i.name)
        wires.append(ssp.Wire(outer, end))
    for o in outputs:
        start, outer = ssp.Port(_ORIGINAL, o.name), ssp.Port(ssp.OUTSIDE, o.name)
        if effects[_BEHIND]:
            wires.append(ssp.Wire(start, ssp.Port(_BEHIND, PLAYED + o.name)))
            start = ssp.Port(_BEHIND, o.name)
        wires.append(ssp.Wire(start, outer))
    names: dict[ssp.Port, str] = {}
    if played is not None:
        ours = [*(i.name for i in inputs), *(o.name for o in outputs)]
        pairs = zip(ours, (*played.inputs, *played.outputs), strict=True)
        names = {ssp.Port(_ORIGINAL, name): known for name, known in pairs}
    return ssp.WiredParts(model.name, parts, tuple(wires), names=names)


def _side(
    part: FmuPart, name: str, inputs: Sequence[Input], outputs: Sequence[Output],
    effects: Sequence[Component],
) -> Model:  # fmt: skip
    """Return the model of one side: outputs are the inputs, in their order, but for its effects."""
    still, opened = f"{name}_still", part.component.equations
    pairs = tuple((o.name, i.name) for o, i in zip(outputs, inputs, strict=True))
    passing = Component(
        name=name,
        description=f"effects {name} the FMU",
        source=part.component.source,
        equations=_Passed(pairs, still),
        states=(State(still, "1", "nothing; an FMU has a state", 1.0),),
        inputs=tuple(inputs),
        outputs=tuple(outputs),
    )
    kind = "input" if name == _BEFORE else "output"
    ports = [p for p in opened.ports if p.kind == kind] if isinstance(opened, Opened) else []
    made = part.model.with_components([ported(passing, frozenset(ports)), *effects])
    first = np.array([[i.start for i in inputs]] * 2)
    rest = start_for(made, np.array([0.0, 1.0]), first, {}).x.tolist()
    made = made.with_starts(dict(zip(made.state_names, rest, strict=True)))
    return replace(made, name=name, description=passing.description)


def _first_outputs(part: FmuPart) -> list[float]:
    """Return the outputs of an FMU at its start, with the values of a model."""
    component, played = part.component, part.component.played
    if played is None:
        return [0.0 for _ in component.outputs]
    stepped = replace(played, interface=CO_SIMULATION)  # as what holds it steps it
    starts = np.array([[i.start for i in component.inputs]])
    (outputs,) = stepped.outputs_of([(part.model.values, starts)], np.zeros(1), "zero", 1)
    return [float(v) for v in outputs[0]]
