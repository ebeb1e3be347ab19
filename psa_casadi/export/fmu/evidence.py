"""The evidence of a model inside its FMU: a page, meta data, a run to repeat, parameter sets.

Sources: SSP Traceability 1.0 (SRMD and its place in an FMU), FMI-LS-REF 1.0.0-beta.1 (roles), SSP
1.0 (parameter values).
"""

import math
from collections.abc import Collection
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np

from psa_casadi.common.characters import check_text
from psa_casadi.common.errors import InputError
from psa_casadi.common.units import FloatArray
from psa_casadi.export.common.markup import generation_tool, number, xml_text
from psa_casadi.export.common.parameter_sets import parameter_set, posterior_sets
from psa_casadi.export.common.templates import filled
from psa_casadi.export.fmu.reference_run import (
    CSV,
    EXP,
    FOLDER,
    OWN_TOLERANCE,
    SSV,
    Related,
    csv_table,
    experiments,
    rounded,
)
from psa_casadi.model.components.outputs import OUTPUT, VALIDITY, VALIDITY_WITH_TEMPERATURE
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import (
    Evidence,
    ReferenceRun,
)
from psa_casadi.simulation.stepper import run


def with_validity(model: Model) -> Model:
    """Return a model with the output `outside_validity`; one that has it is returned as it is.

    Raises InputError for a model without the range of its records.
    """
    if OUTPUT in model.output_names:
        return model
    if model.evidence is None or "drive" not in (c.name for c in model.components):
        raise InputError(
            f"The model '{model.name}' does not hold the ranges of its records, so it has no"
            f" output '{OUTPUT}'; give a file that `psa identify` or `psa diagnose` of this version"
            " wrote."
        )
    ranges = model.evidence.seen
    values = {
        "seen_voltage_low": ranges.voltage.low,
        "seen_voltage_high": ranges.voltage.high,
        "seen_voltage_rate": max(ranges.rate, 1e-9),
    }
    warm = ranges.temperature if "temperature" in model.input_names else None
    if warm is not None:
        values |= {"seen_temperature_low": warm.low, "seen_temperature_high": warm.high}
    component = VALIDITY if warm is None else VALIDITY_WITH_TEMPERATURE
    parts = (*model.base, component, *model.effects)  # MODEL.json names the base before effects
    extended = model.with_components(parts).with_values(values)
    return replace(extended, evidence=model.evidence)


def seen_inputs(model: Model) -> list[tuple[float, float, float]]:
    """Return least, largest value and rate of each input in the records, infinite if not known."""
    rows = []
    ranges = model.evidence.seen if model.evidence else None
    known = {"voltage": ranges.voltage, "temperature": ranges.temperature} if ranges else {}
    for name in model.input_names:
        extent = known.get(name)
        low, high = (extent.low, extent.high) if extent else (-math.inf, math.inf)
        rows.append((low, high, ranges.rate if ranges and name == "voltage" else math.inf))
    return rows


PAGE = "documentation/evidence.html"
META_DATA = "extra/org.ssp-standard.ssp-traceability.srmd/resourceMetaData.srmd"
SETS = f"{FOLDER}/parameter_sets"
#: The files of the run that is to be repeated.
VALIDATION, UNCERTAINTY = f"{FOLDER}/validation.exp", f"{FOLDER}/uncertainty.exp"
INPUTS, OUTPUTS = f"{FOLDER}/validation_in.csv", f"{FOLDER}/validation_ref.csv"
MEASURED, START = f"{FOLDER}/validation_measured.csv", f"{FOLDER}/validation.ssv"

#: MIME type, role and meaning of each file; {run} is the run that is to be repeated.
RELATED: dict[str, Related] = {
    PAGE: ("text/html", "report", "records, errors, range and uncertainty"),
    META_DATA: ("application/x-srmd-meta-data", "meta-data", "the same for machines"),
    SETS: (SSV, "parameter", "values within their uncertainty: {set}"),
    START: (SSV, "parameter", "all parameters, and the states at the start of the run"),
    INPUTS: (CSV, "other", "inputs of {run}"),
    OUTPUTS: (CSV, "result", "what the model predicts for {run}"),
    MEASURED: (CSV, "result", "what was measured in {run}, without the offset"),
    VALIDATION: (EXP, "experiment/validation", "{run}"),
    UNCERTAINTY: (
        EXP, "experiment/uncertainty-analysis",
        "the same voltage with each parameter set, from the FMU's start"),
}  # fmt: skip


def evidence_files(model: Model, samples: int) -> dict[str, bytes]:
    """Return the evidence of a model as files by place; none for a model without evidence.

    `samples` is the number of random parameter sets; with 0 there are no sets at all. Raises
    SimulationError if the run that is to be repeated cannot be simulated.
    """
    texts = evidence_texts(model, samples)
    if START in texts:
        times, inputs = run_inputs(model)
        start = np.array(list(run_start(model).values()))
        result = run(model, times, inputs, start, rtol=OWN_TOLERANCE)
        texts[OUTPUTS] = csv_table(("time", *model.output_names), times, rounded(result.y))
    return {place: text.encode("utf-8") for place, text in texts.items()}


