"""The noise levels that weight the outputs and the experiments of a fit."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from psa_casadi.any_model.fit import OdeFit, measured_outputs, refitted
from psa_casadi.any_model.predict import shown_by
from psa_casadi.any_model.runs import Run, noise_share
from psa_casadi.diagnosis.colour import Colour, noise_rms, uncertain
from psa_casadi.records.quality.noise import first_order_noise

FloatArray = npt.NDArray[np.float64]

#: Noise is estimated from so many samples or more, and differs from so many standard errors on.
_TELLING, _SURE = 32, 3.0


def first_levels(runs: Sequence[Run]) -> tuple[float, ...]:
    """Return levels to begin with: a tenth of every measured output's standard deviation."""
    places = measured_outputs(runs)
    every = np.vstack([np.where(r.used[:, None], r.outputs, np.nan) for r in runs])
    return tuple(0.1 * float(np.nanstd(every[:, j])) for j in places)


def relevelled(fit: OdeFit, runs: Sequence[Run], rounds: int = 4) -> OdeFit:
    """Fit again with every output's residual as its noise level, until that stays the same."""
    for _ in range(rounds if len(fit.outputs) > 1 else 1):
        levels = tuple(max(o.rms, o.straight, 1e-300) for o in fit.outputs)
        change = np.max(np.abs(np.log(np.array(levels) / np.array(fit.levels))))
        if change < 0.02 or fit.interrupted:
            break
        fit = refitted(fit, runs, levels=levels)
    return fit


def with_noise(fit: OdeFit, runs: Sequence[Run]) -> tuple[Run, ...]:
    """Return the experiments with their shares of the noise, as the fast parts of residuals tell.

    Of every output, over the usual one of all experiments (the geometric mean by samples). A share
    that cannot be told from 1 is 1. Of an experiment that is held out whole, its beginning tells.
    """
    shares = [r.noise.copy() for r in runs]
    beginnings = _beginnings(fit, runs)
    for o in fit.outputs:
        fitted = zip(o.runs, o.parts, strict=True)
        begun = ((k, _at(r, e, o.index)) for k, r, e in beginnings)
        found = [(k, p) for k, p in (*fitted, *begun) if len(p) >= _TELLING]
        if len(found) < 2:
            continue
        noise = [max(first_order_noise(p)[0], o.straight, 1e-300) for _, p in found]
        over = np.log(noise) - np.average(np.log(noise), weights=[len(p) for _, p in found])
        for (k, part), own in zip(found, over, strict=True):
            if abs(own) > 0.5 * _SURE * uncertain(part):  # half of the power's error is the rms's
                shares[k][o.index] *= float(np.exp(own))
    return tuple(replace(r, noise=share) for r, share in zip(runs, shares, strict=True))


def _beginnings(fit: OdeFit, runs: Sequence[Run]) -> list[tuple[int, Run, FloatArray]]:
    """Return the held-out experiments' beginnings, with measured minus predicted over the noise."""
    found = []
    for k, run in enumerate(runs):
        if run.held_out_whole:
            begun = run.of_beginning()
            shown = shown_by(fit.model, begun, fit.starts()[k], begun.stop, fit.rtol, fit.zeros)
            found.append((k, begun, (run.outputs[: begun.stop] - shown) / run.noise))
    return found


def _at(run: Run, errors: FloatArray, output: int) -> FloatArray:
    """Return the errors of an output where it was measured."""
    found: FloatArray = errors[run.fitted(output)[: run.stop], output]
    return found


def unlike(runs: Sequence[Run], others: Sequence[Run]) -> bool:
    """Whether the shares of the noise differ."""
    return any(np.any(a.noise != b.noise) for a, b in zip(runs, others, strict=True))


def reweighted(fit: OdeFit, runs: Sequence[Run]) -> OdeFit:
    """Fit again with other shares of the noise."""
    return relevelled(refitted(fit, runs, evaluations=100), runs)


def noise_left(fit: OdeFit, colour: Colour) -> list[float]:
    """Return the noise in every output's residual, over the shares that weighted it."""
    rows = zip(fit.outputs, colour.each, strict=True)
    return [noise_rms(o.residuals, own) for o, own in rows]


def noise_told(
    fit: OdeFit, colour: Colour, runs: Sequence[Run]
) -> tuple[tuple[Run, ...], tuple[float, ...]]:
    """Return the experiments and every output's noise over them, in its unit, as a fit leaves it.

    What a search has weighted by is from the base's residual, which holds more than noise.
    """
    told, levels = with_noise(fit, runs), []
    for o, own in zip(fit.outputs, colour.each, strict=True):
        j = o.index
        rows = zip(o.runs, o.parts, strict=True)
        left = np.concatenate([p * (runs[k].noise[j] / told[k].noise[j]) for k, p in rows])
        levels.append(noise_rms(left, own) * noise_share(told, j))
    return told, tuple(levels)
