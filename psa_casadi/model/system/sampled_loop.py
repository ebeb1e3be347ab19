"""A sampled loop at the frequencies of a grid: the plant with held command, and the controller."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

#: A mode that is better damped needs no notch.
_DAMPED = 0.5


@dataclass(frozen=True)
class PlantResponse:
    """The response of a plant with held command at the frequencies of a grid, and its modes."""

    period: float
    frequencies: FloatArray
    response: ComplexArray
    modes: tuple[tuple[float, float], ...]

    @property
    def z(self) -> ComplexArray:
        """The grid on the unit circle."""
        points: ComplexArray = np.exp(2j * np.pi * self.frequencies * self.period)
        return points

    def resonance(self) -> tuple[float, float] | None:
        """Return frequency and damping of the mode that stands out most, or None."""
        weak = [m for m in self.modes if m[1] < _DAMPED]
        if not weak:
            return None
        size = np.abs(self.response)
        return max(weak, key=lambda m: float(np.interp(m[0], self.frequencies, size)))


def plant_response(plant: Model, position: str | None, period: float, lag: float) -> PlantResponse:
    """Return the exactly discretised response of the plant, linearised, behind a lag [s]."""
    A, B, C = _behind(lag, *_linearised(plant, position))
    if np.max(np.linalg.eigvals(A).real) > 1e-6 / period:
        raise InputError(
            f"The plant '{plant.name}' is unstable at its start; a controller is tuned for stable"
            " plants: check its parameters."
        )
    n = len(A)
    step = scipy.linalg.expm(period * np.block([[A, B], [np.zeros((1, n + 1))]]))
    modes = tuple(
        (float(abs(v) / (2.0 * np.pi)), float(-v.real / abs(v)))
        for v in np.linalg.eigvals(A)
        if v.imag > 0.0 and 1e-6 < abs(v) * period < 0.9 * np.pi
    )
    nyquist = 0.5 / period
    near = [f * np.linspace(0.7, 1.3, 601) for f, damping in modes if damping < _DAMPED]
    grid = np.unique(np.concatenate([np.geomspace(1e-5 * nyquist, nyquist, 3000), *near]))
    grid = grid[grid <= nyquist]
    values, vectors = np.linalg.eig(step[:n, :n])
    left, right = C @ vectors, np.linalg.solve(vectors, step[:n, n:])
    z = np.exp(2j * np.pi * grid * period)
    response = (left * right.ravel() / (z[:, None] - values)).sum(axis=1)
    if not abs(response[0]) > 0.0:
        raise InputError(
            f"The output of '{plant.name}' does not follow its input; check the wires."
        )
    return PlantResponse(period, grid, response, modes)


def _linearised(plant: Model, position: str | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A, B, C at the start, the states scaled by their usual sizes."""
    s = plant.structure
    row = plant.output_names.index(position) if position else 0
    start = [v.start for v in s.states], [v.start for v in s.inputs]
    found = s.slopes(0.0, *start, plant.parameter_vector())
    A, B, C, _ = (np.array(m, dtype=float) for m in found)
    size = plant.state_nominals()
    return A * size / size[:, None], B / size[:, None], C[[row]] * size


def _behind(
    lag: float, A: FloatArray, B: FloatArray, C: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the linear plant with its output behind a lag of first order."""
    n = len(A)
    slow = np.block([[A, np.zeros((n, 1))], [C / lag, np.array([[-1.0 / lag]])]])
    return slow, np.vstack([B, np.zeros((1, 1))]), np.append(np.zeros(n), 1.0)[None, :]


def notch_response(z: ComplexArray, period: float, frequency: float, floor: float, width: float
) -> ComplexArray:  # fmt: skip
    """Return the notch that `POSITION_CONTROLLER` has, on the unit circle."""
    t = np.tan(min(np.pi * frequency * period, 1.5))
    w = (z - 1.0) / (z + 1.0) / t
    ratio: ComplexArray = (w * w + 2.0 * floor * w + 1.0) / (w * w + 2.0 * width * w + 1.0)
    return np.where(np.abs(z + 1.0) < 1e-12, 1.0, ratio)


def controller_response(p: Mapping[str, float], z: ComplexArray) -> ComplexArray:
    """Return the controller's response without feed-forward on the unit circle [V/m]."""
    period = p["sample_time"]
    notch = notch_response(z, period, p["notch_frequency"], p["notch_floor"], p["notch_width"])
    integral = 0.5 * p["integral_gain"] * period * (z + 1.0) / (z - 1.0)
    loop: ComplexArray = notch * (p["proportional_gain"] + integral)
    return loop
