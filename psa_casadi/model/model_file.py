"""MODEL.json: a model by its components, with every value, interval and origin.

Components of this package have their names there; others have their equations as text.
"""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from psa_casadi.common.errors import InputError, Problems, quoted
from psa_casadi.common.files import atomic_write
from psa_casadi.common.strict_json import (
    brief,
    decode,
    json_text,
    mistakes,
    parse_json,
    part,
    plain,
    read_json,
)
from psa_casadi.model.component import Component, FmuUsed
from psa_casadi.model.components import COMPONENTS
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.effects.mechanics import MODAL_SERIES
from psa_casadi.model.effects.patches import PATCHES
from psa_casadi.model.evidence import Evidence, contradictions
from psa_casadi.model.own_components import (
    Opener,
    OwnComponent,
    components_of,
    refuse_large,
    written,
)
from psa_casadi.model.user_effects import declaration_hash, known_effects
from psa_casadi.model.variables import Interval, Parameter, Provenance, Publication

FORMAT = "psa_casadi.model/1"
#: What a diagnosis may add to the effects of the table.
_FURTHER = {c.name: c for c in (*MODAL_SERIES.values(), *PATCHES.values())}
_STATED = tuple(f.name for f in fields(Publication))
_ADVICE = "give a file that `psa identify` or `psa diagnose` wrote."


@dataclass(frozen=True)
class ModelParameter:
    """A parameter's value in its unit, its 95 % interval, and whether it is fitted."""

    value: float
    unit: str = ""
    interval: Interval | None = None
    free: bool = False


@dataclass(frozen=True)
class OwnEffect:
    """An effect that is not of this package: its module and the hash of what it declares."""

    name: str
    module: str
    sha256: str


@dataclass(frozen=True)
class IdentifiedFrom:
    """A record that the model was fitted to, with the SHA-256 of its file."""

    record: str
    sha256: str


@dataclass(frozen=True)
class ModelFile:
    """A model by the names of its components, with every value, interval and origin.

    `own` are those of them that are not of this package, with their equations.
    """

    format: Literal["psa_casadi.model/1"]
    components: tuple[str, ...]
    effects: tuple[str | OwnEffect, ...]
    parameters: Mapping[str, ModelParameter]
    own: Mapping[str, OwnComponent] = field(default_factory=dict)
    name: str = "psa"
    description: str = ""
    publication: Publication = field(default_factory=Publication)
    starts: Mapping[str, float] = field(default_factory=dict)
    interrupted: bool = False
    hold: Literal["linear", "zero"] = "linear"
    force_scale: str = "assumed"
    notes: tuple[str, ...] = ()
    identified_from: tuple[IdentifiedFrom, ...] = ()
    package_version: str = ""
    evidence: Evidence | None = None


def dumps(model: Model) -> str:
    """Return the text of MODEL.json; reading it back gives the same model exactly.

    A component that is not of this package has its equations there as text, or the name and the
    SHA-256 of its FMU; an effect of a module (`load_effects`) is named with that and the hash of
    what it declares. Raises InputError for equations that no text can have, two components of
    one name, and numbers and texts that no file can carry.
    """
    origin, written = model.provenance, _written(model)
    parameters = {
        p.name: {
            "value": model.values[p.name],
            "unit": p.unit,
            "interval": list(i) if (i := origin.intervals.get(p.name)) else None,
            "free": p.name in origin.free,
        }
        for p in model.structure.parameters
    }
    starts, stated = model.changed_starts(), model.publication.stated
    content = {
        "format": FORMAT,
        "name": model.name,
        "description": model.description,
        **({"publication": stated} if stated else {}),
        "components": [c.name for c in model.base],
        "effects": [
            {"name": c.name, "module": c.home, "sha256": declaration_hash(c)} if c.home else c.name
            for c in model.effects
        ],
        "parameters": parameters,
        **({"own": plain(written)} if written else {}),
        **({"starts": starts} if starts else {}),
        **({"interrupted": True} if origin.interrupted else {}),
        **({"hold": "zero"} if origin.hold == "zero" else {}),
        "force_scale": origin.force_scale,
        "notes": list(origin.notes),
        "identified_from": [{"record": n, "sha256": h} for n, h in origin.identified_from],
        "package_version": origin.package_version,
        **({"evidence": plain(model.evidence)} if model.evidence else {}),
    }
    try:
        return json_text(content)
    except ValueError as error:
        raise InputError(
            f"The model {brief(model.name)} cannot be saved as MODEL.json ({error}); give it finite"
            " values and intervals, and plain text as name, description and notes."
        ) from error


