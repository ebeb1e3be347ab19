"""A model-exchange FMU as a model: simulated, identified and diagnosed like any other."""

import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePath
from typing import Any, Literal

import casadi as ca
import numpy as np

from psa_casadi.common.errors import InputError, Problems, PsaError, quoted
from psa_casadi.common.units import parse_unit
from psa_casadi.export.common.variable_table import OPTIONS
from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu
from psa_casadi.export.importer.imported import (
    Imported,
    Selected,
    TimeEventError,
    digest_of,
    imported_of,
    opened,
)
from psa_casadi.export.importer.played import Passed, Played
from psa_casadi.model.component import Component, Equations, Expression, FmuUsed, Foreign, Symbols
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.model_file import model_of, no_fmu, read_content
from psa_casadi.model.variables import Input, Output, Parameter, State, nominal_value

#: What `free` may be: names, or names with bounds or whole declarations.
Free = Sequence[str] | Mapping[str, tuple[float, float] | Parameter | None]
#: A range whose ends differ by this factor is searched on a logarithmic scale.
_DECADE = 10.0
_REALS = ("Real", "Float64")
FmuInterface = Literal["model exchange", "co-simulation"]
_NAMES: dict[int, FmuInterface] = {
    MODEL_EXCHANGE: "model exchange", CO_SIMULATION: "co-simulation",
}  # fmt: skip


@dataclass(frozen=True)
class Read:
    """What a model has of an FMU: the FMU's variables, and their declarations in the same order."""

    selected: Selected
    states: tuple[State, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...]


def read_variables(
    fmu: Fmu, free: Free | None, values: Mapping[str, float], *, whole: bool = False
) -> Read:
    """Return the variables of an FMU; see `fmu_model`. Raises InputError with every mistake.

    Of one that is run as a `whole` there are no states, numbers of every type, and elements of
    arrays.
    """
    problems = Problems()
    rows = {n: fmu.variables[e.variable] for n, e in fmu.elements.items()}
    inputs, outputs = (
        {n: v for n, v in rows.items() if v.causality == causality and n not in values}
        for causality in ("input", "output")
    )
    if not whole:
        outputs = {n: v for n, v in outputs.items() if v.type in _REALS}
    parameter_names = {
        n
        for n, v in rows.items()
        if v.causality == "parameter" or (whole and _has_exact_start(fmu, n))
    }
    fixed = parameter_names | {n for n, v in rows.items() if v.causality == "input"}
    for name in [n for n in values if n not in fixed]:
        problems.add(
            f"`values` has '{name}', which is no parameter or input of {fmu.path.name}; it has"
            f" {quoted(sorted(fixed)) or 'none'}."
        )
    wanted = _free(fmu, free, parameter_names, problems)
    problems.raise_if_any()
    parameters = [
        _parameter(n, fmu, rows[n], arguments, values, problems) for n, arguments in wanted.items()
    ]
    problems.raise_if_any()
    states = [] if whole else [fmu.variables[n] for n in fmu.states()]
    taken = [*inputs, *outputs]
    nominals = fmu.nominals
    read = Read(
        selected=Selected(
            states=tuple(v.name for v in states),
            rates=tuple(str(u.variable.name) for u in fmu.description.derivatives[: len(states)]),
            inputs=tuple(inputs),
            outputs=tuple(outputs),
            parameters=tuple(wanted),
            fixed=tuple((n, float(v)) for n, v in values.items() if n not in wanted),
        ),
        states=tuple(
            State(_name(v.name, taken, "_state"), *_unit_and_words(v, v.name), nominals[v.name])
            for v in states
        ),
        inputs=tuple(
            Input(_name(n), *_unit_and_words(v, n), fmu.elements[n].start, nominals[n])
            for n, v in inputs.items()
        ),
        outputs=tuple(
            Output(plain_name(n), *_unit_and_words(v, n), nominals[n]) for n, v in outputs.items()
        ),
        parameters=tuple(parameters),
    )
    declared: Iterable[Any] = (*read.states, *read.inputs, *read.outputs, *read.parameters)
    every = [v.name for v in declared]
    for name in sorted({n for n in every if every.count(n) > 1}):
        problems.add(f"Two variables of the FMU become '{name}' here; rename one in its model.")
    if not read.outputs:
        problems.add(f"{fmu.path.name} has no output that is a number; nothing can be compared.")
    problems.raise_if_any()
    return read


