"""MODEL.json: a model by the names of its components, with every value, interval and origin."""

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from psa_casadi.component import Component
from psa_casadi.components import COMPONENTS
from psa_casadi.effects import EFFECTS
from psa_casadi.effects.modal_series import MODAL_SERIES
from psa_casadi.effects.patches import PATCHES
from psa_casadi.errors import InputError
from psa_casadi.files import atomic_write
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.own_effects import declaration_hash, known_effects
from psa_casadi.variables import Interval, Provenance, Publication

FORMAT = "psa_casadi.model/1"
_PUBLISHED = tuple(f.name for f in fields(Publication))


#: What a diagnosis may add beside the effects of the table.
_BESIDE = {c.name: c for c in (*MODAL_SERIES.values(), *PATCHES.values())}


def dumps(model: Model) -> str:
    """Return the text of MODEL.json; reading it back gives the same model exactly.

    An effect that is not of this package is named with its module and the hash of what it declares.
    Raises InputError for a model with a component that is in no table and of no module.
    """
    foreign = foreign_components(model)
    if foreign:
        raise InputError(
            f"The model '{model.name}' cannot be saved as MODEL.json: the file names components of"
            f" this package and of modules with own effects, and {', '.join(foreign)} is neither"
            " (made by ode_model or connect?). Keep the script that makes the model, or export the"
            " model as an FMU."
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
        "force_scale": origin.force_scale,
        "notes": list(origin.notes),
        "identified_from": [{"record": n, "sha256": h} for n, h in origin.identified_from],
        "package_version": origin.package_version,
    }
    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


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
    try:
        content = json.loads(text)
    except ValueError as error:
        raise InputError(
            f"{source} is not JSON ({error}); give a file that `psa identify` or `psa diagnose`"
            " wrote."
        ) from error
    table = {**known_effects(effects), **_BESIDE}
    problems = _problems(content, source, table)
    if problems:
        raise InputError(problems)
    components = [COMPONENTS[n] for n in content["components"]]
    components += [table[_name_of(n)] for n in content["effects"]]
    given = content["parameters"]
    try:
        model = compose(
            components,
            {n: e["value"] for n, e in given.items()},
            name=content.get("name", "psa"),
            description=content.get("description", ""),
        ).with_starts(content.get("starts", {}))
    except InputError as error:
        raise InputError([f"{source}: {problem}" for problem in error.problems]) from error
    published = Publication(**content.get("publication", {}))
    return model.with_values({}, provenance=_provenance(content, given), publication=published)


def save_model(model: Model, path: str | os.PathLike[str]) -> None:
    """Write MODEL.json, whole or not at all."""
    atomic_write(path, dumps(model))


