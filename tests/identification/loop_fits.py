"""Fits to slow loops of named stacks, which leave lags and masses open."""

from functools import cache

import numpy as np

from psa_casadi.common.units import FloatArray
from psa_casadi.identification.determinacy import Determinacy, determinacy
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.model.compose import Model
from psa_casadi.records import Record
from psa_casadi.records.split import Experiment, whole
from psa_casadi.simulation.simulate import simulate
from tests.model.stack_models import stack
from tests.studies.benchmarks.records import LOOP_FREQUENCIES, loop_voltage

NOISE = 1e-3  # of the stroke
LOOP = ("k_L", "A", "beta", "gamma", "delta", "n")
FREE = (*LOOP, "tau", "R_s", "c_P", "c_B")


def measured(model: Model, name: str, time: FloatArray, voltage: FloatArray, seed: int) -> Record:
    x = simulate(model, time, voltage).displacement
    stroke = model.values["k_L"] * model.values["u_rated"] / model.values["k_B"]
    white = np.random.default_rng(seed).standard_normal(len(time))
    return Record(name=name, time=time, voltage=voltage, displacement=x + NOISE * stroke * white)


@cache
def loops(name: str) -> tuple[Fit, tuple[Experiment, ...], Determinacy]:
    """Return a fit to slow loops of a named stack: 1 Hz and 10 Hz, 500 samples a period."""
    model = stack(name)
    records = [
        measured(model, f"{f:g} Hz", *loop_voltage(model.values, 1.0, f), seed)
        for seed, f in enumerate(LOOP_FREQUENCIES)
    ]
    experiments = tuple(whole(r) for r in records)
    sigma = [NOISE * r.range_m for r in records]
    result = fit(model, experiments, FREE, sigma=sigma)
    return result, experiments, determinacy(result)
