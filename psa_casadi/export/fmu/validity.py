"""What the records behind a model have shown, in its FMU: for the log, and as an output."""

import math
from collections.abc import Sequence
from dataclasses import replace

from psa_casadi.components.outputs import OUTPUT, VALIDITY, VALIDITY_WITH_TEMPERATURE
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model


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
