"""Filters of sampled signals, without the second that it takes to import `scipy.signal`."""

from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from psa_casadi.units import FloatArray


def filtered(
    upper: Sequence[float] | FloatArray, lower: Sequence[float] | FloatArray, x: FloatArray
) -> FloatArray:
    """Return the response of upper(z)/lower(z), from rest, to x (n,) or its columns (n, k).

    Both hold the coefficients of z^0, z^-1 ...; the first one of `lower` is 1.
    """
    found = upper[0] * x
    for k, weight in enumerate(upper[1 : len(x)], 1):
        found[k:] += weight * x[:-k]
    if len(lower) == 1 or not x.size:
        return found
    bands = np.repeat(np.asarray(lower, dtype=float)[: len(x), None], len(x), axis=1)
    solved = scipy.linalg.lapack.dtbtrs(bands, found.reshape(len(x), -1), uplo="L")[0]
    recursive: FloatArray = solved.reshape(x.shape)
    return recursive


def convolved(x: FloatArray, kernel: FloatArray) -> FloatArray:
    """Return the columns x (n, k) convolved with a symmetric kernel (2 m + 1,), centred."""
    n, reach = len(x), len(kernel) // 2
    size = scipy.fft.next_fast_len(n + len(kernel) - 1, real=True)
    spectrum = scipy.fft.rfft(x, size, axis=0) * scipy.fft.rfft(kernel, size)[:, None]
    whole: FloatArray = scipy.fft.irfft(spectrum, size, axis=0)[reach : reach + n]
    return whole


def without_line(parts: FloatArray) -> FloatArray:
    """Return rows (k, n) less the straight line that fits each best."""
    t = np.linspace(-1.0, 1.0, parts.shape[1])
    flat = parts - np.mean(parts, axis=1, keepdims=True)
    rest: FloatArray = flat - np.outer(flat @ t / (t @ t), t)
    return rest


def peaks(values: FloatArray, apart: int, most: int) -> NDArray[np.int64]:
    """Return the places of the highest local maxima, at least `apart` samples apart, in order."""
    inner = values[1:-1]
    places = np.flatnonzero((inner > values[:-2]) & (inner >= values[2:])) + 1
    chosen: list[int] = []
    for k in places[np.argsort(-values[places], kind="stable")].tolist():
        if len(chosen) == most:
            break
        if all(abs(k - other) >= apart for other in chosen):
            chosen.append(k)
    return np.array(chosen, dtype=np.int64)
