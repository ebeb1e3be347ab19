"""The evidence of a model as a part of MODEL.json: written from its records, read strictly."""

import types
from collections.abc import Callable, ItemsView, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from itertools import pairwise
from typing import Any, Union, get_args, get_origin, get_type_hints

from psa_casadi.errors import InputError
from psa_casadi.model.evidence import Covariance, Evidence, RecordRun, ReferenceRun
from psa_casadi.strict_json import shown
from psa_casadi.variables import Interval


class _UnlikeError(ValueError):
    """A part of the content is not what its field declares; the text says which and why."""


def evidence_content(evidence: Evidence) -> dict[str, Any]:
    """Return what MODEL.json says of a model's evidence."""
    found: dict[str, Any] = _plain(evidence)
    return found


def read_evidence(content: Any, parameters: Mapping[str, Any], source: str) -> Evidence:
    """Return the evidence that `evidence_content` has written.

    `parameters` are those of the model. Raises InputError that names what is missing, unknown or
    impossible.
    """
    try:
        found: Evidence = _read(Evidence, content, "evidence")
    except _UnlikeError as error:
        raise InputError(f"{source}: {error}") from error
    if problems := [f"{source}: {p}" for p in _impossible(found, parameters)]:
        raise InputError(problems)
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, Interval):
        return [value.low, value.high]
    if is_dataclass(value):
        return {
            f.name: _plain(getattr(value, f.name))
            for f in fields(value)
            if f.default is MISSING or getattr(value, f.name) != f.default
        }
    if isinstance(value, Mapping):
        return {n: _plain(v) for n, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _read(kind: Any, content: Any, place: str) -> Any:
    """Return the content as its declared type; raises _UnlikeError."""
    if read := _READERS.get(kind):
        return read(content, place)
    if is_dataclass(kind):
        return _record(kind, content, place)
    origin, inside = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        wanted = next(k for k in inside if k is not types.NoneType)
        return None if content is None else _read(wanted, content, place)
    if origin is Mapping:
        return {n: _read(inside[1], v, f"{place}.{n[:80]}") for n, v in _named(content, place)}
    return _items(inside, content, place)


def _number(content: Any, place: str) -> float:
    if isinstance(content, bool) or not isinstance(content, int | float):
        raise _UnlikeError(f"'{place}' is {shown(content)}; give a number.")
    return float(content)


def _count(content: Any, place: str) -> int:
    if isinstance(content, bool) or not isinstance(content, int):
        raise _UnlikeError(f"'{place}' is {shown(content)}; give a whole number.")
    return content


def _interval(content: Any, place: str) -> Interval:
    low, high = _items((float, float), content, place)
    if low > high:
        raise _UnlikeError(f"'{place}' is {shown(content)}; give [low, high].")
    return Interval(low, high)


def _named(content: Any, place: str) -> ItemsView[str, Any]:
    if not isinstance(content, dict):
        raise _UnlikeError(f"'{place}' is {shown(content)}; it must map names to values.")
    return content.items()


def _text(content: Any, place: str) -> str:
    if not isinstance(content, str):
        raise _UnlikeError(f"'{place}' is {shown(content)}; give a text.")
    return content


def _items(inside: Sequence[Any], content: Any, place: str) -> tuple[Any, ...]:
    """Read a list: of any length where its declaration ends in "...", else of that length."""
    if not isinstance(content, list):
        raise _UnlikeError(f"'{place}' is {shown(content)}; give a list.")
    kinds = [inside[0]] * len(content) if inside[-1] is ... else list(inside)
    if len(kinds) != len(content):
        raise _UnlikeError(f"'{place}' is {shown(content)}; give {len(kinds)} values.")
    return tuple(
        _read(k, v, f"{place}[{i}]") for i, (k, v) in enumerate(zip(kinds, content, strict=True))
    )


def _record(kind: Any, content: Any, place: str) -> Any:
    given = dict(_named(content, place))
    declared = {f.name: f for f in fields(kind)}
    if unknown := [n for n in given if n not in declared]:
        raise _UnlikeError(f"'{place}' has the unknown names {shown(unknown)}; remove them.")
    missing = [n for n, f in declared.items() if n not in given and f.default is MISSING]
    if missing:
        raise _UnlikeError(f"'{place}' lacks {', '.join(missing)}; identify or diagnose again.")
    kinds = get_type_hints(kind)
    return kind(**{n: _read(kinds[n], v, f"{place}.{n}") for n, v in given.items()})


_READERS: dict[Any, Callable[[Any, str], Any]] = {
    float: _number,
    int: _count,
    str: _text,
    Interval: _interval,
}


def _impossible(e: Evidence, parameters: Mapping[str, Any]) -> Iterator[str]:
    """Say what cannot be, although each part alone could."""
    sizes = [e.fitted_m, e.seen.rate, e.seen.duration]
    if e.held_out is not None:
        held = e.held_out
        sizes += [held.rms_m, held.interval_m.low, held.max_m, held.nrmse_percent, held.records]
    for run in e.runs:
        sizes += [run.fitted_m, run.held_out_m or 0.0]
    if min(sizes) < 0.0:
        yield "'evidence' has an error, a rate or a duration below 0."
    yield from _bad_covariance(e.covariance, parameters)
    for run in e.runs:
        yield from _bad_run(run)
    if e.reference is not None:
        yield from _bad_reference(e.reference, [r.record for r in e.runs])


def _bad_covariance(c: Covariance, parameters: Mapping[str, Any]) -> Iterator[str]:
    unknown = [n for n in c.names if n not in parameters]
    if unknown or len(set(c.names)) < len(c.names):
        yield f"'evidence.covariance.names' must name parameters, none twice; not {shown(unknown)}."
    rows = c.matrix
    if [len(c.names)] * len(c.names) != [len(row) for row in rows]:
        yield "'evidence.covariance.matrix' must have a row and a column for each name."
    elif any(row[i] < 0.0 for i, row in enumerate(rows)) or rows != tuple(zip(*rows, strict=True)):
        yield "'evidence.covariance.matrix' must be symmetric, with no variance below 0."


def _bad_run(run: RecordRun) -> Iterator[str]:
    of, ends = f"'evidence.runs' of {shown(run.record)}", [k for s in run.held_out for k in s]
    if run.averaged < 1 or run.samples < 2:
        yield f"{of} must have samples, each of at least one."
    if any(a >= b for a, b in pairwise([-1, *ends, run.samples + 1])):
        yield f"{of} must have held-out stretches that follow each other within its samples."
    if (run.held_out_m is None) != (not run.held_out):
        yield f"{of} must have a held-out error and held-out samples, or neither."


def _bad_reference(r: ReferenceRun, known: Sequence[str]) -> Iterator[str]:
    if r.record not in known:
        yield f"'evidence.reference' is of {shown(r.record)}, which is not among the runs."
    if len(r.time) < 2 or any(a >= b for a, b in pairwise(r.time)):
        yield "'evidence.reference.time' must have two or more increasing times."
    columns = [r.displacement, *r.inputs.values()]
    if "voltage" not in r.inputs or any(len(c) != len(r.time) for c in columns):
        yield "'evidence.reference' must have a voltage, and a value of each column for each time."
