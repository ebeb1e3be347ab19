"""What is known of one device: its parameters with intervals, verdict, causes and errors."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import Literal

import numpy as np

from psa_casadi.model.compose import Model
from psa_casadi.simulation.simulate import input_samples, output_of
from psa_casadi.simulation.stepper import run

#: Half the width of a 95 % interval over the standard error.
NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class Estimate:
    """A parameter of one device in its SI unit: value and 95 % interval.

    `determined` is False if the records do not determine the parameter or it sits on a bound.
    """

    value: float
    unit: str
    interval: tuple[float, float] | None
    determined: bool = True
    meaning: str = ""


@dataclass(frozen=True)
class NamedCause:
    """A cause with its confidence, the share of the error that it explains, and its rivals."""

    effect: str
    confidence: float
    share: float
    or_else: tuple[str, ...] = ()


@dataclass(frozen=True)
class BudgetShare:
    """A share of the base model's held-out error above the noise, with its 95 % interval."""

    what: str
    share: float
    interval: tuple[float, float]


@dataclass(frozen=True)
class HeldOutErrors:
    """Held-out rms of an output in its unit: base and extended model, and the noise.

    Of a stack's displacement the extended model's in % of the range, too.
    """

    base: float
    extended: float
    noise: float
    extended_percent: float | None = None
    output: str = "displacement"
    unit: str = "m"


@dataclass(frozen=True)
class Trace:
    """The first part of a record and its model: (n,) in SI units, nan where not measured."""

    record: str
    time: tuple[float, ...]
    voltage: tuple[float, ...]
    measured: tuple[float, ...]
    model: tuple[float, ...]


@dataclass(frozen=True)
class Finding:
    """The result for one device.

    `kind` is that of the result. `rms_m` and `rms_percent` are the rms residual of an
    identification, [m] and in % of the range; `warnings` are its doubts in words, and `noise_ratio`
    is the residual over the noise, None where the fit reaches the noise. `records` are the names
    and SHA-256 of the files. What a file does not hold is empty or None.
    """

    device: str
    kind: Literal["identification", "diagnosis", "model"]
    parameters: Mapping[str, Estimate] = field(default_factory=dict)
    records: tuple[tuple[str, str], ...] = ()
    batch: str = ""
    day: date | None = None
    verdict: str = ""
    doubt: str = ""
    causes: tuple[NamedCause, ...] = ()
    errors: tuple[HeldOutErrors, ...] = ()
    budget: tuple[BudgetShare, ...] = ()
    rms_m: float | None = None
    rms_percent: float | None = None
    force_scale: str = ""
    trace: Trace | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    noise_ratio: float | None = None


def replayed(model: Model) -> Trace | None:
    """Return the first part of the record and the model with the sensor's offset, else None.

    Raises SimulationError.
    """
    part = model.evidence.reference if model.evidence else None
    if model.evidence is None or part is None or "voltage" not in part.inputs:
        return None
    known = model.evidence.run_of(part.record)
    start, offset = (known.start, known.offset_m) if known is not None else ({}, 0.0)
    time = np.array(part.time)
    inputs = {n: np.array(v) for n, v in part.inputs.items() if n in model.input_names}
    u = input_samples(model, time.size, inputs)
    x0 = np.array([start.get(s.name, s.start) for s in model.structure.states])
    sensor = model.output_names.index(output_of(model) or "displacement")  # with its errors
    y = run(model, time, u, x0, rtol=1e-6).y[:, sensor]
    measured = tuple(math.nan if v is None else v for v in part.displacement)
    modelled = tuple((y + offset).tolist())
    return Trace(part.record, part.time, part.inputs["voltage"], measured, modelled)
