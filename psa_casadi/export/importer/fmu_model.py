"""A model-exchange FMU as a model: simulated, identified and diagnosed like any other."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from psa_casadi.component import Component, Equations, Expression, Symbols
from psa_casadi.errors import InputError, PsaError
from psa_casadi.export.importer.fmu_variables import (
    Free,
    Read,
    plain_name,
    read_variables,
)
from psa_casadi.export.importer.imported import (
    Imported,
    digest_of,
    imported_of,
    opened,
)
from psa_casadi.model.compose import Model, compose
from psa_casadi.variables import nominal_value

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
    would not run. The model is neither exported nor saved, as it has no equations to print; two
    models of one FMU share instances.

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
    starts = zip((s.name for s in read.states), _starts(imported, read), strict=True)
    return compose([component], name=own).with_starts(dict(starts))


def _sizes(read: Read) -> tuple[float, ...]:
    """Return the usual sizes of states, inputs and parameters."""
    nominals = [*(v.nominal for v in read.states), *(v.nominal for v in read.inputs)]
    sizes = [*(nominal_value(n, {}) for n in nominals), *(p.typical({}) for p in read.parameters)]
    return tuple(abs(size) or 1.0 for size in sizes)


def _starts(imported: Imported, read: Read) -> list[float]:
    """Return the states with which the FMU starts at its declared values. Raises InputError."""
    values = {
        n: p.value for n, p in zip(imported.selected.parameters, read.parameters, strict=True)
    }
    try:
        with imported.initialised(values) as instance:
            return list(instance.vector("GetContinuousStates", len(read.states)))
    except PsaError as error:
        raise InputError(
            f"{imported.fmu.path}: cannot be initialised ({error}); check `values`."
        ) from error


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
