"""What stands behind a model, inside its FMU: a page, meta data, a run to repeat, parameter sets.

Sources: SSP Traceability 1.0 (SRMD and its place in an FMU), FMI-LS-REF 1.0.0-beta.1 (roles), SSP
1.0 (parameter values).
"""

import html
from collections.abc import Mapping
from dataclasses import dataclass, field
from xml.etree import ElementTree as ET

import numpy as np
import numpy.typing as npt

from psa_casadi.errors import InputError
from psa_casadi.export.common.html_page import page, table_of
from psa_casadi.export.common.markup import generation_tool, xml_text
from psa_casadi.export.common.parameter_sets import parameter_set
from psa_casadi.export.common.posterior import posterior_sets
from psa_casadi.export.fmu.evidence_words import chapters
from psa_casadi.export.fmu.reference_results import (
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
from psa_casadi.model.evidence import RecordRun, ReferenceRun
from psa_casadi.simulation.stepper import run

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