def _written(model: Model) -> dict[str, OwnComponent]:
    """Return what the file has of components that are in no table and of no module, by name."""
    known = (*COMPONENTS.values(), *EFFECTS.values(), *_FURTHER.values())
    about = f"The model {brief(model.name)} cannot be saved as MODEL.json:"
    problems, result = Problems(), dict[str, OwnComponent]()
    for name, count in Counter(c.name for c in model.components).items():
        if count > 1:
            problems.add(f"{about} {count} components are named '{name}'; rename them.")
    try:
        for component in model.components:
            if component not in known and not component.home:
                result[component.name] = written(component, model.values)
        refuse_large(result.values())
    except InputError as error:
        problems.extend(f"{about} {problem}" for problem in error.problems)
    problems.raise_if_any()
    return result


def no_fmu(used: FmuUsed, name: str, parameters: tuple[Parameter, ...]) -> Component:
    """Refuse the FMU of a model: where this is the opener, none is run. Raises InputError."""
    raise InputError(
        f"the model has the FMU {brief(used.file)}, which is not opened from here; type"
        " psa.load_model(MODEL, fmu=FMU)."
    )


def loads(text: str, source: str = "MODEL.json", effects: Iterable[Component] = ()) -> Model:
    """Read a model; `effects` are a user's effects that it may have (`load_effects`).

    Raises InputError that names every unknown name, missing or bad value.
    """
    return model_of(parse_json(text, source, _ADVICE), source, effects)


def model_of(
    content: Any, source: str, effects: Iterable[Component] = (), opener: Opener = no_fmu
) -> Model:
    """Return the model that the content of a file holds.

    `opener` returns the component of an FMU that it has. Raises InputError that names every unknown
    name, missing or bad value.
    """
    stated = content.get("format") if isinstance(content, dict) else type(content).__name__
    if not isinstance(content, dict) or stated != FORMAT:
        raise InputError(
            f"{source} is not a model file: its format is {brief(stated)}, expected '{FORMAT}';"
            f" {_ADVICE}"
        )
    declared = part(Mapping[str, OwnComponent], content.get("own", {})) or {}
    try:
        further = components_of(declared, opener)
    except InputError as error:
        _refuse(error.problems, source)
        raise
    tables = {**COMPONENTS, **further}, {**known_effects(effects), **_FURTHER, **further}
    _refuse(_problems(content, *tables), source)
    file = decode(ModelFile, content, source)
    components = [tables[0][name] for name in file.components]
    components += [tables[1][_name_of(effect)] for effect in file.effects]
    try:
        values = {name: p.value for name, p in file.parameters.items()}
        model = compose(components, values, name=file.name, description=file.description)
        model = model.with_starts(file.starts)
    except InputError as error:
        _refuse(error.problems, source)
        raise
    if file.evidence is not None:
        _refuse(contradictions(file.evidence, model.values), source)
    ordered = {p.name: file.parameters[p.name] for p in model.structure.parameters}
    provenance = Provenance(
        identified_from=tuple((r.record, r.sha256) for r in file.identified_from),
        package_version=file.package_version,
        free=tuple(name for name, p in ordered.items() if p.free),
        intervals={name: p.interval for name, p in ordered.items() if p.interval},
        force_scale=file.force_scale,
        notes=file.notes,
        interrupted=file.interrupted,
        hold=file.hold,
    )
    return model.with_values(
        {}, provenance=provenance, publication=file.publication, evidence=file.evidence
    )


