"""Free functions at the ports of a model: what no effect of the table has to be.

    Q gains sum_k c_k m_k(r)

m_k are the monomials up to the third power of what the port sees (the states and inputs of a rate),
or up to the fifth of a signal, each over its size. They have no memory and no time.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from math import prod

import casadi as ca
import numpy as np

from psa_casadi.component import Component, Equations, Symbols
from psa_casadi.diagnosis.corrections import FreeFunction
from psa_casadi.diagnosis.generic.attached import LARGEST, ORDINARY, Attached, extended
from psa_casadi.diagnosis.pack import Task
from psa_casadi.diagnosis.probes import changes
from psa_casadi.diagnosis.screening import (
    independent,
    whitened_jacobian,
    whitened_residuals,
    without,
)
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, Scale, View, hypothesis
from psa_casadi.errors import PsaError
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.refitting import refit, weighted
from psa_casadi.identification.result import with_told
from psa_casadi.model.compose import Model
from psa_casadi.model.ports import Port, ports_of, true_output
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.sizes import Sizes, sizes_of, states_of
from psa_casadi.units import FloatArray
from psa_casadi.variables import Parameter

_OF_SIGNAL, _OF_STATES, _VARIABLES = 5, 3, 3
#: So many ports are fitted, and with so many evaluations.
_FITTED, _EVALUATIONS = 2, 25


@dataclass(frozen=True)
class _Law:
    """The monomials of a free function, and the sizes that its variables are taken over."""

    names: tuple[str, ...]
    terms: tuple[tuple[str, ...], ...]
    scales: dict[str, float]


def model_of(
    base: Model,
    fit: Fit,
    effects: Sequence[Attached],
    experiments: Sequence[Experiment],
    *,
    interrupted: bool = False,
) -> Model:
    """Return the model of a fit, open at the ports of its effects alone, with how sure it is."""
    model = extended(base, effects)
    values = {n: v for n, v in fit.model.values.items() if n in model.values}
    sure, given = determinacy(fit, experiments), [e.record for e in experiments]
    return with_told(
        model.with_values(values), given, sure.names, sure.intervals, force_scale="given",
        interrupted=interrupted,
    )  # fmt: skip


def fit_free_functions(
    view: View, task: Task, base: Model, effects: Sequence[Attached], scale: Scale
) -> list[FreeFunction]:
    """Fit the most telling free functions beside a hypothesis; return them, the best first.

    `base` is the model before its ports were opened, `effects` are the hypothesis' causes.
    """
    of, experiments = view.of, task.experiments
    starts = [{n: v for n, v in s.items() if n in base.state_names} for s in of.fit.starts()]
    sizes = sizes_of(base, experiments, starts)
    scored: list[tuple[float, Attached, _Law]] = []
    for attached, law in [_free(base, p, sizes) for p in ports_of(base)]:
        with suppress(PsaError):
            scored.append((_decrease(view, attached, experiments), attached, law))
    scored.sort(key=lambda s: -s[0])
    found = []
    for _, attached, law in scored[:_FITTED]:
        task.progress(f"a free function in {attached.port.words}")
        with suppress(PsaError):
            model = of.fit.model.with_effect(attached.component)
            fit = refit(
                replace(of.fit, model=model), weighted(of.fit, experiments),
                [*of.fit.unknowns.names, *attached.component.fitted],
                sigma=of.fit.sigma, evaluations=_EVALUATIONS, tolerance=1e-4,
            )  # fmt: skip
            h = hypothesis((*of.causes, attached.component), fit, experiments)
            if h is not None:
                gained = scale.evidence(h) - scale.evidence(of)
                model = model_of(base, fit, [*effects, attached], experiments)
                found.append(_told(h, attached, law, model, gained, experiments))
    return sorted(found, key=lambda f: -f.evidence)


def _told(
    h: Hypothesis,
    attached: Attached,
    law: _Law,
    model: Model,
    evidence: float,
    experiments: Sequence[Experiment],
) -> FreeFunction:
    """Return a fitted function, and what it adds beside the variable that it follows most."""
    component = attached.component
    values = _along(h.fit, component.fitted, experiments, law.names)
    added = np.asarray(
        sum(
            h.fit.model.values[c] * prod(values[n] / law.scales[n] for n in term)
            for c, term in zip(component.fitted, law.terms, strict=True)
        )
    )

    def scatter(name: str) -> float:
        """What a polynomial of one variable leaves of what is added (sum of squares)."""
        place = values[name] / max(float(np.max(np.abs(values[name]))), 1e-300)
        powers = np.vander(place, _OF_SIGNAL + 1)
        rest = added - powers @ np.linalg.lstsq(powers, added, rcond=None)[0]
        return float(rest @ rest)

    name, s = min(values, key=scatter), h.fit.model.structure
    units = {v.name: v.unit for rows in (s.states, s.inputs, s.outputs) for v in rows}
    return FreeFunction(
        port=attached.port.words,
        evidence=evidence,
        held=h.errors,
        predicted=h.shown,
        of=" and ".join(law.names),
        unit=attached.port.unit,
        variable=name,
        variable_unit=units[name],
        along=values[name],
        added=added,
        model=model,
    )


def _along(
    fit: Fit, coefficients: Sequence[str], experiments: Sequence[Experiment], names: Sequence[str]
) -> dict[str, FloatArray]:
    """Return variables along all records: inputs, states, or outputs before their sensors."""
    model, found = fit.model, dict[str, FloatArray]()
    inputs = [n for n in names if n in model.input_names]
    for n in inputs:
        found[n] = np.concatenate([e.record.column(n) for e in experiments])
    states = [n for n in names if n in model.state_names and n not in found]
    if states:
        theta = fit.placed(experiments)
        x = np.vstack([
            states_of(model, e, fit.unknowns.start(theta, r), fit.way.step_rtol)
            for r, e in enumerate(experiments)
        ])  # fmt: skip
        found |= {n: x[:, model.state_names.index(n)] for n in states}
    outputs = [n for n in names if n not in found]
    if outputs:
        y = np.vstack(fit.at(dict.fromkeys(coefficients, 0.0)).outputs(experiments))
        found |= {n: y[:, model.output_names.index(n)] for n in outputs}
    return {n: found[n] for n in names}


def _decrease(view: View, attached: Attached, experiments: Sequence[Experiment]) -> float:
    """Return the decrease of the whitened sum of squares that the coefficients promise together."""
    fit, colour = view.of.fit, view.screening.colour
    model = fit.model.with_effect(attached.component)
    moved = dict.fromkeys(attached.component.fitted, 1.0)
    columns, further = changes(fit, experiments, model, moved, tuple(fit.starts()), 0.0)
    basis = independent(whitened_jacobian(fit, colour))
    free = independent(without(colour.whiten_all(columns, further), basis))
    return float(np.sum((free.T @ without(whitened_residuals(fit, colour), basis)) ** 2))


def _free(model: Model, port: Port, sizes: Sizes) -> tuple[Attached, _Law]:
    """Return the free function of a port, and its monomials."""
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
    equations = _equations(port, prefix, terms, {n: symbols[n] or n for n in names}, scales)
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
    own = {n: scales[n] for n in names}
    return Attached(component, port), _Law(tuple(names), tuple(terms), own)


def _equations(
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
