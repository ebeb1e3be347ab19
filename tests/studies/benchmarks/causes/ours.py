"""What `psa diagnose` answers on the data set: the record alone, every effect, no settings."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.result import Diagnosis
from psa_casadi.diagnosis.verdict import patched_model
from psa_casadi.errors import PsaError
from psa_casadi.model.compose import Model
from psa_casadi.records.read.reading import read_record
from psa_casadi.simulation.simulate import simulate
from tests.studies.benchmarks.causes.answers import FloatArray, answer, held_out_columns

#: 0 degC [K].
ZERO_CELSIUS = 273.15
#: Less than this is no statement.
_LEAST = 0.01


def answered(folder: Path, name: str) -> dict[str, Any]:
    """Diagnose the record of a case, and predict the held-out one."""
    case = folder / "cases" / name
    begin = time.process_time()
    d = diagnose([read_record(case / "record.csv")])
    seconds = time.process_time() - begin
    low, high = d.gain.interval
    return answer(
        name,
        detected=d.verdict not in ("adequate", "not_driven"),
        causes=_sets(d),
        predicted=_predicted(d, case),
        seconds=seconds,
        gain=(d.gain.holdout_rms_reduction_percent, low, high) if d.causes else None,
    )


def _sets(d: Diagnosis) -> list[dict[str, float]]:
    """Return each named cause with what it cannot be told from, and their probabilities.

    The first step's candidates have theirs; a later cause has its confidence, and what it cannot be
    told from shares the rest.
    """
    told = {c.effect: c.probability for c in d.candidates}
    sets = []
    for k, cause in enumerate(d.causes):
        rest = max(0.0, 1.0 - cause.confidence) / max(1, len(cause.cannot_be_told_from))
        own = {cause.effect: cause.confidence}
        for other in cause.cannot_be_told_from:
            own[other] = max(_LEAST, min(rest, told.get(other, rest) if k == 0 else rest))
        over = max(1.0, sum(own.values()))
        sets.append({e: p / over for e, p in own.items()})
    return sets


def _predicted(d: Diagnosis, case: Path) -> FloatArray:
    """Return the displacement on the held-out voltage [m]: with the unnamed correction, where a
    remainder has no name and one is offered.
    """
    if d.patch is not None and d.verdict in ("unexplained", "partly_explained"):
        try:
            return _run(patched_model(d), case)
        except PsaError:
            pass  # the correction cannot be simulated: the model without it is the answer
    return _run(d.model, case)


def _run(model: Model, case: Path) -> FloatArray:
    times, voltage, celsius = held_out_columns(case)
    warm = celsius + ZERO_CELSIUS if "temperature" in model.input_names else None
    return np.asarray(simulate(model, times, voltage, temperature=warm).displacement)
