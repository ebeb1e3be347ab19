"""A model-exchange FMU as a model: simulated, identified and diagnosed like any other."""

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.component import Component, Equations, Expression, FmuUsed, Symbols
from psa_casadi.errors import InputError, Problems, PsaError, quoted
from psa_casadi.export.importer.fmu import Fmu
from psa_casadi.export.importer.imported import Imported, Selected, digest_of, imported_of, opened
from psa_casadi.model.compose import Model, compose
from psa_casadi.units import parse_unit
from psa_casadi.variables import Input, Output, Parameter, State, nominal_value

#: What `free` may be: names, or names with bounds or whole declarations.
Free = Sequence[str] | Mapping[str, tuple[float, float] | Parameter]
#: A range whose ends differ by this factor is searched on a logarithmic scale.
_DECADE = 10.0
_REALS = ("Real", "Float64")


@dataclass(frozen=True)
class Read:
    """What a model has of an FMU: the FMU's variables, and their declarations in the same order."""

    selected: Selected
    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...]


def read_variables(fmu: Fmu, free: Free | None, values: Mapping[str, float]) -> Read:
    """Return the variables of an FMU; see `fmu_model`. Raises InputError with every mistake."""
    problems = Problems()
    _refuse_unfit(fmu, problems)
    problems.raise_if_any()
    table = {v.name: v for v in fmu.description.modelVariables}
    for name in [n for n in values if n not in table or table[n].causality != "parameter"]:
        problems.add(f"`values` has '{name}', which is no parameter of {fmu.path.name}.")
    inputs = [v for v in table.values() if v.causality == "input"]
    outputs = [v for v in table.values() if v.causality == "output" and v.type in _REALS]
    wanted = _free(fmu, free, table, problems)
    problems.raise_if_any()
    parameters = [_parameter(table[n], given, values, problems) for n, given in wanted.items()]
    problems.raise_if_any()
    states = [table[n] for n in fmu.states()]
    taken = [v.name for v in (*inputs, *outputs)]
    read = Read(
        selected=Selected(
            states=tuple(v.name for v in states),
            rates=tuple(str(u.variable.name) for u in fmu.description.derivatives),
            inputs=tuple(v.name for v in inputs),
            outputs=tuple(v.name for v in outputs),
            parameters=tuple(wanted),
            fixed=tuple((n, float(v)) for n, v in values.items() if n not in wanted),
        ),
        states=tuple(
            State(_name(v.name, taken, "_state"), *_said(v), fmu.nominals[v.name]) for v in states
        ),
        inputs=tuple(
            Input(_name(v.name), *_said(v), _number(v.start), fmu.nominals[v.name]) for v in inputs
        ),
        outputs=tuple(Output(plain_name(v.name), *_said(v), fmu.nominals[v.name]) for v in outputs),
        parameters=tuple(parameters),
    )
    declared: Iterable[Any] = (*read.states, *read.inputs, *read.outputs, *read.parameters)
    every = [v.name for v in declared]
    for name in sorted({n for n in every if every.count(n) > 1}):
        problems.add(f"Two variables of the FMU become '{name}' here; rename one in its model.")
    problems.raise_if_any()
    return read


def _refuse_unfit(fmu: Fmu, problems: Problems) -> None:
    """Note why an FMU is no ordinary differential equation x' = f(t, x, u, p)."""
    exchange, name = fmu.description.modelExchange, fmu.path.name
    if exchange is None:
        problems.add(
            f"{name} has no model exchange: its equations cannot be asked for. Export it for model"
            " exchange from the tool that made it."
        )
        return
    if exchange.modelIdentifier != fmu.identifier:
        problems.add(
            f"{name} has one binary for each interface; export it for model exchange only."
        )
    if exchange.canBeInstantiatedOnlyOncePerProcess:
        problems.add(
            f"{name} gives one instance for each process; derivatives by parameters need several."
        )
    if fmu.indicator_count():
        problems.add(
            f"{name} has {fmu.indicator_count()} event indicators: it switches at events, over"
            " which no derivative leads. Export it with smooth equations, without events."
        )
    for v in fmu.description.modelVariables:
        if v.causality == "input" and (v.type not in _REALS or v.dimensions):
            problems.add(f"{name}: the input '{v.name}' is no real number but {v.type}.")
        elif v.causality == "output" and v.dimensions:
            problems.add(f"{name}: the output '{v.name}' is an array; give one output for each.")


