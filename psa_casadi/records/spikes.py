"""Spikes in a motion of any speed: what its neighbours and the inputs do not interpolate.

A sample of a sampled motion is nearly a fixed linear function of its neighbours and of the inputs
around it; its coefficients are fitted to the record. A spike of size a at sample m adds a to the
residual there and -a times the coefficients beside it; of each group of large residuals the few
spikes are sought, one by one, that leave nothing of it (orthogonal matching pursuit). What an
input's jump leaves of the residual is usual behind jumps, and no spike.

Source: Pati, Rezaiifar and Krishnaprasad, "Orthogonal matching pursuit", Asilomar 1993.
"""

import numpy as np
import scipy

from psa_casadi.records.noise import local_scale, runs_of
from psa_casadi.units import BoolArray, FloatArray

#: Neighbours on each side of which a sample is a function, and instants of the inputs around it.
_REACH, _INPUTS = 4, 1
#: Rounds in which the function is fitted without what it does not explain; rows for each
#: coefficient, and standard deviations that are left out of the fit.
_ROUNDS, _ROWS, _UNUSUAL = 8, 20, 4.0
#: Times the usual move of an input that make a jump, samples after it that may belong to it, and
#: times the usual residual of a jump that a spike among them must exceed.
_JUMP, _AFTER, _OF_JUMPS = 10.0, 16, 8.0
#: What spikes may leave of the residual around them, over the largest: a kink leaves more.
_LEFT = 0.1


def spikes_in(
    y: FloatArray, inputs: FloatArray, limit: float, smallest: float, longest: int
) -> BoolArray:
    """Return which samples of an output (n,), nan where there is none, are spikes.

    `inputs` (n, nu) are known throughout. A spike has at most `longest` samples and stands out by
    `limit` standard deviations of the residual around it and by `smallest`, in the output's unit.
    """
    mask = np.zeros(y.size, dtype=np.bool_)
    if np.isfinite(y).sum() < _ROWS:
        return mask
    moving = inputs[:, np.ptp(inputs, axis=0) > 0.0]
    sides = [j for j in range(-_REACH, _REACH + 1) if j]
    near = [y, *(moving[:, k] for k in range(moving.shape[1]))]
    near = [(s - np.nanmean(s)) / (np.nanstd(s) or 1.0) for s in near]
    columns = [np.roll(near[0], -j) for j in sides]
    columns += [np.roll(u, -j) for u in near[1:] for j in range(-_INPUTS, _INPUTS + 1)]
    table = np.column_stack([*columns, np.ones(y.size)])
    good = np.isfinite(table).all(axis=1) & np.isfinite(y)
    good[:_REACH] = good[-_REACH:] = False
    used, unit = good, float(np.nanstd(y)) or 1.0
    moves = np.abs(np.diff(moving, axis=0, prepend=moving[:1]))
    sudden = np.any(moves > _JUMP * np.median(moves, axis=0), axis=1)
    jumps = scipy.ndimage.maximum_filter1d(
        np.asarray(sudden, dtype=np.bool_), _REACH + _AFTER + 1, origin=(_AFTER - _REACH) // 2
    )
    for _ in range(_ROUNDS):
        if used.sum() < _ROWS * table.shape[1]:
            return mask
        weights = np.linalg.lstsq(table[used], near[0][used], rcond=1e-10)[0]
        left = np.where(good, near[0] - np.where(good[:, None], table, 0.0) @ weights, 0.0)
        size = np.abs(left)
        usual = np.full(y.size, 1.4826 * float(np.median(size[good])))
        if (good & jumps).any():
            usual[jumps] = max(usual[0], 1.4826 * float(np.median(size[good & jumps])))
        peak = (size > _UNUSUAL * usual) & (
            size >= scipy.ndimage.maximum_filter1d(size, 2 * _REACH + 1)
        )
        before, used = used, good & ~_grown(peak)
        if np.array_equal(before, used):
            break
    places = np.flatnonzero(used)
    scale = np.interp(np.arange(y.size), places, local_scale(size[used]))
    allowed = np.maximum(limit * scale, smallest / unit)
    if peaks := [float(np.max(size[start:stop])) for start, stop in runs_of(jumps)]:
        allowed[jumps] = np.maximum(allowed[jumps], _OF_JUMPS * np.median(peaks))
    pattern = np.ones(2 * _REACH + 1)
    pattern[[_REACH - j for j in sides]] = -weights[: len(sides)]
    for start, stop in runs_of(_grown(good & (size > allowed))):
        place = _pursued(left[start:stop], pattern, allowed[start:stop], limit, longest)
        mask[start + np.array(place, dtype=np.intp)] = True
    for start, stop in runs_of(mask):
        if stop - start > longest:
            mask[start:stop] = False
    return mask


def _grown(mask: BoolArray) -> BoolArray:
    return scipy.ndimage.maximum_filter1d(mask, 2 * _REACH + 1)


def _pursued(
    left: FloatArray, pattern: FloatArray, allowed: FloatArray, limit: float, longest: int
) -> list[int]:
    """Return the places of the fewest spikes that explain a residual (m,); none where none do.

    They are added one by one; else it is one spike of several samples that leaves only noise.
    """
    n = left.size
    each = np.array([np.convolve(np.eye(n)[k], pattern, mode="same") for k in range(n)]).T
    sizes = np.linalg.norm(each, axis=0)

    def tried(places: list[int], share: float) -> tuple[bool, FloatArray]:
        result = np.linalg.lstsq(each[:, places], left, rcond=None)[0]
        rest = left - each[:, places] @ result
        most = np.maximum(_UNUSUAL * allowed / limit, share * float(np.max(np.abs(result))))
        large = bool(np.all(np.abs(result) > allowed[places]))
        return large and bool(np.all(np.abs(rest) <= most)), rest

    places, rest = list[int](), left
    while len(places) <= n // _REACH:
        places.append(int(np.argmax(np.abs(each.T @ rest) / sizes)))
        is_all, rest = tried(places, _LEFT)
        if is_all:
            return places
    runs = [[*range(k, k + m)] for m in range(2, longest + 1) for k in range(n - m + 1)]
    return next((run for run in runs if tried(run, 0.0)[0]), [])
