"""The benchmark `mirror`: models of one axis of the steering mirror, by the score of its authors.

Their score of an output: rms of measured minus simulated over the standard deviation of what was
measured, without the first 100 samples, for each period of each test signal, and the mean of these.
A model of one axis says what its own actuator does; what the other two do is the linear response of
the training signals, so that both together predict the whole output.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

import psa_casadi as psa
from psa_casadi import datasets
from psa_casadi.datasets.devices import LEVELS, SIGNS, linear_response, own_part
from tests.studies.benchmarks.table import FloatArray, Outcome, Progress, TitledTable

#: Sampling rate; samples that the score leaves out; samples played before; error of a simulation.
RATE, SKIPPED, LEAD, RTOL = 6400.0, 100, 1000, 1e-4
#: What the authors' models reach at 100, 200 and 300 mV [%], and in which outputs: a linear one of
#: order 28 for each level, and one nonlinear one for all; of output 1 from the notebook of its fit.
_PUBLISHED = (
    ("the authors' 28 linear states, one model a level", "1 to 3", (8.38, 7.95, 5.63)),
    ("the authors' nonlinear model, one for all levels", "1 to 3", (6.37, 4.84, 4.19)),
    ("the authors' nonlinear model, one for all levels", "1", (5.61, 4.17, 3.50)),
)
_NOTE = (
    "Percent of the standard deviation of the whole output; rms error in um in brackets. Ours take"
    " what the other two actuators do from the linear response of the same level's training"
    " signals; the authors' simulate all three. The mean of a simulation is taken off, as the"
    " records have none."
)


def run(progress: Progress, quick: bool, folder: Path | None = None) -> Outcome:
    """Diagnose axis 1 at 100 mV and score its model; `quick` scores the linear response alone.

    Or score the models of a folder: axis_1_*.json, axis_2_*.json, axis_3_*.json.
    """
    if folder is not None:
        files = sorted(folder.glob("axis_[123]_*.json"))
        if not files:
            raise psa.InputError(
                f"{folder}: holds no model axis_1_*.json; `psa diagnose -o` writes one."
            )
        return _outcome([(f.name, int(f.name[5]) - 1, psa.load_model(f)) for f in files], progress)
    if quick:
        return _outcome([], progress)
    record = datasets.load("steering_mirror")[0]
    model = psa.diagnose([record], progress=progress).model
    return _outcome([("diagnosed at 100 mV", 0, model)], progress)


def scores(
    u: FloatArray,
    y: FloatArray,
    response: npt.NDArray[np.complex128],
    axis: int,
    model: psa.Model | None,
) -> tuple[float, float]:
    """Return the score of an axis [1] and the rms error [m].

    `u` and `y` are the arrays of the test signals, `response` that of the training signals; without
    a model the own actuator's part is linear, too.
    """
    shares, errors = [], []
    for signal in range(u.shape[2]):
        own = own_part(response, u[:, :, signal], y[:, :, signal], axis)
        if model is None:
            lines = response[:, axis, axis, None] * np.fft.rfft(u[:, axis, signal], axis=0)
            said = np.fft.irfft(lines, n=len(u), axis=0)
        else:
            said = SIGNS[axis] * settled(model, u[:, axis, signal])
        left = (own - said)[SKIPPED:]
        rms = np.sqrt(np.mean(left**2, axis=0))
        shares += (rms / np.std(y[SKIPPED:, axis, signal], axis=0)).tolist()
        errors += rms.tolist()
    return float(np.mean(shares)), float(np.mean(errors))


def settled(model: psa.Model, periods: FloatArray) -> FloatArray:
    """Return the displacement (samples, periods) without its mean [m].

    The end of the last period is played before, as the authors do, so that transients have died.
    """
    n, count = periods.shape
    v = np.concatenate([periods[-LEAD:, -1], periods.T.reshape(-1)])
    x = psa.simulate(model, np.arange(len(v)) / RATE, v, rtol=RTOL).displacement[LEAD:]
    shown: FloatArray = (x - np.mean(x)).reshape(count, n).T
    return shown


def _outcome(models: Sequence[tuple[str, int, psa.Model]], progress: Progress) -> Outcome:
    files = datasets.originals("steering_mirror_test")
    linear = "the linear response of the training signals, line by line"
    cases = [*models, *((linear, axis, None) for axis in range(3))]
    rows = [{"model": name, "output": f"{axis + 1}"} for name, axis, _ in cases]
    for level in LEVELS:
        u, y, test_u, test_y = (
            np.load(files[f"{s}_{level}mV_{part}.npy"], allow_pickle=False)
            for part in ("train", "test")
            for s in "uy"
        )
        response = linear_response(u, y)
        for row, (name, axis, model) in zip(rows, cases, strict=True):
            progress(f"{name}, output {axis + 1}, {level} mV")
            share, rms = scores(test_u, test_y, response, axis, model)
            row[f"{level} mV"] = f"{100 * share:.2f} ({1e6 * rms:.3f})"
    for name, outputs, of in _PUBLISHED:
        cells = (name, outputs, *(f"{x:.2f}" for x in of))
        rows.append(dict(zip(rows[0], cells, strict=True)))
    return Outcome((TitledTable("Steering mirror, test signals", rows, _NOTE),))
