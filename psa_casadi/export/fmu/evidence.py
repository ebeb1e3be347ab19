"""What stands behind a model, inside its FMU: a page, meta data, a run to repeat, parameter sets.

Sources: SSP Traceability 1.0 (SRMD and its place in an FMU), FMI-LS-REF 1.0.0-beta.1 (roles), SSP
1.0 (parameter values).
"""

import html
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

from psa_casadi.components.outputs import OUTPUT, VALIDITY, VALIDITY_WITH_TEMPERATURE
from psa_casadi.errors import InputError
from psa_casadi.export.common.markup import generation_tool, number, page, table_of, xml_text
from psa_casadi.export.common.parameter_sets import parameter_set, posterior_sets
from psa_casadi.export.fmu.reference_run import (
    CSV,
    EXP,
    FOLDER,
    OWN_TOLERANCE,
    SSV,
    Experiment,
    Related,
    csv_table,
    experiments,
    rounded,
)
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import Covariance, Evidence, RecordRun, ReferenceRun
from psa_casadi.simulation.stepper import run


def with_validity(model: Model) -> Model:
    """Return a model with the output `outside_validity`; one that has it is returned as it is.

    Raises InputError for a model that does not say what its records have shown.
    """
    if OUTPUT in model.output_names:
        return model
    if model.evidence is None or "drive" not in (c.name for c in model.components):
        raise InputError(
            f"The model '{model.name}' does not say what its records have shown, so it has no"
            f" output '{OUTPUT}'; give a file that `psa identify` or `psa diagnose` of this version"
            " wrote."
        )
    seen = model.evidence.seen
    values = {
        "seen_voltage_low": seen.voltage.low,
        "seen_voltage_high": seen.voltage.high,
        "seen_voltage_rate": max(seen.rate, 1e-9),
    }
    warm = seen.temperature if "temperature" in model.input_names else None
    if warm is not None:
        values |= {"seen_temperature_low": warm.low, "seen_temperature_high": warm.high}
    component = VALIDITY if warm is None else VALIDITY_WITH_TEMPERATURE
    base = (c for c in model.components if c.gain is None)  # MODEL.json names them before effects
    extended = model.with_components((*base, component, *model.effects)).with_values(values)
    return replace(extended, evidence=model.evidence)


def seen_inputs(model: Model) -> list[Sequence[float]]:
    """Return least, largest value and rate of each input in the records, infinite if not known."""
    rows: list[Sequence[float]] = []
    seen = model.evidence.seen if model.evidence else None
    for i in model.structure.inputs:
        known = {"voltage": seen.voltage, "temperature": seen.temperature} if seen else {}
        found = known.get(i.name)
        low, high = (found.low, found.high) if found else (-math.inf, math.inf)
        rows.append((low, high, seen.rate if seen and i.name == "voltage" else math.inf))
    return rows


def seen_duration(model: Model) -> float:
    """Return the duration of the longest record [s], infinite if not known."""
    return model.evidence.seen.duration if model.evidence else math.inf


NOT_HELD_OUT = "no sample was held out; `psa diagnose` holds some out and judges the model on them"


@dataclass(frozen=True)
class Said:
    """One thing that is said: a keyword for machines, and the text."""

    keyword: str
    text: str


@dataclass(frozen=True)
class Chapter:
    """A part of the evidence: its name for machines, its title, and what is said there."""

    name: str
    title: str
    said: tuple[Said, ...]


def chapters(model: Model, evidence: Evidence) -> tuple[Chapter, ...]:
    """Return what is known of a model's origin, errors, range and uncertainty."""
    origin = Said("found by", f"{evidence.by}, psa_casadi {model.provenance.package_version}")
    parts: tuple[tuple[str, str, Iterable[Said]], ...] = (
        ("origin", "Where it comes from", (origin, *_records(evidence.runs))),
        ("error", "What it errs by", _errors(evidence)),
        ("budget", "Where the error goes", _budget(evidence)),
        ("validity", "What the records have shown", _seen(evidence)),
        ("covariance", "How sure the values are", _sure(model, evidence.covariance)),
    )
    found = (Chapter(name, title, tuple(said)) for name, title, said in parts)
    return tuple(c for c in found if c.said)