def related_files(model: Model, places: Collection[str]) -> dict[str, Related]:
    """Return type, role and meaning of the files of evidence at these places, for the manifest."""
    reference = model.evidence.reference if model.evidence else None
    run_ = _words_of(reference) if reference else ""
    table = {}
    for known, (kind, role, meaning) in RELATED.items():
        for place in places:
            if place == known or place.startswith(f"{known}/"):
                table[place] = kind, role, meaning.format(run=run_, set=_set_name(place))
    return table


def evidence_texts(model: Model, samples: int) -> dict[str, str]:
    """Return all files of evidence for which nothing has to be simulated, by their place."""
    if model.evidence is None:
        return {}
    sets = set_files(model, samples)
    meta = meta_data(model, model.evidence)
    texts = {PAGE: evidence_page(model, meta), META_DATA: meta, **sets}
    reference = model.evidence.reference
    if reference is None:
        return texts
    times, inputs = run_inputs(model)
    again = model.evidence.run_of(reference.record)
    valid = [
        (t, y - (again.offset_m if again else 0.0))
        for t, y in zip(reference.time, reference.displacement, strict=True)
        if y is not None
    ]
    measured = np.array(valid).reshape(len(valid), 2)
    stimuli = {"Stimuli": _local(INPUTS)}
    files = {"Parameters": _local(START), **stimuli, "References": _local(OUTPUTS)}
    texts |= {
        START: parameter_set(model, name="validation", states=run_start(model)),
        INPUTS: csv_table(("time", *model.input_names), times, inputs),
        MEASURED: csv_table(("time", "displacement"), measured[:, 0], rounded(measured[:, 1:])),
        VALIDATION: experiments("validation", times, [("record", _words_of(reference), files)]),
    }
    if sets:
        spread = [
            (_set_name(p), "a parameter set", {"Parameters": _local(p), **stimuli}) for p in sets
        ]
        texts[UNCERTAINTY] = experiments("uncertainty", times, spread)
    return texts


def set_files(model: Model, samples: int) -> dict[str, str]:
    """Return the parameter sets within the uncertainty by their place in the archive."""
    result = posterior_sets(model, samples) if samples > 0 else {}
    return {f"{SETS}/{n}.ssv": parameter_set(model, v, name=n) for n, v in result.items()}


def evidence_page(model: Model, meta: str) -> str:
    """Return the page on a model's evidence, with the content of the meta data."""
    table = {
        part.attrib["type"].removeprefix("psa_casadi."): [
            (e.attrib["keyword"], e.text)
            for e in part
            if not e.attrib["keyword"].startswith("covariance")
        ]
        for part in ET.fromstring(meta)
    }
    text = filled(
        "evidence.html",
        title=f"{model.name}: evidence",
        meta=table,
        validation=VALIDATION,
        sets=SETS,
    )
    check_text(text, "The page on the evidence")
    return text


def meta_data(model: Model, evidence: Evidence) -> str:
    """Return the SRMD file: a classification for each part of the evidence."""
    stated = model.publication.stated
    if "version" in stated:
        stated["fileversion"] = stated.pop("version")
    head = {"name": f"evidence of {model.name}", **stated, "generationTool": generation_tool()}
    c = evidence.covariance
    rows = list(zip(c.names, c.matrix, strict=True))
    return xml_text(
        "resourceMetaData.xml",
        head=head,
        model=model,
        evidence=evidence,
        records=[(r, sum(stop - first for first, stop in r.held_out)) for r in evidence.runs],
        sure=[(n, model.parameter(n).unit, row[k] ** 0.5) for k, (n, row) in enumerate(rows)],
        rows=[(n, " ".join(map(number, row))) for n, row in rows],
    )


def run_start(model: Model) -> dict[str, float]:
    """Return the states in which the run that is to be repeated starts."""
    evidence, reference = _reference(model)
    again = evidence.run_of(reference.record)
    start = again.start if again else {}
    return {s.name: start.get(s.name, s.start) for s in model.structure.states}


def run_inputs(model: Model) -> tuple[FloatArray, FloatArray]:
    """Return times (n,) [s] and inputs (n, nu) of the run that is to be repeated."""
    _, reference = _reference(model)
    times = np.array(reference.time)
    columns = [
        np.array(reference.inputs.get(i.name, [i.start] * len(times)))
        for i in model.structure.inputs
    ]
    return times, np.array(columns).T


def _reference(model: Model) -> tuple[Evidence, ReferenceRun]:
    evidence = model.evidence
    if evidence is None or evidence.reference is None:
        raise InputError(f"The model '{model.name}' has no run to repeat; identify it again.")
    return evidence, evidence.reference


def _words_of(reference: ReferenceRun) -> str:
    return f"the first {reference.time[-1]:.4g} s of the record {reference.record}"


def _local(place: str) -> str:
    """Return a place in the archive as a file of the run names it."""
    return place.removeprefix(f"{FOLDER}/")


def _set_name(place: str) -> str:
    return place.rpartition("/")[2].removesuffix(".ssv")