def load_model(path: str | os.PathLike[str], effects: Iterable[Component] = ()) -> Model:
    """Read MODEL.json; `effects` are own ones that it may have. Raises InputError."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"The model file {path} cannot be read ({error}); give a file that `psa identify`"
            " wrote."
        ) from error
    return loads(text, str(path), effects)


def _provenance(content: dict[str, Any], given: dict[str, Any]) -> Provenance:
    return Provenance(
        identified_from=tuple(
            (r["record"], r["sha256"]) for r in content.get("identified_from", [])
        ),
        package_version=content.get("package_version", ""),
        free=tuple(n for n, e in given.items() if e.get("free")),
        intervals={n: Interval(*e["interval"]) for n, e in given.items() if e.get("interval")},
        force_scale=content.get("force_scale", "assumed"),
        notes=tuple(content.get("notes", ())),
    )


def _name_of(effect: Any) -> Any:
    return effect.get("name") if isinstance(effect, dict) else effect


def _problems(content: Any, source: str, effects: Mapping[str, Component]) -> list[str]:
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else type(content).__name__
        return [
            f"{source} is not a model file: its format is '{found}', expected '{FORMAT}';"
            " give a file that `psa identify` or `psa diagnose` wrote."
        ]
    problems: list[str] = []
    known: list[Component] = []
    for key, table in (("components", COMPONENTS), ("effects", effects)):
        names = content.get(key)
        if not isinstance(names, list):
            problems.append(f"{source}: '{key}' is missing; it must list names.")
            continue
        for reference in names:
            name = _name_of(reference)
            if isinstance(name, str) and name in table:
                known.append(table[name])
                problems += _changed(reference, table[name], source)
            else:
                problems.append(_unknown(reference, key, table, source))
    given = content.get("parameters")
    problems += _parameter_problems(given, known, source)
    return problems + _origin_problems(content, given, source)


def _unknown(reference: Any, key: str, table: Mapping[str, Component], source: str) -> str:
    if isinstance(reference, dict) and isinstance(reference.get("module"), str):
        module = reference["module"]
        return (
            f"{source}: has the effect '{reference.get('name')}' of the module {module}, which was"
            f" not named; give --effects {module} (in Python:"
            f" effects=psa.own_effects({module!r}).values())."
        )
    return f"{source}: unknown name '{reference}' in {key}; the known ones are {sorted(table)}."


def _changed(reference: Any, component: Component, source: str) -> list[str]:
    """Say where an own effect is not declared as it was when the file was written."""
    if not isinstance(reference, dict) or reference.get("sha256") == declaration_hash(component):
        return []
    return [
        f"{source}: the effect '{component.name}' of {component.home or 'this package'} is declared"
        " in another way than when the file was written; restore that, or identify again."
    ]


def _origin_problems(content: dict[str, Any], given: Any, source: str) -> list[str]:
    problems = [
        f"{source}: '{key}' is {content[key]!r}; give a text."
        for key in ("name", "description", "force_scale", "package_version")
        if not isinstance(content.get(key, ""), str)
    ]
    notes = content.get("notes", [])
    if not isinstance(notes, list) or not all(isinstance(n, str) for n in notes):
        problems.append(f"{source}: 'notes' is {notes!r}; give a list of texts.")
    records = content.get("identified_from", [])
    if not isinstance(records, list) or not all(
        isinstance(r, dict)
        and isinstance(r.get("record"), str)
        and isinstance(r.get("sha256"), str)
        for r in records
    ):
        problems.append(f"{source}: 'identified_from' must list a record and its sha256 each.")
    published = content.get("publication", {})
    if not isinstance(published, dict) or not all(
        name in _PUBLISHED and isinstance(text, str) for name, text in published.items()
    ):
        problems.append(
            f"{source}: 'publication' is {published!r}; give texts for {', '.join(_PUBLISHED)}."
        )
    starts = content.get("starts", {})
    if not isinstance(starts, dict) or not all(
        isinstance(v, int | float) and not isinstance(v, bool) for v in starts.values()
    ):
        problems.append(f"{source}: 'starts' is {starts!r}; it must map names to numbers.")
    entries = given if isinstance(given, dict) else {}
    intervals = {
        n: e["interval"] for n, e in entries.items() if isinstance(e, dict) and "interval" in e
    }
    return problems + [
        f"{source}: the interval of '{name}' is {interval!r}; give [low, high] or null."
        for name, interval in intervals.items()
        if not (interval is None or _is_interval(interval))
    ]


def _is_interval(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
    )


def _parameter_problems(given: Any, known: list[Component], source: str) -> list[str]:
    if not isinstance(given, dict):
        return [f"{source}: 'parameters' is missing; it must map names to value and unit."]
    problems = []
    declared = {p.name: p for c in known for p in c.parameters}
    for name, parameter in declared.items():
        entry = given.get(name)
        if not isinstance(entry, dict) or "value" not in entry:
            problems.append(
                f"{source}: parameter '{name}' [{parameter.unit}] has no value; add it."
            )
        elif not isinstance(entry["value"], int | float) or isinstance(entry["value"], bool):
            problems.append(
                f"{source}: the value of '{name}' is {entry['value']!r}; give a number in"
                f" {parameter.unit}."
            )
        elif entry.get("unit", parameter.unit) != parameter.unit:
            problems.append(
                f"{source}: '{name}' is given in '{entry['unit']}'; convert it to"
                f" '{parameter.unit}'."
            )
    unknown = [n for n in given if n not in declared]
    if unknown and not problems:
        problems.append(
            f"{source}: unknown parameters {unknown}; remove them or add their component."
        )
    return problems