def micrometres(metres: float) -> str:
    """Return a length as people read it."""
    return f"{1e6 * metres:.4g} um"


def _records(runs: Iterable[RecordRun]) -> Iterator[Said]:
    for r in runs:
        blocks = f", each the mean of {r.averaged}" if r.averaged > 1 else ""
        errors = f"fitted to {micrometres(r.fitted_m)} rms"
        if r.held_out_m is not None:
            count = sum(stop - first for first, stop in r.held_out)
            errors += f", {micrometres(r.held_out_m)} rms over {count} held-out ones"
        yield Said(
            "record", f"{r.record}, sha256 {r.sha256}: {r.samples} samples{blocks}; {errors}"
        )


def _errors(evidence: Evidence) -> Iterator[Said]:
    yield Said("fitted error", f"{micrometres(evidence.fitted_m)} rms over the samples of the fit")
    held = evidence.held_out
    if held is None:
        yield Said("held-out error", NOT_HELD_OUT)
    else:
        low, high = held.interval_m.low, held.interval_m.high
        over = f"{held.records} records" if held.records else "blocks of the records"
        yield Said(
            "held-out error",
            f"{micrometres(held.rms_m)} rms, 95 % interval {micrometres(low)} to"
            f" {micrometres(high)} (jackknife over {over}); {held.nrmse_percent:.3g} % of the"
            f" range; at most {micrometres(held.max_m)}",
        )
    if evidence.outside:
        yield Said(
            "counted with",
            f"{', '.join(evidence.outside)}: of sensor or environment, which an exported plant"
            " leaves out",
        )


def _budget(evidence: Evidence) -> Iterator[Said]:
    yield from (Said("unnamed correction inside", text) for text in evidence.unnamed)
    b = evidence.budget
    if b is None:
        return
    yield Said("base", f"{micrometres(b.base_m)} rms above the noise, without the causes")
    yield Said("noise", f"{micrometres(b.noise_m)} rms")
    for effect in b.causes:
        yield Said("effect", f"{effect.what}: {_share(effect.share, effect.interval)}")
    if b.unnamed is not None:
        share = _share(b.unnamed.share, b.unnamed.interval)
        yield Said("unnamed correction outside", f"{b.unnamed.what}: {share}; the model lacks it")
    yield Said(
        "remains", f"{micrometres(b.remains_m)} rms above the noise, {b.remains_percent:.3g} % of"
        " the range"
    )  # fmt: skip


def _share(share: float, interval: object) -> str:
    ends = (share, *(getattr(interval, end) for end in ("low", "high")))
    percent, low, high = (100.0 * min(max(v, 0.0), 1.0) for v in ends)  # cut as in every page
    return f"{percent:.3g} % of the error, 95 % interval {low:.3g} to {high:.3g} %"


def _seen(evidence: Evidence) -> Iterator[Said]:
    seen = evidence.seen
    yield Said("voltage", f"{seen.voltage.low:.6g} to {seen.voltage.high:.6g} V")
    yield Said("rate of voltage", f"up to {seen.rate:.4g} V/s")
    yield Said("duration", f"up to {seen.duration:.4g} s from the start of a run")
    warm = seen.temperature
    yield Said(
        "temperature",
        "not recorded" if warm is None else f"{warm.low:.6g} to {warm.high:.6g} K",
    )


def _sure(model: Model, c: Covariance) -> Iterator[Said]:
    """Yield the standard errors, and the covariance row by row."""
    for k, name in enumerate(c.names):
        unit = model.parameter(name).unit
        value = f"{model.values[name]:.6g}{'' if unit == '1' else f' {unit}'}"
        yield Said(name, f"{value}, standard error {c.matrix[k][k] ** 0.5:.3g}")
    if c.names:
        yield Said("covariance of", " ".join(c.names))
        for name, row in zip(c.names, c.matrix, strict=True):
            yield Said(f"covariance.{name}", " ".join(number(v) for v in row))


FloatArray = npt.NDArray[np.float64]

PAGE = "documentation/evidence.html"
META_DATA = "extra/org.ssp-standard.ssp-traceability.srmd/resourceMetaData.srmd"
SETS = f"{FOLDER}/parameter_sets"
#: The files of the run that is to be repeated.
VALIDATION, UNCERTAINTY = f"{FOLDER}/validation.exp", f"{FOLDER}/uncertainty.exp"
INPUTS, OUTPUTS = f"{FOLDER}/validation_in.csv", f"{FOLDER}/validation_ref.csv"
MEASURED, START = f"{FOLDER}/validation_measured.csv", f"{FOLDER}/validation.ssv"