def _free(
    fmu: Fmu, free: Free | None, table: Mapping[str, Any], problems: Problems
) -> dict[str, tuple[float, float] | Parameter]:
    """Return the parameters to identify with their bounds: those given, else the FMU's."""
    own = {v.name for v in table.values() if v.causality == "parameter" and v.type in _REALS}
    bounded = {n for n in own if math.isfinite(math.hypot(*fmu.bounds[n]))}
    if free is None:
        if not bounded:
            problems.add(
                f"No parameter of {fmu.path.name} has a least and a greatest value; name those to"
                f" identify with bounds, free={{name: (low, high)}}; it has {quoted(sorted(own))}."
            )
        return {n: fmu.bounds[n] for n in table if n in bounded}
    given = dict(free) if isinstance(free, Mapping) else dict.fromkeys(free)
    found: dict[str, tuple[float, float] | Parameter] = {}
    for name, bounds in given.items():
        if name not in own:
            problems.add(
                f"`free` has '{name}', which is no real parameter of {fmu.path.name}; it has"
                f" {quoted(sorted(own))}."
            )
        elif bounds is None and name not in bounded:
            problems.add(
                f"'{name}' has no bounds in {fmu.path.name}; give {{'{name}': (low, high)}}."
            )
        else:
            found[name] = fmu.bounds[name] if bounds is None else bounds
    return found


def _parameter(
    variable: Any,
    given: tuple[float, float] | Parameter,
    values: Mapping[str, float],
    problems: Problems,
) -> Parameter:
    if isinstance(given, Parameter):
        return given
    low, high = (float(b) for b in given)
    value = float(values.get(variable.name, _number(variable.start)))
    if not low <= value <= high or low == high:
        problems.add(
            f"'{variable.name}' is {value:g} in the FMU, outside [{low:g}, {high:g}]; give wider"
            " bounds, or another value in `values`."
        )
    log = low > 0 and high >= _DECADE * low
    scale = None if value else 0.1 * (high - low)
    unit, words = _said(variable)
    return Parameter(_name(variable.name), value, unit, (low, high), words, log=log, scale=scale)


def plain_name(name: str) -> str:
    """Return a name as an identifier: `body.phi[1]` is `body_phi_1`."""
    plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "variable"
    return f"_{plain}" if plain[0].isdigit() else plain


def _name(name: str, taken: Iterable[str] = (), suffix: str = "_of_fmu") -> str:
    """Return the name of a symbol: no output's, no sum's of this package, not time."""
    plain = plain_name(name)
    if name in taken:
        return plain + suffix
    return plain + "_of_fmu" if plain == "time" else plain


def _said(variable: Any) -> tuple[str, str]:
    """Return unit and description; "1" where this package does not know it or it is no SI unit."""
    said = variable.unit or getattr(variable.declaredType, "unit", None) or "1"
    words = str(variable.description or variable.name)
    try:
        unit = parse_unit(said)
    except InputError:
        return "1", words
    return said if unit.ratio == 1 and not unit.offset else "1", words


def _number(start: Any) -> float:
    return float(start) if start not in (None, "") else 0.0


#: Points at which it is looked whether a rate is another state, and nothing else.
_POINTS, _SEED = 4, 0


def fmu_model(
    path: str | os.PathLike[str],
    *,
    free: Free | None = None,
    values: Mapping[str, float] | None = None,
    name: str | None = None,
) -> Model:
    """Return the model x' = f(t, x, u, p), y = h(t, x, u, p) of a model-exchange FMU (FMI 2, 3).

    `psa.identify`, `psa.diagnose` and `psa.run` take it like an `ode_model`; its inputs, outputs
    and the rates of its states are ports to which effects attach. The FMU's binary computes f and
    h. Derivatives by x and u are the FMU's directional derivatives where it has them, else central
    differences; those by p are central differences of instances initialised with other values.

    `free` says which parameters are identified: {name: (low, high)}, {name: Parameter}, or names
    whose least and greatest values the FMU declares; by default all that have both. A range of a
    decade or more above 0 is searched on a logarithmic scale. `values` are numbers of parameters in
    the place of the FMU's. The states start where the FMU starts at its own values.

    Inputs, outputs and their names are those of the FMU, its units are kept where they are SI
    units, else they are "1"; nothing is converted. A name that is no identifier is written with
    underscores: `body.phi[1]` is `body_phi_1`; a state that is an output too is NAME_state.

    The FMU is unpacked and its binary runs in this process, without protection: load none that you
    would not run. The model is not exported, as it has no equations to print; MODEL.json names the
    FMU's file and its SHA-256. Two models of one FMU share instances.

    Raises InputError for a file that is no such FMU, has no binary for this machine, events, inputs
    that are no real numbers, or only one instance for each process, and for wrong names or bounds.
    """
    file = Path(path)
    digest = digest_of(file)
    fmu = opened(file.resolve(), digest)
    read = read_variables(fmu, free, values or {})
    imported = imported_of(fmu, digest, read.selected, _sizes(read))
    own = name or plain_name(str(fmu.description.modelName))
    component = Component(
        name=own,
        description=str(fmu.description.description or f"the FMU '{own}'"),
        source=f"{file.name}, sha256 {digest}",
        equations=_FmuEquations(imported, read, _definitions(imported, read)),
        parameters=read.parameters,
        states=read.states,
        inputs=read.inputs,
        outputs=read.outputs,
        foreign=imported.foreign,
    )
    names = read.selected.parameters
    declared = {n: p.value for n, p in zip(names, read.parameters, strict=True)}
    try:
        with imported.initialised(declared) as instance:
            starts = instance.vector("GetContinuousStates", len(read.states)).tolist()
    except PsaError as error:
        raise InputError(f"{fmu.path}: cannot be initialised ({error}); check `values`.") from error
    model = compose([component], name=own)
    return model.with_starts(dict(zip((s.name for s in read.states), starts, strict=True)))


