"""Free functions at the ports of a model: what no effect of the table has to be.

    Q gains sum_k c_k m_k(r)

m_k are the monomials up to the third power of what the port sees (the states and inputs of a rate),
or up to the fifth of a signal, each over its size. They have no memory and no time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import prod

import casadi as ca
import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.effects.attached import LARGEST, ORDINARY, Attached, extended
from psa_casadi.any_model.fit import OdeFit, fit_ode
from psa_casadi.any_model.hypothesis import OdeHypothesis, OdeView, hypothesis_of
from psa_casadi.any_model.predict import traced
from psa_casadi.any_model.search import Known
from psa_casadi.any_model.sizes import Sizes, sizes_of
from psa_casadi.any_model.start import start_of
from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.diagnosis.noise.colour import noise_rms
from psa_casadi.diagnosis.screening.screen import independent, whitened_jacobian, without
from psa_casadi.errors import PsaError
from psa_casadi.model.compose import Model
from psa_casadi.model.from_casadi.ports import Port, ports_of, true_output
from psa_casadi.variables import Parameter

FloatArray = npt.NDArray[np.float64]

_OF_SIGNAL, _OF_STATES, _VARIABLES = 5, 3, 3
#: So many ports are fitted, and with so many evaluations.
_FITTED, _EVALUATIONS = 2, 25


@dataclass(frozen=True)
class Free:
    """A free function: of what, at which port, its evidence over the base, and what it removes."""

    port: Port
    of: str
    evidence: float
    share: float


def free_functions(known: Known, view: OdeView) -> tuple[Free, ...]:
    """Return the most telling free functions beside the base, fitted, the best first."""
    root = view.of
    sizes = sizes_of(known.table.base, known.runs, root.fit.starts())
    tried = [_free(known.table.base, p, sizes) for p in ports_of(known.table.base)]
    scored: list[tuple[float, Attached, str]] = []
    for attached, of in tried:
        try:
            scored.append((_decrease(known, view, attached), attached, of))
        except PsaError:
            continue
    scored.sort(key=lambda s: -s[0])
    found = []
    for _, attached, of in scored[:_FITTED]:
        known.progress(f"a free function in {attached.port.words}")
        h = hypothesis_of((attached.component,), _fitted(known, root, attached), known.runs)
        if h is not None:
            found.append(Free(attached.port, of, known.evidence(h), _share(known, root, h, view)))
    return tuple(sorted(found, key=lambda f: -f.evidence))


def _share(known: Known, root: OdeHypothesis, h: OdeHypothesis, view: OdeView) -> float:
    """Return what it removes of the held-out error above the noise."""
    colours = (view.screening.colour, *view.screening.colour.further)
    above = left = 0.0
    for k, (o, own) in enumerate(zip(h.fit.outputs, colours, strict=True)):
        noise = max(noise_rms(o.residuals, own), 1e-300)
        base, new = (x.held[k] or x.train[k] for x in (root, h))
        above += (base / noise) ** 2 - 1.0
        left += (new / noise) ** 2 - 1.0
    return 1.0 - left / above if above > 0 else 0.0


def _fitted(known: Known, root: OdeHypothesis, attached: Attached) -> OdeFit | None:
    before = root.fit
    model = extended(known.table.base, [attached])
    try:
        return fit_ode(
            model, known.runs, [*before.unknowns.names, *attached.component.fitted],
            levels=before.levels, starts=before.starts(), evaluations=_EVALUATIONS,
            tolerance=1e-4, rtol=before.rtol, zeros=before.zeros, known_start=before.known_start,
        )  # fmt: skip
    except PsaError:
        return None


def _decrease(known: Known, view: OdeView, attached: Attached) -> float:
    """Return the decrease of the whitened sum of squares that the coefficients promise together."""
    fit, colour = view.of.fit, view.screening.colour
    model, starts = extended(known.table.base, [attached]), view.of.fit.starts()
    names: list[str | int] = list(attached.component.fitted)
    columns = []
    for o in fit.outputs:
        parts = []
        for k in o.runs:
            run = known.runs[k]
            begun = start_of(model, run.inputs[0], starts[k])
            none = np.zeros((len(model.state_names), len(names)))
            slopes = traced(model, run, begun.x, names, none, o.column, fit.rtol)[1]
            parts.append(slopes[run.fitted(o.index)[: run.stop]])
        columns.append(np.vstack(parts))
    whole = colour.whiten_all(columns[0], columns[1:])
    basis = independent(whitened_jacobian(fit, colour))
    residual = colour.whiten_all(fit.residuals, [f.residuals for f in fit.further])
    free = independent(without(whole, basis))
    return float(np.sum((free.T @ without(residual, basis)) ** 2))


def _free(model: Model, port: Port, sizes: Sizes) -> tuple[Attached, str]:
    """Return the free function of a port, and of what it is, in words."""
    scales = {**sizes.inputs, **sizes.states}
    if port.kind == "rate":
        rate = model.structure.xdot[model.state_names.index(port.variable)]
        seen = {q.name() for q in ca.symvar(rate)} | {port.variable}
        names = [n for n in (*model.state_names, *model.input_names) if n in seen][:_VARIABLES]
        size, powers = sizes.rates[port.variable], range(1, _OF_STATES + 1)
        symbols = dict.fromkeys(names, "")
    else:
        names, powers = [port.variable], range(2, _OF_SIGNAL + 1)
        size = (sizes.inputs if port.kind == "input" else sizes.outputs)[port.variable]
        scales = {port.variable: size}
        symbols = {port.variable: "" if port.kind == "input" else true_output(port.variable)}
    terms = [t for p in powers for t in combinations_with_replacement(names, p)]
    prefix = f"free_in_{port.kind}_{port.variable}"
    equations = _law(port, prefix, terms, {n: symbols[n] or n for n in names}, scales)
    component = Component(
        name=prefix,
        description=f"{port.words}: a free function of {' and '.join(names)}",
        source="polynomial without physics",
        equations=equations,
        parameters=tuple(
            Parameter(
                f"{prefix}_{k}", 0.0, port.unit, (-LARGEST * size, LARGEST * size),
                f"coefficient of {'*'.join(t)}", scale=ORDINARY * size,
            )
            for k, t in enumerate(terms)
        ),
        gain=f"{prefix}_0",
    )  # fmt: skip
    return Attached(component, port), " and ".join(names)


def _law(
    port: Port,
    prefix: str,
    terms: Sequence[tuple[str, ...]],
    symbols: dict[str, str],
    scales: dict[str, float],
) -> Callable[[Symbols], Equations]:
    def equations(s: Symbols) -> Equations:
        total = sum(
            getattr(s, f"{prefix}_{k}") * prod(getattr(s, symbols[n]) / scales[n] for n in term)
            for k, term in enumerate(terms)
        )
        return Equations(add={port.balance: total})

    return equations
