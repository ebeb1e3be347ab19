"""Files of diagnoses, identifications and models read as findings, those of one device joined."""

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.strict_json import decode, read_json
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.documents import files
from psa_casadi.identification.result import Identification
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import FORMAT as MODEL
from psa_casadi.model.model_file import model_of
from psa_casadi.population.population import (
    BudgetShare,
    Estimate,
    Finding,
    HeldOutErrors,
    NamedCause,
    replayed,
)

#: The file in a device's folder with the status of its work.
DEVICE_FILE = "device.json"
_ADVICE = "give files that `psa diagnose --json`, `psa identify --json` or `psa batch` wrote."
#: What `identify`, `diagnose` and `load_diagnosis` return.
Result = Diagnosis | Identification | files.AnyDiagnosisFile
#: A file, and the finding from it.
_Read = tuple[Path, Finding]
#: Names of files that do not name a device.
_PLAIN_NAMES = ("diagnosis", "identification", "model", "extended")


def read_findings(
    paths: Iterable[str | os.PathLike[str] | Result],
    effects: Sequence[Component] = (),
    *,
    traces: bool = True,
) -> tuple[Finding, ...]:
    """Return the findings in files, or of results at hand, in their order.

    A result, of a stack or of any other model, is what `identify`, `diagnose` and
    `load_diagnosis` return; it has the name of its first record. A path is a DIAGNOSIS.json, what
    `psa identify --json` wrote, a MODEL.json, or a device's folder of `psa batch`. A model of the
    same records as a diagnosis or identification is part of it. With `traces`, models simulate the
    records that their files carry. `effects` are a user's.

    Raises:
        InputError: what cannot be read, all of it.
    """
    reads: list[_Read] = []
    problems: list[str] = []
    for path in paths:
        try:
            reads += _read(path, effects, traces)
        except InputError as error:
            problems.extend(error.problems)
    if problems:
        raise InputError(problems)
    return _named(_joined(reads))


def device_finding(
    folder: Path,
    device_file: files.DeviceFile,
    effects: Sequence[Component] = (),
    *,
    traces: bool = False,
) -> Finding:
    """Return the finding in a device's folder of `psa batch`; damage is an InputError."""
    damaged = files.damage(folder, device_file)
    if damaged:
        raise InputError(damaged)
    (joined,) = _joined(
        [r for name in device_file.files for r in _read(folder / name, effects, traces)]
    )
    day = date.fromisoformat(device_file.date) if device_file.date else None
    return replace(joined[1], device=device_file.device, batch=device_file.batch, day=day)


def _read(
    result: str | os.PathLike[str] | Result, effects: Sequence[Component], traces: bool
) -> list[_Read]:
    content: Any
    if isinstance(result, files.AnyDiagnosisFile):
        return [(Path(result.records[0].name), _diagnosis(result))]
    if isinstance(result, Identification):
        path, source = Path(result.experiments[0].record.name), "identification"
        content = files.identification_file(result)
    elif isinstance(result, Diagnosis):
        path = Path(result.experiments[0].record.name)
        content = result.to_dict()
        finding = _diagnosis(decode(files.DIAGNOSES[content["format"]], content, "diagnosis"))
        return [(path, _with_model(finding, _model(result.model, traces)))]
    else:
        path = Path(result) / DEVICE_FILE if Path(result).is_dir() else Path(result)
        source = str(path)
        content = read_json(path, _ADVICE)
    diagnosis, kind = files.diagnosis_in(content, source)
    if diagnosis is not None:
        return [(path, _diagnosis(diagnosis))]
    if kind == files.DEVICE_FORMAT:
        device_file = decode(files.DeviceFile, content, source)
        if device_file.status != "done":
            why = " ".join(device_file.problems)
            raise InputError(f"{path}: the work on this device was {device_file.status}: {why}")
        return [(path, device_finding(path.parent, device_file, effects, traces=traces))]
    if kind == files.IDENTIFICATION_FORMAT:
        return [(path, _identification(decode(files.IdentificationFile, content, source)))]
    if kind == MODEL:
        return [(path, _model(model_of(content, source, effects), traces))]
    raise InputError(f"{path}: is no file of a diagnosis, identification or model; {_ADVICE}")


def _diagnosis(d: files.AnyDiagnosisFile) -> Finding:
    b = d.budget
    shares = [] if b is None else [*b.causes, *([b.unnamed] if b.unnamed else [])]
    errors = []
    if isinstance(d, files.DiagnosisFile):
        base, extended = d.base_errors, d.extended_errors
        rms = base.holdout_rms_m, extended.holdout_rms_m, d.noise_floor_rms_m
        errors = [HeldOutErrors(*rms, extended.holdout_nrmse_percent)]
    elif isinstance(d, files.OwnModelFile):
        errors = [files.copied(HeldOutErrors, e) for e in d.errors]
    return files.copied(
        Finding,
        d,
        device="",
        kind="diagnosis",
        parameters={
            n: Estimate(p.value, p.unit, p.interval)
            for c in d.causes
            for n, p in c.parameters.items()
        },
        records=tuple((r.name, r.sha256) for r in d.records),
        errors=tuple(errors),
        causes=tuple(
            NamedCause(c.effect, c.confidence, c.explained_share, c.cannot_be_told_from)
            for c in d.causes
        ),
        budget=tuple(files.copied(BudgetShare, s) for s in shares),
    )