def _has_exact_start(fmu: Fmu, name: str) -> bool:
    """Whether a real variable that is no parameter has a start value that can be set."""
    variable = fmu.variables[fmu.elements[name].variable]
    inside = variable.causality in ("local", "output")
    return fmu.elements[name].real and variable.initial == "exact" and inside


def _has_equations(fmu: Fmu) -> bool:
    """Whether an FMU is an ordinary differential equation x' = f(t, x, u, p), but for its times.

    By model exchange of its binary, in several instances, without event indicators, real
    numbers in and one at least out.
    """
    exchange = fmu.description.modelExchange
    if exchange is None or exchange.modelIdentifier != fmu.identifier:
        return False
    if exchange.canBeInstantiatedOnlyOncePerProcess or fmu.indicator_count():
        return False
    every = fmu.description.modelVariables
    inputs, outputs = ([v for v in every if v.causality == c] for c in ("input", "output"))
    scalars = not any(v.dimensions for v in (*inputs, *outputs))
    reals = all(v.type in _REALS for v in inputs) and any(v.type in _REALS for v in outputs)
    return scalars and reals


def _free(
    fmu: Fmu, free: Free | None, numbers: Iterable[str], problems: Problems
) -> dict[str, tuple[float, float] | Parameter]:
    """Return the parameters to identify with their bounds: those of `free`, else the FMU's."""
    reals = {n for n in numbers if fmu.elements[n].real}
    bounded = {n for n in reals if math.isfinite(math.hypot(*fmu.bounds[n])) and n not in OPTIONS}
    if free is None:
        if not bounded:
            every = {n: e.start for n, e in fmu.elements.items() if n in reals}
            listed = ", ".join(f"{n} ({v:g})" for n, v in every.items()) or "none"
            name, v = next(iter(every.items()), ("k", 1.0))
            low, high = sorted((0.1 * v, 10.0 * v)) if v else (-1.0, 1.0)
            problems.add(
                f"{fmu.path.name} declares no bounds for its parameters: {listed}. Say which to"
                f" identify within which bounds: free={{'{name}': ({low:g}, {high:g})}}, on the"
                f" command line --free {name}={low:g}:{high:g}."
            )
        return {n: fmu.bounds[n] for n in fmu.elements if n in bounded}
    wanted = dict(free) if isinstance(free, Mapping) else dict.fromkeys(free)
    table: dict[str, tuple[float, float] | Parameter] = {}
    for name, bounds in wanted.items():
        if name not in reals:
            problems.add(
                f"`free` has '{name}', which is no real parameter of {fmu.path.name}; it has"
                f" {quoted(sorted(reals)) or 'none'}."
            )
        elif bounds is None and name not in bounded:
            problems.add(
                f"'{name}' has no bounds in {fmu.path.name}; give {{'{name}': (low, high)}}, on the"
                f" command line --free {name}=LOW:HIGH."
            )
        else:
            table[name] = fmu.bounds[name] if bounds is None else bounds
    return table


def _parameter(
    name: str,
    fmu: Fmu,
    variable: Any,
    parameter: tuple[float, float] | Parameter,
    values: Mapping[str, float],
    problems: Problems,
) -> Parameter:
    if isinstance(parameter, Parameter):
        return parameter
    low, high = (float(b) for b in parameter)
    value = float(values.get(name, fmu.elements[name].start))
    if low >= high:
        problems.add(f"'{name}' has the bounds [{low:g}, {high:g}]; give the lower one first.")
    elif not low <= value <= high:
        problems.add(
            f"'{name}' is {value:g} in the FMU, outside [{low:g}, {high:g}]; give wider"
            " bounds, or another value in `values`."
        )
    log = low > 0 and high >= _DECADE * low
    scale = None if value else 0.1 * (high - low)
    unit, words = _unit_and_words(variable, name)
    return Parameter(_name(name), value, unit, (low, high), words, log=log, scale=scale)


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


