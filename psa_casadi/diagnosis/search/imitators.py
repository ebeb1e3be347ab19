"""Effects that could stand in the best one's place, fitted from where that one has led."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.diagnosis.noise.colour import Colour
from psa_casadi.diagnosis.screening.probes import Direction
from psa_casadi.diagnosis.screening.screen import copies
from psa_casadi.diagnosis.search.extension import Extension, extend_like, stripped
from psa_casadi.diagnosis.task import Task
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.simulation.side_by_side import side_by_side

FloatArray = npt.NDArray[np.float64]

#: Evidence (in units of the log-likelihood) within which an effect is worth another look.
NEAR = 30.0
#: How many effects are fitted, at most.
IMITATORS = 3


def imitations(
    before: Fit,
    extensions: Sequence[Extension],
    trials: Sequence[Direction],
    colour: Colour,
    task: Task,
    number: int,
) -> list[Extension]:
    """Fit the effects that could copy what the best one adds, the base being free to follow.

    `extensions` of the fit `before` come best first, `trials` are directions there; `number` is the
    cause's. What the best one adds is taken where it has led the base: without it the base is bent
    to imitate it, so that hardly anything of it is left to copy. The trial directions hardly change
    on the way. A copy that leaves so little of the contribution's sum of squares D that
    D (1 - R^2)/2 is below `NEAR` might explain the data as well; a fit much worse than its copy was
    lost.
    """
    best = extensions[0]
    try:
        without = stripped(best, task.experiments)
        plain = without.predicted(task.experiments)
    except PsaError:
        return []
    pairs = zip(best.predicted, plain, task.experiments, strict=True)
    added = np.concatenate([(p - q)[e.used] for p, q, e in pairs])
    fitted = {e.effect.name: e for e in extensions}
    others = [d for d in trials if d.effect is not best.effect]
    power, found = copies(without, added, others, colour)
    left = {n: 0.5 * power * (1.0 - copy.share) for n, copy in found.items()}
    near = [n for n in left if n not in fitted and left[n] < NEAR]
    lost = [n for n in left if n in fitted and fitted[n].evidence < best.evidence - left[n] - NEAR]
    names = sorted([*near, *lost], key=lambda n: left[n])[:IMITATORS]
    if not names:
        return []
    said = ", ".join(names)
    task.progress(f"cause {number}: fitting {said}, which could look like {best.effect.name}")
    alike = side_by_side(
        lambda n: extend_like(before, best, task.experiments, found[n], colour), names
    )
    return [extension for extension in alike if extension is not None]