def component_again(
    file: Path, used: FmuUsed, name: str, parameters: Sequence[Parameter]
) -> Component:
    """Return the component of an FMU with these parameters, if the file is that FMU.

    Raises InputError where there is no such file or it has another SHA-256, and as `fmu_model`.
    """
    there = file.is_file()
    if not there or digest_of(file) != used.sha256:
        why = "is another FMU than the one it was saved with" if there else "is not there"
        raise InputError(
            f"the model has the FMU '{used.file}' (sha256 {used.sha256}), and {file} {why}; put"
            " that FMU there, or type psa.load_model(MODEL, fmu=FMU) with the place where it is."
        )
    if len(parameters) != len(used.parameters):
        raise InputError(
            f"the FMU '{used.file}' has {len(used.parameters)} parameters named and"
            f" {len(parameters)} declared; declare each."
        )
    free = dict(zip(used.parameters, parameters, strict=True))
    return fmu_model(file, free=free, values=used.values, name=name).components[0]


def _sizes(read: Read) -> tuple[float, ...]:
    """Return the usual sizes of states, inputs and parameters."""
    nominals = [*(v.nominal for v in read.states), *(v.nominal for v in read.inputs)]
    sizes = [*(nominal_value(n, {}) for n in nominals), *(p.typical({}) for p in read.parameters)]
    return tuple(abs(size) or 1.0 for size in sizes)


@dataclass(frozen=True, eq=False)
class _FmuEquations:
    """The equations of an FMU: calls of its function; `same` are rows that are a state."""

    imported: Imported
    read: Read
    same: Mapping[int, int]

    def __call__(self, s: Symbols) -> Equations:
        read = self.read

        def column(names: Iterable[str]) -> Expression:
            return ca.vertcat(ca.SX(0, 1), *(getattr(s, n) for n in names))

        moving = [*(v.name for v in read.states), *(v.name for v in read.inputs)]
        w = self.imported.function(s.time, column(moving), column(p.name for p in read.parameters))
        rows = [
            getattr(s, moving[self.same[k]]) if k in self.same else w[k] for k in range(w.numel())
        ]
        count = len(read.states)
        return Equations(
            der={q.name: rows[k] for k, q in enumerate(read.states)},
            out={o.name: rows[count + k] for k, o in enumerate(read.outputs)},
        )


def _definitions(imported: Imported, read: Read) -> dict[int, int]:
    """Return which rates and outputs are a state and nothing else: row by place of the state.

    x' = v, or y = x: equal to the last bit at random points.
    """
    rng, count = np.random.default_rng(_SEED), len(read.states)
    sizes = np.array(_sizes(read)[: count + len(read.inputs)])
    p = [q.value for q in read.parameters]
    seen = []
    for _ in range(_POINTS):
        v = sizes * rng.uniform(0.1, 1.0, len(sizes))
        try:
            seen.append((v, np.array(imported.function(0.0, v, p))[:, 0]))
        except RuntimeError:  # where the equations are not defined
            continue
    rows = range(count + len(read.outputs)) if seen else ()
    found = {
        k: next((j for j in range(count) if all(w[k] == v[j] for v, w in seen)), -1) for k in rows
    }
    return {k: j for k, j in found.items() if j >= 0}