def save_model(model: Model, path: str | os.PathLike[str]) -> None:
    """Write MODEL.json, whole or not at all."""
    atomic_write(path, dumps(model))


def read_content(path: str | os.PathLike[str]) -> Any:
    """Return what a model file holds, unchecked. Raises InputError."""
    return read_json(path, _ADVICE)


def _refuse(sentences: Iterable[str], source: str) -> None:
    """Raise InputError with the first 20 sentences and a count of the others, if there are any."""
    problems = Problems()
    problems.extend(f"{source}: {sentence}" for sentence in sentences)
    problems.raise_if_any()


def _name_of(effect: str | OwnEffect) -> str:
    return effect if isinstance(effect, str) else effect.name


def _problems(
    content: dict[str, Any], components: Mapping[str, Component], effects: Mapping[str, Component]
) -> list[str]:
    """Return all mistakes in the content of a file that may name these components and effects."""
    problems = list(mistakes(ModelFile, content))
    names = [n for n in _listed(content, "components") if isinstance(n, str)]
    references = [r for e in _listed(content, "effects") if (r := part(str | OwnEffect, e))]
    problems += [_unknown(n, "components", components) for n in names if n not in components]
    known = [components[n] for n in names if n in components]
    for reference in references:
        effect = effects.get(_name_of(reference))
        if effect is None:
            problems.append(_unknown(reference, "effects", effects))
            continue
        known.append(effect)
        if isinstance(reference, OwnEffect) and reference.sha256 != declaration_hash(effect):
            problems.append(
                f"the effect '{effect.name}' of {effect.home or 'this package'} is declared in"
                " another way than when the file was written; restore that, or identify again."
            )
    for name, count in Counter(map(_name_of, (*names, *references))).items():
        if count > 1:
            problems.append(f"{brief(name)} is listed {count} times; list it once.")
    if isinstance(stated := content.get("publication"), dict):
        extra = [n for n in stated if n not in _STATED]
        problems += [
            f"'publication.{n[:80]}' is unknown; give {', '.join(_STATED)}." for n in extra
        ]
    if isinstance(parameters := content.get("parameters"), dict):
        problems += _parameter_problems(parameters, known)
        declared = {p.name for c in known for p in c.parameters}
        unknown = [n for n in parameters if n not in declared]
        if unknown and not problems:
            problems.append(
                f"unknown parameters {brief(unknown)}; remove them or add their component."
            )
    return problems


def _listed(content: dict[str, Any], key: str) -> list[Any]:
    return value if isinstance(value := content.get(key), list) else []


def _unknown(reference: str | OwnEffect, key: str, table: Mapping[str, Component]) -> str:
    if isinstance(reference, str):
        known = quoted(sorted(table))
        return f"unknown name {brief(reference)} in {key}; the known ones are {known}."
    module = reference.module[:80]
    return (
        f"has the effect {brief(reference.name)} of the module {module}, which was not named; give"
        f" --effects {module} (in Python: effects=psa.load_effects({module!r}).values())."
    )


def _parameter_problems(table: dict[str, Any], known: Iterable[Component]) -> Iterator[str]:
    for parameter in {p.name: p for c in known for p in c.parameters}.values():
        if parameter.name not in table:
            yield f"parameter '{parameter.name}' [{parameter.unit}] has no value; add it."
            continue
        entry = part(ModelParameter, table[parameter.name])
        if entry and entry.unit not in ("", parameter.unit):
            yield (
                f"'{parameter.name}' has the unit {brief(entry.unit)}; convert it to"
                f" '{parameter.unit}'."
            )
        if entry and entry.interval and not entry.interval.low <= entry.interval.high:
            yield (
                f"the interval of '{parameter.name}' is {brief(list(entry.interval))}; give [low,"
                " high] or null."
            )
