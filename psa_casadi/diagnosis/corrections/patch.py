"""The unnamed correction that is offered: where it sits, what it removes, and its curve."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.colour import Colour
from psa_casadi.diagnosis.corrections.correct import Correction
from psa_casadi.diagnosis.screening import temperature
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.notes import note
from psa_casadi.records.split import Experiment

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Patch:
    """An unnamed correction: its kind and port, what else it may be, evidence and predictions.

    `open_to` are other kinds and ports that explain the data
    as well; `predicted` [m] are whole records with it, `added` [m] its own part of them,
    `weights` [m] those of its terms, `moved` how far the model's own theta follows.
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
) -> Patch | None:
    """Return the best correction beside a model; None if none helps.

    Its evidence must be above the price of a cause, and the log-likelihood of the held-out samples,
    where the model errs by `holdout_rms` [m], must gain as much as for a cause.
    """
    samples = sum(int(e.held_out.sum()) for e in experiments) / colour.inflation

    def gained(c: Correction) -> float:
        return samples * float(np.log(holdout_rms / max(c.holdout_rms, 1e-300)))

    told = [c for c in found if c.evidence > thresholds().price]
    good = [c for c in told if not samples or gained(c) > thresholds().held_out]
    if not good:
        return None
    best = max(good, key=lambda c: c.evidence)
    near = thresholds().clearly * temperature(best.evidence)
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
