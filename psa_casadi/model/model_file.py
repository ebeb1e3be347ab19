"""MODEL.json: a model by the names of its components, with every value, interval and origin."""

import os
from collections.abc import Iterable
from typing import Any

from psa_casadi.component import Component
from psa_casadi.components import COMPONENTS
from psa_casadi.effects import EFFECTS
from psa_casadi.effects.mechanics import MODAL_SERIES
from psa_casadi.effects.patches import PATCHES
from psa_casadi.errors import InputError
from psa_casadi.files import atomic_write, why_not_read
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.evidence_file import evidence_content, read_evidence
from psa_casadi.model.model_file_checks import FORMAT, check_content, first_ones, name_of
from psa_casadi.model.own_effects import declaration_hash, known_effects
from psa_casadi.strict_json import json_text, parse_json, read_json_text, shown
from psa_casadi.variables import Interval, Provenance, Publication

#: What a diagnosis may add beside the effects of the table.
_BESIDE = {c.name: c for c in (*MODAL_SERIES.values(), *PATCHES.values())}


def dumps(model: Model) -> str:
    """Return the text of MODEL.json; reading it back gives the same model exactly.

    An effect that is not of this package is named with its module and the hash of what it declares.
    Raises InputError for a model with a component that is in no table and of no module, and for
    numbers and texts that no file can carry.
    """
    foreign = foreign_components(model)
    if foreign:
        raise InputError(
            f"The model '{model.name}' cannot be saved as MODEL.json: the file names components of"
            f" this package and of modules with own effects, and neither holds"
            f" {', '.join(foreign)} (made by ode_model or connect?). Keep the script that makes the"
            " model, or export the model as an FMU."
        )
    origin = model.provenance
    parameters = {}
    for p in model.structure.parameters:
        interval = origin.intervals.get(p.name)
        parameters[p.name] = {
            "value": model.values[p.name],
            "unit": p.unit,
            "interval": [interval.low, interval.high] if interval else None,
            "free": p.name in origin.free,
        }
    starts, stated = model.own_starts(), model.publication.stated
    content = {
        "format": FORMAT,
        "name": model.name,
        "description": model.description,
        **({"publication": stated} if stated else {}),
        "components": [c.name for c in model.components if c.gain is None],
        "effects": [_reference(c) for c in model.effects],
        "parameters": parameters,
        **({"starts": starts} if starts else {}),
        **({"interrupted": True} if origin.interrupted else {}),
        "force_scale": origin.force_scale,
        "notes": list(origin.notes),
        "identified_from": [{"record": n, "sha256": h} for n, h in origin.identified_from],
        "package_version": origin.package_version,
        **({"evidence": evidence_content(model.evidence)} if model.evidence else {}),
    }
    try:
        return json_text(content)
    except ValueError as error:
        raise InputError(
            f"The model {shown(model.name)} cannot be saved as MODEL.json ({error}); give it finite"
            " values and intervals, and plain text as name, description and notes."
        ) from error


def foreign_components(model: Model) -> tuple[str, ...]:
    """Return the names of a model's components that MODEL.json cannot name."""
    known = (*COMPONENTS.values(), *EFFECTS.values(), *_BESIDE.values())
    return tuple(c.name for c in model.components if c not in known and not c.home)


def _reference(effect: Component) -> str | dict[str, str]:
    if not effect.home:
        return effect.name
    return {"name": effect.name, "module": effect.home, "sha256": declaration_hash(effect)}


def loads(text: str, source: str = "MODEL.json", effects: Iterable[Component] = ()) -> Model:
    """Read a model; `effects` are own ones that it may have (`own_effects`).

    Raises InputError that names every unknown name, missing or bad value.
    """
    content = parse_json(text, source, "give a file that `psa identify` or `psa diagnose` wrote.")
    table = {**known_effects(effects), **_BESIDE}
    check_content(content, source, table)
    components = [COMPONENTS[name_of(n)] for n in content["components"]]
    components += [table[name_of(n)] for n in content["effects"]]
    given = content["parameters"]
    try:
        model = compose(
            components,
            {n: e["value"] for n, e in given.items()},
            name=content.get("name", "psa"),
            description=content.get("description", ""),
        ).with_starts({n: float(v) for n, v in content.get("starts", {}).items()})
    except InputError as error:
        said = first_ones(f"{source}: {problem}" for problem in error.problems)
        raise InputError(said) from error
    ordered = {p.name: given[p.name] for p in model.structure.parameters}
    published = Publication(**content.get("publication", {}))
    told = content.get("evidence")
    evidence = None if told is None else read_evidence(told, model.values, source)
    return model.with_values(
        {}, provenance=_provenance(content, ordered), publication=published, evidence=evidence
    )


def save_model(model: Model, path: str | os.PathLike[str]) -> None:
    """Write MODEL.json, whole or not at all."""
    atomic_write(path, dumps(model))


def load_model(path: str | os.PathLike[str], effects: Iterable[Component] = ()) -> Model:
    """Read MODEL.json; `effects` are own ones that it may have. Raises InputError."""
    try:
        text = read_json_text(path)
    except (OSError, ValueError) as error:
        raise InputError(
            f"The model file {path} cannot be read ({why_not_read(error)}); give a file that"
            " `psa identify` wrote."
        ) from error
    return loads(text, str(path), effects)


def _provenance(content: dict[str, Any], given: dict[str, Any]) -> Provenance:
    return Provenance(
        identified_from=tuple(
            (r["record"], r["sha256"]) for r in content.get("identified_from", [])
        ),
        package_version=content.get("package_version", ""),
        free=tuple(n for n, e in given.items() if e.get("free")),
        intervals={
            n: Interval(*map(float, e["interval"])) for n, e in given.items() if e.get("interval")
        },
        force_scale=content.get("force_scale", "assumed"),
        notes=tuple(content.get("notes", ())),
        interrupted=content.get("interrupted", False),
    )
