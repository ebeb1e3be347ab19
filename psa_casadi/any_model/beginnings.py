"""Where experiments begin that are held out whole, of which no fit sees a sample."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.predict import output_of
from psa_casadi.any_model.runs import Run
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.levenberg_marquardt import minimise
from psa_casadi.identification.fitting.unknowns import Unknowns
from psa_casadi.model.compose import Model
from psa_casadi.simulation.side_by_side import side_by_side

FloatArray = npt.NDArray[np.float64]

#: How far the start is sought in the first tenth.
_EVALUATIONS, _TOLERANCE = 30, 1e-5


def begun(
    model: Model,
    runs: Sequence[Run],
    unknowns: Unknowns,
    theta: FloatArray,
    places: Sequence[int],
    levels: Sequence[float],
    rtol: float,
) -> FloatArray:
    """Return theta with initial states and zeros of held-out experiments, from their first tenth.

    `places` are the outputs that count, each by its level. Where a start cannot be simulated it
    stays as it is.
    """
    found = theta.copy()
    judging = [k for k, r in enumerate(runs) if r.held_out_whole]

    def one(k: int) -> FloatArray:
        first, run = unknowns.first(k), runs[k].of_beginning()
        own = slice(first, unknowns.first(k + 1))
        prior = 1.0 / unknowns.prior[own]
        weights = [(j, run.fitted(j), level * run.noise[j])
                   for j, level in zip(places, levels, strict=True)]  # fmt: skip

        def evaluate(start: FloatArray) -> tuple[FloatArray, FloatArray] | None:
            there = theta.copy()
            there[own] = start
            rows, slopes = [start * prior], [np.diag(prior)]
            for j, used, size in weights:
                if not used.any():
                    continue
                try:
                    shown, by_theta = output_of(model, run, unknowns, there, k, j, rtol)
                except PsaError:
                    return None
                cut = used[: run.stop]
                rows.append((shown[cut] - run.outputs[used, j]) / size)
                slopes.append(by_theta[cut, own] / size)
            return np.concatenate(rows), np.vstack(slopes)

        free = np.full(own.stop - own.start, np.inf)
        best = minimise(
            evaluate, theta[own], (-free, free), tolerance=_TOLERANCE, evaluations=_EVALUATIONS
        )
        return theta[own] if best is None else best.theta

    for k, start in zip(judging, side_by_side(one, judging), strict=True):
        found[unknowns.first(k) : unknowns.first(k + 1)] = start
    return found