def _unit_and_words(variable: Any, name: str) -> tuple[str, str]:
    """Return unit and description; "1" where this package does not know the unit."""
    symbol = variable.unit or getattr(variable.declaredType, "unit", None) or "1"
    words = str(variable.description or name)
    try:
        parse_unit(symbol)
    except InputError:
        return "1", words
    return symbol, words


#: Points at which it is looked whether a rate is another state, and nothing else.
_POINTS, _SEED = 4, 0


def fmu_model(
    path: str | os.PathLike[str],
    *,
    free: Free | None = None,
    values: Mapping[str, float] | None = None,
    name: str | None = None,
    interface: FmuInterface | None = None,
) -> Model:
    """Return an FMU (FMI 2, 3) as a model to simulate, identify and diagnose.

    One of model exchange without events is x' = f(t, x, u, p), y = h(t, x, u, p), like an
    `ode_model`: its inputs, outputs and the rates of its states are ports to which effects attach.
    Its binary computes f and h in this process. Derivatives by x and u are the FMU's directional
    derivatives where it has them, else central differences; those by p are central differences of
    instances initialised with other values. The states start where the FMU starts.

    Any other one is run as a whole, in separate processes: by model exchange with its events
    (fmpy's CVode), or by co-simulation where it has no other interface. Its inputs and outputs are
    the ports; derivatives are differences of runs, side by side, 0.1 % of a parameter apart. It
    starts from its start values at the beginning of each record. Between communication points an
    input is a straight line where the FMU takes input derivatives, else its mean over the step;
    these are the samples, or as many parts of them as it takes until twice as many change no output
    by more than 0.05 % of its standard deviation. Numbers of every type are inputs and outputs,
    elements of arrays too.

    `free` are the parameters that are identified: {name: (low, high)}, {name: Parameter}, or names
    whose least and greatest values the FMU declares; by default all parameters that have both. Of
    one run as a whole, start values of its variables can be named, too. A range of a decade or more
    above 0 is searched on a logarithmic scale. `values` are numbers of parameters in the place of
    the FMU's, and of inputs that no record has, which stay there. `interface` is "model exchange"
    or "co-simulation", by default the first one if it has that.

    Inputs, outputs and their names are those of the FMU, its units are kept where they are SI
    units, else they are "1"; columns of records are converted to these. A name that is no
    identifier is written with underscores: `body.phi[1]` is `body_phi_1`; a state that is an output
    too is NAME_state.

    The binary runs without protection: load none that you would not run. The model is not exported,
    as it has no equations to print; MODEL.json names the FMU's file and its SHA-256. Two models of
    one FMU share instances.

    Raises InputError for a file that is no FMU, has no binary for this machine or not that
    interface, and for wrong names or bounds.
    """
    file = Path(path)
    digest = digest_of(file)
    fmu = opened(file.resolve(), digest)
    chosen = None if interface is None else _interface(fmu, interface)
    if chosen != CO_SIMULATION and _has_equations(fmu):
        with suppress(TimeEventError):
            return _of_equations(fmu, digest, free, values or {}, name)
    chosen = _interface(fmu, None) if chosen is None else chosen
    read = read_variables(fmu, free, values or {}, whole=True)
    s, names = read.selected, tuple(p.name for p in read.parameters)
    played = Played(str(file.resolve()), digest, chosen, s, names)
    used = FmuUsed(file.name, digest, s.parameters, dict(s.fixed), _NAMES[chosen])
    foreign = Foreign(f"fmu_{digest[:16]}", _no_function, used, str(file.resolve()))
    equations = Passed(tuple((o.name, "") for o in read.outputs))
    return _composed(fmu, read, equations, foreign, name, played)


def _interface(fmu: Fmu, wanted: FmuInterface | None) -> int:
    """Return how an FMU is run as a whole. Raises InputError."""
    there = [_NAMES[k] for k in sorted(fmu.interfaces())]  # model exchange first
    if wanted is not None and wanted not in there:
        raise InputError(f"{fmu.path.name} has no {wanted}, only {quoted(there)}; choose that.")
    chosen = CO_SIMULATION if (wanted or there[0]) == _NAMES[CO_SIMULATION] else MODEL_EXCHANGE
    fmu.loaded(chosen)  # raises where there is no binary
    return chosen


def _no_function() -> tuple[int, int]:
    return 0, 0


