"""The unnamed correction that is offered, and the component that stands for it in a model."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.corrections import Correction, time_constants
from psa_casadi.diagnosis.screening import temperature
from psa_casadi.diagnosis.task import LIMITS, Thresholds
from psa_casadi.effects.patches import GAIN, PATCHES, RELAXATIONS, weight
from psa_casadi.errors import InputError
from psa_casadi.identification.fitting.fit import Fit, fit
from psa_casadi.identification.refitting import POLISH
from psa_casadi.notes import note
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.stepper import SimulationError

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Patch:
    """An unnamed correction: its kind and port, what else it may be, evidence and predictions.

    `open_to` are other kinds and ports that explain the data as well; `predicted` [m] are whole
    records with it, `added` [m] its own part of them, `weights` [m] those of its terms, `moved` how
    far the model's own theta follows.
    """

    kind: str
    port: str
    evidence: float
    open_to: tuple[str, ...]
    predicted: tuple[FloatArray, ...]
    added: tuple[FloatArray, ...]
    weights: FloatArray
    moved: FloatArray

    @property
    def name(self) -> str:
        """Kind and port."""
        return f"{self.kind} at the {self.port}"

    @property
    def sentence(self) -> str:
        """What it is in words."""
        return str(note("correction", kind=self.kind, port=self.port))

    def to_dict(self) -> dict[str, Any]:
        """Return the content for DIAGNOSIS.json."""
        return {
            "kind": self.kind,
            "port": self.port,
            "sentence": self.sentence,
            "evidence": self.evidence,
            "open_to": list(self.open_to),
        }


def patch_of(
    found: Sequence[Correction],
    experiments: Sequence[Experiment],
    holdout_rms: float,
    colour: Colour,
    limits: Thresholds = LIMITS,
) -> Patch | None:
    """Return the best correction beside a model; None if none helps.

    Its evidence must be above the price of a cause, and the log-likelihood of the held-out samples,
    where the model errs by `holdout_rms` [m], must gain as much as for a cause.
    """
    samples = sum(int(e.held_out.sum()) for e in experiments) / colour.inflation

    def gained(c: Correction) -> float:
        return samples * float(np.log(holdout_rms / max(c.holdout_rms, 1e-300)))

    told = [c for c in found if c.evidence > limits.price]
    good = [c for c in told if not samples or gained(c) > limits.held_out]
    if not good:
        return None
    best = max(good, key=lambda c: c.evidence)
    near = limits.clearly * temperature(best.evidence, limits)
    others = [c for c in good if c is not best and c.evidence > best.evidence - near]
    return Patch(
        kind=best.kind.name,
        port=best.kind.port,
        evidence=best.evidence,
        open_to=tuple(f"{c.kind.name} at the {c.kind.port}" for c in others),
        predicted=best.predicted,
        added=best.added,
        weights=best.weights,
        moved=best.moved,
    )


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

    found = []
    for theta in (before.theta + patch.moved, before.theta):
        with suppress(SimulationError):
            found.append(begun(theta))
    if not found:
        raise SimulationError("The model cannot be simulated with the unnamed correction.")
    return min(found, key=lambda f: f.cost)


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
