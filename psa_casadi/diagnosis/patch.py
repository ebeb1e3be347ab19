"""The component that stands for an unnamed correction in a model."""

from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np

from psa_casadi.diagnosis.corrections import Patch, time_constants
from psa_casadi.effects.patches import GAIN, PATCHES, RELAXATIONS, weight
from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.refitting import POLISH
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.stepper import SimulationError
from psa_casadi.units import FloatArray


def with_patch(
    before: Fit, patch: Patch, experiments: Sequence[Experiment], predicted: Sequence[FloatArray]
) -> Fit:
    """Return a fit with the correction beside the model, begun with the weights that it has.

    The model's own values begin where they follow the correction, and where they were.

    `predicted` [m] are the predictions of `before`. Raises InputError for a kind that no component
    stands for, SimulationError where it cannot be simulated.
    """
    component = PATCHES.get((patch.kind, patch.port))
    if component is None:
        raise InputError(
            f"The unnamed correction ({patch.name}) has no form that a model could hold; the page"
            " shows it, and a further mode of the table is the nearest that can be fitted."
        )
    numbers = _numbers(before, patch, experiments, predicted)
    names = [weight(k + 1) for k in range(len(patch.weights))]
    values = {**numbers, GAIN: 1.0, **dict(zip(names, patch.weights.tolist(), strict=True))}

    def begun(theta: FloatArray) -> Fit:
        unknowns = before.unknowns
        return fit(
            before.model.with_effect(component, {**values, **unknowns.values(theta)}),
            experiments,
            [*unknowns.names, *names],
            sigma=before.sigma,
            start_states=[unknowns.start(theta, r) for r in range(unknowns.records)],
            evaluations=POLISH,
        )

    items = []
    for theta in (before.theta + patch.moved, before.theta):
        with suppress(SimulationError):
            items.append(begun(theta))
    if not items:
        raise SimulationError("The model cannot be simulated with the unnamed correction.")
    return min(items, key=lambda f: f.cost)


def _numbers(
    before: Fit, patch: Patch, experiments: Sequence[Experiment], predicted: Sequence[FloatArray]
) -> Mapping[str, float]:
    """Return the parameters that are not fitted: the range, times."""
    records = [e.record for e in experiments]
    longest = max(r.duration for r in records)
    if patch.kind in ("direction", "memory") or patch.port == "drive voltage":
        every = np.concatenate([r.voltage for r in records])
    else:
        every = np.concatenate([y - before.offset(k) for k, y in enumerate(predicted)])
    numbers = {"patch_low": float(np.min(every)), "patch_high": float(np.max(every))}
    if patch.kind == "time":
        return {"patch_time": longest}
    if patch.kind == "gain in time":
        return {**numbers, "patch_time": longest}
    if patch.kind == "relaxation":
        taus = time_constants(records)
        if len(taus) > RELAXATIONS:
            raise InputError("The records span more decades of time than a correction can hold.")
        return {**numbers, "patch_time": float(taus[0]), "patch_ratio": float(taus[1] / taus[0])}
    return numbers
