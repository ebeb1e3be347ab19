"""The record that a model's file carries, played through the model again."""

import math

import numpy as np

from psa_casadi.model.compose import Model
from psa_casadi.population.finding import Trace
from psa_casadi.simulation.simulate import input_samples, output_of
from psa_casadi.simulation.stepper import run


def replayed(model: Model) -> Trace | None:
    """Return the first part of the record beside the model with the sensor's offset, else None.

    Raises SimulationError.
    """
    found = model.evidence.reference if model.evidence else None
    if model.evidence is None or found is None or "voltage" not in found.inputs:
        return None
    known = model.evidence.run_of(found.record)
    time = np.array(found.time)
    inputs = {n: np.array(v) for n, v in found.inputs.items() if n in model.input_names}
    u = input_samples(model, time.size, inputs)
    start = known.start if known is not None else {}
    x0 = np.array([start.get(s.name, s.start) for s in model.structure.states])
    shows = model.output_names.index(output_of(model) or "displacement")  # with the sensor's errors
    y = run(model, time, u, x0, rtol=1e-6).y[:, shows]
    offset = known.offset_m if known is not None else 0.0
    shown = tuple(math.nan if v is None else v for v in found.displacement)
    return Trace(
        found.record, found.time, found.inputs["voltage"], shown, tuple((y + offset).tolist())
    )