def _identification(i: files.IdentificationFile) -> Finding:
    return Finding(
        device="",
        kind="identification",
        parameters={
            n: Estimate(
                p.value, p.unit, p.interval, p.determined in ("determined", "weak"), p.meaning
            )
            for n, p in i.parameters.items()
        },
        records=tuple(dict.fromkeys((r.name, r.sha256) for r in i.records)),
        rms_m=i.rms_m if all(r.output == "displacement" for r in i.records) else None,
        rms_percent=max((r.rms_percent_of_range for r in i.records), default=None),
        notes=(*i.warnings, *i.notes),
        warnings=i.warnings,
        noise_ratio=i.missed,
    )


def _model(model: Model, traces: bool) -> Finding:
    origin, trace, parameters = model.provenance, None, {}
    for p in model.structure.parameters:
        interval = (i.low, i.high) if (i := origin.intervals.get(p.name)) else None
        fields = model.values[p.name], p.unit, interval, p.name in origin.free, p.description
        parameters[p.name] = Estimate(*fields)
    with suppress(PsaError):  # without the model's curve the page has all the rest
        trace = replayed(model) if traces else None
    return Finding(
        device="",
        kind="model",
        parameters=parameters,
        records=origin.identified_from,
        force_scale=origin.force_scale,
        trace=trace,
    )


def _joined(reads: Sequence[_Read]) -> list[_Read]:
    """Join every model to the first finding of the same records that has none yet."""
    rows = dict(enumerate(reads))
    full: set[int] = set()
    for k, (_, model) in enumerate(reads):
        same = [
            j
            for j, (_, other) in enumerate(reads)
            if model.kind == "model" != other.kind and j not in full
            if model.records and {s for _, s in model.records} == {s for _, s in other.records}
        ]
        if same:
            full.add(same[0])
            path, finding = rows[same[0]]
            rows[same[0]] = path, _with_model(finding, model)
            del rows[k]
    return list(rows.values())


def _with_model(finding: Finding, model: Finding) -> Finding:
    """Return a finding with all that its model holds: all parameters, and the record it carries."""
    parameters = {**model.parameters}
    for name, p in finding.parameters.items():
        meaning = p.meaning or (parameters[name].meaning if name in parameters else "")
        parameters[name] = replace(p, meaning=meaning)
    whole = replace(finding, parameters=parameters, trace=model.trace)
    return replace(whole, force_scale=model.force_scale)


def _named(reads: Sequence[_Read]) -> tuple[Finding, ...]:
    """Name findings by their device, else by the shortest end of their path that is unique.

    A file with a usual name, such as diagnosis.json, has that of its folder.
    """
    names, depth = [], 1
    for path, finding in reads:
        folder = path.resolve().parent.name
        plain = path.stem in _PLAIN_NAMES and folder
        names.append(finding.device or (folder if plain else path.stem))
    while len(set(names)) < len(names) and depth < max(len(path.parts) for path, _ in reads):
        depth += 1
        names = [
            name if names.count(name) == 1 else "/".join(path.with_suffix("").parts[-depth:])
            for name, (path, _) in zip(names, reads, strict=True)
        ]
    counted: Counter[str] = Counter()
    out: list[Finding] = []
    for name, (_, finding) in zip(names, reads, strict=True):
        counted[name] += 1
        unique = name if counted[name] == 1 else f"{name} ({counted[name]})"
        out.append(replace(finding, device=unique))
    return tuple(out)


def finding_content(finding: Finding) -> dict[str, Any]:
    """Return a finding's main figures as one row of a table of devices."""
    causes = "; ".join(" or ".join((c.effect, *c.or_else)) for c in finding.causes)
    row: dict[str, Any] = {"verdict": finding.verdict, "cause": causes}
    row["confidence"] = finding.causes[0].confidence if finding.causes else None
    for e in finding.errors or (None,):
        prefix, unit = (f"{e.output} ", e.unit) if e and e.output != "displacement" else ("", "m")
        for name in ("base", "extended", "noise"):
            row[f"{prefix}{name}_rms [{unit}]"] = getattr(e, name, None)
    row["rms [m]"], row["rms [% of range]"] = finding.rms_m, finding.rms_percent
    row["missed [times the noise]"] = finding.noise_ratio
    for name, p in finding.parameters.items():
        if p.determined and p.interval is not None:
            row[f"{name} [{p.unit}]"] = p.value
            row[f"{name} low"], row[f"{name} high"] = p.interval
    return row
