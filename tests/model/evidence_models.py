"""A model with evidence: three values fitted to a short noisy record, judged on held-out blocks."""

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

import psa_casadi as psa
from psa_casadi.diagnosis.verdict import diagnosed_model
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.records.split import divided

_FOLDER = tempfile.TemporaryDirectory()
NOISE, OFFSET = 2e-8, 3e-7


@cache
def noisy_record() -> psa.Record:
    """Return 640 samples in 0.64 s: 0 to 80 V, with drawn noise and an offset of the sensor."""
    time = np.asarray(np.arange(640) * 1e-3, dtype=np.float64)
    voltage = 40.0 * (1.0 - np.cos(25.0 * time)) * (1.0 - 0.5 * time)
    result = psa.simulate(psa.stack_model("demo"), time, voltage).displacement
    noise = NOISE * np.random.default_rng(3).standard_normal(len(time))
    return psa.Record(
        name="short", time=time, voltage=voltage, displacement=result + noise + OFFSET
    )


@cache
def evident_model() -> psa.Model:
    """Return the model that was fitted to `noisy_record`."""
    record = noisy_record()
    experiments = divided([record], ())
    start = psa.stack_model("demo")
    table = {n: 1.05 * start.values[n] for n in ("k_L", "A", "tau")}
    result = fit(start, experiments, list(table), sigma=[NOISE], start=table)
    return diagnosed_model(result, result.predicted(), False)


@cache
def evident_fmu(fmi: int = 2) -> Path:
    """Return the FMU of that model, with two random parameter sets and the output."""
    path = Path(_FOLDER.name) / f"evident_{fmi}.fmu"
    return psa.export_fmu(
        evident_model(), path, name="evident", fmi=fmi, parameter_sets=2, validity_output=True
    )
