"""Effects that are not of this package: of an installed one, or of a module that a user names.

    dry_friction.py:  DRY_FRICTION = psa.Component("dry_friction", ..., gain="friction_force")
    psa diagnose record.csv --effects dry_friction

An installed package announces a module with the entry point `psa_casadi.effects`; its effects are
then in every search. A file never names code to run: MODEL.json states which module an effect
came from, and whoever reads it must have named or installed that module.
"""

import hashlib
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from types import ModuleType

import casadi as ca

from psa_casadi.common.errors import InputError, Problems
from psa_casadi.model.component import Component, OnDemand
from psa_casadi.model.components import BASE, COMPONENTS
from psa_casadi.model.compose import compose
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.effects.mechanics import MODAL_SERIES

#: Group of the entry points that announce modules with effects.
GROUP = "psa_casadi.effects"


@cache
def load_effects(module: str) -> Mapping[str, Component]:
    """Return the effects that a named module holds, by name.

    It is an installed one, else one of the current folder. The effects are its variables that are a
    `Component` with a gain, or those of its mapping or sequence `EFFECTS` where it has one. Raises
    InputError where the module cannot be imported, holds none, or holds one that does not compose
    with the base model.
    """
    return _fitting_the_base(declared_effects(module))


def declared_effects(module: str) -> Mapping[str, Component]:
    """Return the effects that a named module holds, whether they compose with the base or not."""
    return _effects_of(_imported(module, here=True))


def _fitting_the_base(components: Mapping[str, Component]) -> Mapping[str, Component]:
    if unfit := misfits(components.values()):
        raise InputError(unfit)
    return components


def misfits(effects: Iterable[Component]) -> list[str]:
    """Return why effects do not compose with a stack's base model, a sentence for each fault."""
    problems: list[str] = []
    for component in effects:
        try:
            compose((*BASE, component))
        except InputError as error:
            problems += [f"{component.home}: {sentence}" for sentence in error.problems]
    return problems


@cache
def _effects_of(source: ModuleType) -> Mapping[str, Component]:
    module = source.__name__
    listed = getattr(source, "EFFECTS", None)
    values = listed.values() if isinstance(listed, Mapping) else listed
    every = vars(source).values() if values is None else values
    effects = dict.fromkeys(c for c in every if isinstance(c, Component) and c.gain is not None)
    if not effects:
        path = getattr(source, "__file__", None)
        raise InputError(
            f"The module '{module}'{f' ({path})' if path else ''} holds no effect: a variable that"
            " is a `Component` with a gain, or a mapping EFFECTS of them."
        )
    problems, series = Problems(), {c.name: c for c in MODAL_SERIES.values()}
    for component in effects:
        if component.name in {**COMPONENTS, **EFFECTS, **series}:
            problems.add(f"{module}: an effect of this package is named '{component.name}' too.")
    problems.raise_if_any()
    return {c.name: replace(c, home=module) for c in effects}


@cache
def installed_effects() -> Mapping[str, Component]:
    """Return the effects of installed packages that have the entry point; raises InputError."""
    with _installed_only():
        modules = sorted({e.value.partition(":")[0] for e in entry_points(group=GROUP)})
    each = [_fitting_the_base(_effects_of(_imported(module))) for module in modules]
    return {name: c for effects in each for name, c in effects.items()}


def known_effects(components: Iterable[Component] = ()) -> dict[str, Component]:
    """Return the effects of this package, installed ones, and the user's `components`, by name."""
    return {**EFFECTS, **installed_effects(), **{c.name: c for c in components}}


def declaration_hash(component: Component) -> str:
    """Return the SHA-256 of what a component declares: names, values, bounds and equations."""
    written = component.equations(OnDemand())
    sums = (written.der, written.add, written.out, written.switches, written.next)
    equations = [sorted((name, str(ca.SX(e))) for name, e in part.items()) for part in sums]
    parameters = [
        (p.name, p.value, p.unit, p.bounds, p.log, p.fitted) for p in component.parameters
    ]
    states = [(s.name, s.unit, s.start, s.memory, s.settles) for s in component.states]
    inputs = [(i.name, i.unit, i.start) for i in component.inputs]
    text = repr((component.name, component.gain, parameters, states, inputs, equations))
    return hashlib.sha256(text.encode()).hexdigest()


@contextmanager
def _installed_only() -> Iterator[None]:
    """Leave the current folder out of where modules come from, as `python -P` does.

    A file that lies there by chance, or that somebody else has put there, is not imported.
    """
    before, here = list(sys.path), os.getcwd()
    sys.path[:] = [p for k, p in enumerate(before) if p and not (k == 0 and p == here)]
    kept = list(sys.path)
    try:
        yield
    finally:
        sys.path[:] = [*before, *(p for p in sys.path if p not in (*kept, here))]


def _imported(module: str, *, here: bool = False) -> ModuleType:
    """Return an installed module; where there is none and `here`, one of the current folder."""
    with _installed_only():
        try:
            top = module.partition(".")[0]
            spec = None if top in sys.modules else find_spec(top)
            if here and (spec is None or spec.origin is None):  # nothing, or a mere folder
                sys.path.append(os.getcwd())
            return import_module(module)
        except Exception as error:  # the user's code may raise anything
            raise InputError(
                f"The module '{module}' with your effects cannot be imported"
                f" ({type(error).__name__}: {error}); name it as in `import {module or 'effects'}`,"
                " from the folder that holds it."
            ) from error