_SRMD = "http://ssp-standard.org/SSPTraceability1/SimulationResourceMetaData"
_STC = "http://ssp-standard.org/SSPTraceability1/SSPTraceabilityCommon"
_PAGE_NOTE = """\
These are statements of the model file about records that are not in this archive. With a record at
hand, `psa check --evidence --record FILE` plays it through this FMU and tells what holds."""

_PAGE_FILES = f"""\
<code>{VALIDATION}</code> lists the run to repeat: the first part of a record, its inputs, what the
model says of it, and what was measured. Parameter sets within the uncertainty, where the export
made them, lie in <code>{SETS}</code>: the mean, pairs of sigma points, random samples."""


@dataclass(frozen=True)
class EvidenceFiles:
    """Files by their place in the archive, and what the manifest says of each."""

    entries: Mapping[str, bytes] = field(default_factory=dict)
    related: Mapping[str, Related] = field(default_factory=dict)


def evidence_files(model: Model, samples: int) -> EvidenceFiles:
    """Return the evidence of a model as files; none for a model without evidence.

    `samples` is the number of random parameter sets; with 0 there are no sets at all. Raises
    SimulationError if the run that is to be repeated cannot be simulated.
    """
    if model.evidence is None:
        return EvidenceFiles()
    sets = set_files(model, samples)
    texts = evidence_texts(model, samples)
    related = {
        PAGE: Related("text/html", "report", "records, errors, range and uncertainty"),
        META_DATA: Related("application/x-srmd-meta-data", "meta-data", "the same for machines"),
    }
    for place in sets:
        meaning = f"values within their uncertainty: {_set_name(place)}"
        related[place] = Related(SSV, "parameter", meaning)
    if model.evidence.reference is not None:
        texts[OUTPUTS] = _outputs(model)
        related |= _related_run(model.evidence.reference, spread=bool(sets))
    return EvidenceFiles({n: t.encode("utf-8") for n, t in texts.items()}, related)


def evidence_texts(model: Model, samples: int) -> dict[str, str]:
    """Return all files of evidence for which nothing has to be simulated, by their place."""
    if model.evidence is None:
        return {}
    sets = set_files(model, samples)
    texts = {PAGE: evidence_page(model), META_DATA: meta_data(model), **sets}
    if model.evidence.reference is not None:
        texts |= _run_files(model, model.evidence.reference, tuple(sets))
    return texts


def set_files(model: Model, samples: int) -> dict[str, str]:
    """Return the parameter sets within the uncertainty by their place in the archive."""
    found = posterior_sets(model, samples) if samples > 0 else {}
    return {f"{SETS}/{n}.ssv": parameter_set(model, v, name=n) for n, v in found.items()}


def evidence_page(model: Model) -> str:
    """Return the page on a model's evidence."""
    parts = [f"<h1>{html.escape(model.name)}: evidence</h1>", f"<p>{_PAGE_NOTE}</p>"]
    for chapter in chapters(model, model.evidence) if model.evidence else ():
        said = [(s.keyword, s.text) for s in chapter.said if not s.keyword.startswith("covariance")]
        parts += [f"<h2>{html.escape(chapter.title)}</h2>", table_of(("", ""), said)]
    parts += ["<h2>In this archive</h2>", f"<p>{_PAGE_FILES}</p>"]
    parts.append('<p><a href="index.html">The model</a></p>')
    return page(f"{model.name}: evidence", parts, "The page on the evidence")


def meta_data(model: Model) -> str:
    """Return the SRMD file: a classification for each part of the evidence."""
    ET.register_namespace("srmd", _SRMD)
    ET.register_namespace("stc", _STC)
    stated = model.publication.stated
    if "version" in stated:
        stated["fileversion"] = stated.pop("version")
    attributes = {"version": "1.0.0", "name": f"evidence of {model.name}", **stated}
    root = ET.Element(
        f"{{{_SRMD}}}SimulationResourceMetaData",
        {**attributes, "generationTool": generation_tool()},
    )
    for chapter in chapters(model, model.evidence) if model.evidence else ():
        kind = {"type": f"psa_casadi.{chapter.name}"}
        element = ET.SubElement(root, f"{{{_STC}}}Classification", kind)
        for said in chapter.said:
            entry = ET.SubElement(
                element, f"{{{_STC}}}ClassificationEntry", {"keyword": said.keyword}
            )
            entry.text = said.text
    return xml_text(root)


