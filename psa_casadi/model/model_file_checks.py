"""What is checked of the content of MODEL.json before a model is made of it."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any

from psa_casadi.component import Component
from psa_casadi.components import COMPONENTS
from psa_casadi.errors import InputError, Problems
from psa_casadi.model.own_effects import declaration_hash
from psa_casadi.strict_json import shown
from psa_casadi.variables import Publication

FORMAT = "psa_casadi.model/1"
_PUBLISHED = tuple(f.name for f in fields(Publication))


def check_content(content: Any, source: str, effects: Mapping[str, Component]) -> None:
    """Refuse what `parse_json` returns of a model file, unless every part is as it must be.

    `effects` are those that it may name. Raises InputError that names every unknown name, missing
    or bad value, at most 20 of them.
    """
    if problems := first_ones(_problems(content, source, effects)):
        raise InputError(problems)


def first_ones(sentences: Iterable[str]) -> tuple[str, ...]:
    """Return the first 20 sentences and a count of the others."""
    problems = Problems()
    for sentence in sentences:
        problems.add(sentence)
    return problems.sentences()


def name_of(effect: Any) -> Any:
    """Return the name of an effect, which stands alone or beside its module and hash."""
    return effect.get("name") if isinstance(effect, dict) else effect


def _problems(content: Any, source: str, effects: Mapping[str, Component]) -> list[str]:
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else type(content).__name__
        return [
            f"{source} is not a model file: its format is {shown(found)}, expected '{FORMAT}';"
            " give a file that `psa identify` or `psa diagnose` wrote with -o."
        ]
    problems: list[str] = []
    known: list[Component] = []
    for key, table in (("components", COMPONENTS), ("effects", effects)):
        names = content.get(key)
        if not isinstance(names, list):
            problems.append(f"{source}: '{key}' is missing; it must list names.")
            continue
        if len(names) > len(table):
            return [
                f"{source}: '{key}' lists {len(names)} names, but there are only {len(table)}; name"
                " none twice."
            ]
        for reference in names:
            name = name_of(reference)
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
        module = reference["module"][:80]
        return (
            f"{source}: has the effect {shown(reference.get('name'))} of the module {module}, which"
            f" was not named; give --effects {module} (in Python:"
            f" effects=psa.own_effects({module!r}).values())."
        )
    return (
        f"{source}: unknown name {shown(reference)} in {key}; the known ones are {sorted(table)}."
    )


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
        f"{source}: '{key}' is {shown(content[key])}; give a text."
        for key in ("name", "description", "force_scale", "package_version")
        if not isinstance(content.get(key, ""), str)
    ]
    interrupted = content.get("interrupted", False)
    if not isinstance(interrupted, bool):
        problems.append(f"{source}: 'interrupted' is {shown(interrupted)}; give true or false.")
    notes = content.get("notes", [])
    if not isinstance(notes, list) or not all(isinstance(n, str) for n in notes):
        problems.append(f"{source}: 'notes' is {shown(notes)}; give a list of texts.")
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
            f"{source}: 'publication' is {shown(published)}; give texts for"
            f" {', '.join(_PUBLISHED)}."
        )
    starts = content.get("starts", {})
    if not isinstance(starts, dict) or not all(
        isinstance(v, int | float) and not isinstance(v, bool) for v in starts.values()
    ):
        problems.append(f"{source}: 'starts' is {shown(starts)}; it must map names to numbers.")
    return problems + _entry_problems(given if isinstance(given, dict) else {}, source)


def _entry_problems(given: dict[str, Any], source: str) -> list[str]:
    problems = []
    for name, entry in given.items():
        if not isinstance(entry, dict):
            continue
        interval, free = entry.get("interval"), entry.get("free", False)
        if interval is not None and not _is_interval(interval):
            problems.append(
                f"{source}: the interval of {shown(name)} is {shown(interval)}; give [low, high] or"
                " null."
            )
        if not isinstance(free, bool):
            problems.append(
                f"{source}: 'free' of {shown(name)} is {shown(free)}; give true or false."
            )
    return problems


def _is_interval(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in value)
        and value[0] <= value[1]
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
                f"{source}: the value of '{name}' is {shown(entry['value'])}; give a number in"
                f" {parameter.unit}."
            )
        elif entry.get("unit", parameter.unit) != parameter.unit:
            problems.append(
                f"{source}: '{name}' is given in {shown(entry['unit'])}; convert it to"
                f" '{parameter.unit}'."
            )
    unknown = [n for n in given if n not in declared]
    if unknown and not problems:
        problems.append(
            f"{source}: unknown parameters {shown(unknown)}; remove them or add their component."
        )
    return problems