def _composed(
    fmu: Fmu, read: Read, equations: Callable[[Symbols], Equations], foreign: Foreign,
    name: str | None, played: Played | None = None,
) -> Model:  # fmt: skip
    name = name or plain_name(str(fmu.description.modelName))
    component = Component(
        name=name,
        description=str(fmu.description.description or f"the FMU '{name}'"),
        source=f"{foreign.fmu.file}, sha256 {foreign.fmu.sha256}",
        equations=equations,
        parameters=read.parameters,
        states=read.states,
        inputs=read.inputs,
        outputs=read.outputs,
        foreign=foreign,
        played=played,
    )
    return compose([component], name=name)


def _of_equations(
    fmu: Fmu, digest: str, free: Free | None, values: Mapping[str, float], name: str | None
) -> Model:
    """Return the model of an FMU whose equations are evaluated."""
    read = read_variables(fmu, free, values)
    imported = imported_of(fmu, digest, read.selected, _sizes(read))
    declared = {n: p.value for n, p in zip(read.selected.parameters, read.parameters, strict=True)}
    try:
        with imported.initialised(declared) as instance:
            starts = instance.vector("GetContinuousStates", len(read.states)).tolist()
    except (InputError, TimeEventError):  # of the file, not of its values
        raise
    except PsaError as error:
        raise InputError(f"{fmu.path}: cannot be initialised ({error}); check `values`.") from error
    equations = _FmuEquations(imported, read, _definitions(imported, read))
    model = _composed(fmu, read, equations, imported.foreign, name)
    return model.with_starts(dict(zip((s.name for s in read.states), starts, strict=True)))


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
    items = []
    for _ in range(_POINTS):
        v = sizes * rng.uniform(0.1, 1.0, len(sizes))
        try:
            items.append((v, np.array(imported.function(0.0, v, p))[:, 0]))
        except RuntimeError:  # where the equations are not defined
            continue
    rows = range(count + len(read.outputs)) if items else ()
    table = {
        k: next((j for j in range(count) if all(w[k] == v[j] for v, w in items)), -1) for k in rows
    }
    return {k: j for k, j in table.items() if j >= 0}


def load_model(
    path: str | os.PathLike[str],
    effects: Iterable[Component] = (),
    *,
    fmu: str | os.PathLike[str] | None = None,
) -> Model:
    """Read MODEL.json; `effects` are the user's effects that it may have.

    Equations in the file are read as text, none of it is run. The binary of an FMU that the model
    has runs in this process: `fmu` is that FMU or the folder with it, by default the folder of
    MODEL.json, and where that has not the FMU of its SHA-256 the current folder.

    Raises InputError with every unknown name, missing or bad value, and for an FMU that is not
    there or has another SHA-256 than when the model was saved.
    """
    places = [Path(path).parent, Path()] if fmu is None else [Path(fmu)]
    return model_of(read_content(path), str(path), effects, partial(_component_at, places))


def _component_at(
    places: Sequence[Path], used: FmuUsed, name: str, parameters: tuple[Parameter, ...]
) -> Component:
    """Return the component of an FMU that lies at one of the places, or in it.

    Raises InputError where there is no such file or it has another SHA-256, and as `fmu_model`.
    """
    if PurePath(used.file).name != used.file:
        return no_fmu(used, name, parameters)
    files = [place / used.file if place.is_dir() else place for place in places]
    file = next((f for f in files if f.is_file() and digest_of(f) == used.sha256), None)
    if file is None:
        there = files[0].is_file()
        why = "is another FMU than the one it was saved with" if there else "is not there"
        raise InputError(
            f"the model has the FMU '{used.file}' (sha256 {used.sha256}), and {files[0]} {why}; put"
            " that FMU there, or type psa.load_model(MODEL, fmu=FMU) with the place where it is."
        )
    if len(parameters) != len(used.parameters):
        raise InputError(
            f"the FMU '{used.file}' has {len(used.parameters)} parameters named and"
            f" {len(parameters)} declared; declare each."
        )
    free = dict(zip(used.parameters, parameters, strict=True))
    chosen = fmu_model(
        file, free=free, values=used.values, name=name, interface=used.interface or None
    )
    return chosen.components[0]