def run_start(model: Model) -> dict[str, float]:
    """Return the states in which the run that is to be repeated starts."""
    found = _run_of(model)
    start = found.start if found else {}
    return {s.name: start.get(s.name, s.start) for s in model.structure.states}


def run_inputs(model: Model) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) [s] and inputs (n, nu) of the run that is to be repeated."""
    reference = _reference(model)
    times = np.array(reference.time)
    columns = [
        np.array(reference.inputs.get(i.name, [i.start] * len(times)))
        for i in model.structure.inputs
    ]
    return times, np.array(columns).T


def _reference(model: Model) -> ReferenceRun:
    if model.evidence is None or model.evidence.reference is None:
        raise InputError(f"The model '{model.name}' has no run to repeat; identify it again.")
    return model.evidence.reference


def _run_of(model: Model) -> RecordRun | None:
    return model.evidence.run_of(_reference(model).record) if model.evidence else None


def _outputs(model: Model) -> str:
    """Return what the model says of the run that is to be repeated."""
    times, inputs = run_inputs(model)
    start = np.array(list(run_start(model).values()))
    found = run(model, times, inputs, start, rtol=OWN_TOLERANCE)
    return csv_table(("time", *model.output_names), times, rounded(found.y))


def _run_files(model: Model, reference: ReferenceRun, sets: tuple[str, ...]) -> dict[str, str]:
    """Return the files of the run that is to be repeated, but for its outputs."""
    times, inputs = run_inputs(model)
    stimuli = {"Stimuli": _beside(INPUTS)}
    files = {"Parameters": _beside(START), **stimuli, "References": _beside(OUTPUTS)}
    spread = [
        Experiment(_set_name(p), "a parameter set", times, {"Parameters": _beside(p), **stimuli})
        for p in sets
    ]
    whole = Experiment("record", _said(reference), times, files)
    texts = {
        START: parameter_set(model, name="validation", states=run_start(model)),
        INPUTS: csv_table(("time", *model.input_names), times, inputs),
        MEASURED: _measured(model, reference),
        VALIDATION: experiments("validation", [whole]),
    }
    return {**texts, **({UNCERTAINTY: experiments("uncertainty", spread)} if spread else {})}


def _said(reference: ReferenceRun) -> str:
    return f"the first {reference.time[-1]:.4g} s of the record {reference.record}"


def _related_run(reference: ReferenceRun, *, spread: bool) -> dict[str, Related]:
    said = _said(reference)
    meaning = "the same voltage with each parameter set, from the FMU's own start"
    analysis = {UNCERTAINTY: Related(EXP, "experiment/uncertainty-analysis", meaning)}
    return {
        START: Related(SSV, "parameter", "all parameters, and the states at the start of the run"),
        INPUTS: Related(CSV, "other", f"inputs of {said}"),
        OUTPUTS: Related(CSV, "result", f"what the model says of {said}"),
        MEASURED: Related(CSV, "result", f"what was measured in {said}, without the offset"),
        VALIDATION: Related(EXP, "experiment/validation", said),
        **(analysis if spread else {}),
    }


def _beside(place: str) -> str:
    """Return a place in the archive as a file of the run names it."""
    return place.removeprefix(f"{FOLDER}/")


def _set_name(place: str) -> str:
    return place.rpartition("/")[2].removesuffix(".ssv")


def _measured(model: Model, reference: ReferenceRun) -> str:
    """Return what was measured, less the offset of the sensor; missing samples are left out."""
    found = _run_of(model)
    offset = found.offset_m if found else 0.0
    valid = [
        (t, y - offset)
        for t, y in zip(reference.time, reference.displacement, strict=True)
        if y is not None
    ]
    rows = np.array(valid).reshape(len(valid), 2)
    return csv_table(("time", "displacement"), rows[:, 0], rounded(rows[:, 1:]))
