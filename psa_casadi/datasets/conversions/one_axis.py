"""One axis of a device with several actuators, without what the others do to it.

The signals of every actuator are periodic and hold the same lines of the spectrum, and their phases
differ from experiment to experiment. So the linear response from every voltage to every
displacement follows at each line from all experiments together, Y = G U by least squares. What G
says that the other actuators do to the axis is taken off. What remains is the axis' answer to its
own voltage, the noise, and what is nonlinear, that of the other actuators too.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from psa_casadi.datasets.conversions.csv_text import csv_text

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

#: A line is excited whose mean amplitude is above this share of the largest one's.
_EXCITED = 0.01


@dataclass(frozen=True)
class OneAxis:
    """The voltage of one actuator and the displacement of its axis, in one experiment.

    The originals are arrays in NumPy's format, (samples of a period, axes, experiments, periods):
    voltages [V] and displacements [m] of the experiments that give the linear response, and the two
    of those from which the record is taken where these are others. All are counted from 0. `sign`
    is -1 where the displacement is measured against the actuator's direction.
    """

    axis: int
    sign: int
    experiment: int
    periods: int
    sample_rate: float

    @property
    def words(self) -> str:
        """What is taken, in words."""
        turned = ", its sign turned" if self.sign < 0 else ""
        periods = "the first period" if self.periods == 1 else f"the first {self.periods} periods"
        return (
            f"voltage {self.axis} and displacement {self.axis}{turned}, experiment"
            f" {self.experiment}, all counted from 0, {periods}; what the other actuators do by the"
            " linear response of the first two files is taken off"
        )

    def csv(self, originals: Sequence[bytes]) -> bytes:
        """Return the CSV file of the record."""
        arrays = [np.load(io.BytesIO(o), allow_pickle=False) for o in originals]
        response = linear_response(*arrays[:2])
        voltages, displacements = (a[:, :, self.experiment, : self.periods] for a in arrays[-2:])
        axis = own_part(response, voltages, displacements, self.axis)
        voltage = voltages[:, self.axis].T.reshape(-1)
        shown = self.sign * 1e6 * axis.T.reshape(-1)
        pairs = zip(voltage.tolist(), shown.tolist(), strict=True)
        return csv_text(pairs, self.sample_rate, 8)


def linear_response(voltages: FloatArray, displacements: FloatArray) -> ComplexArray:
    """Return the response (lines, displacements, voltages) [m/V], 0 at lines without excitation.

    Both arrays are (samples of a period, axes, experiments, periods).
    """
    u, y = (np.fft.rfft(a.mean(axis=3), axis=0) for a in (voltages, displacements))
    size = np.abs(u).mean(axis=(1, 2))
    excited = size > _EXCITED * size.max()
    u, y = u[excited], y[excited]
    across = u.conj().transpose(0, 2, 1)
    response = np.zeros((len(size), displacements.shape[1], voltages.shape[1]), dtype=complex)
    # G (U U*) = Y U*, solved from the right
    left = (u @ across).transpose(0, 2, 1)
    response[excited] = np.linalg.solve(left, (y @ across).transpose(0, 2, 1)).transpose(0, 2, 1)
    return response


def own_part(
    response: ComplexArray, voltages: FloatArray, displacements: FloatArray, axis: int
) -> FloatArray:
    """Return the displacement (samples, periods) of an axis without what other actuators do [m].

    `voltages` and `displacements` are (samples, axes, periods) of one experiment.
    """
    others = np.arange(voltages.shape[1]) != axis
    u = np.fft.rfft(voltages[:, others], axis=0)
    done = np.einsum("kj,kjp->kp", response[:, axis, others], u)
    own: FloatArray = displacements[:, axis] - np.fft.irfft(done, n=len(voltages), axis=0)
    return own
