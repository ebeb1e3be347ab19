"""One axis of several: what the other actuators do is taken off, and nothing else."""

import hashlib
import io

import numpy as np
import pytest

from build_scripts.measured_data import measured_data_directory
from psa_casadi.common.units import FloatArray
from psa_casadi.datasets import DATASETS
from psa_casadi.datasets.devices import OneAxis, linear_response

#: Folder of the originals of the steering mirror, which may not exist.
ORIGINALS = measured_data_directory() / "steering_mirror_test"
N, AXES, PERIODS, RATE = 64, 3, 2, 6400.0
#: Rows of the impulse responses from each voltage to each displacement [m/V], at delays 0, 1, 2.
IMPULSE = 1e-6 * np.random.default_rng(7).normal(size=(AXES, AXES, 3))


def voltages(seed: int, experiments: int) -> FloatArray:
    """Periodic random-phase signals (N, AXES, experiments, PERIODS) of lines 1 to N/2 - 2."""
    rng = np.random.default_rng(seed)
    lines = np.zeros((N // 2 + 1, AXES, experiments), dtype=complex)
    lines[1:-1] = np.exp(2j * np.pi * rng.uniform(size=(N // 2 - 1, AXES, experiments)))
    one = np.fft.irfft(lines, n=N, axis=0)
    return np.repeat(one[..., None], PERIODS, axis=-1)


def driven(u: FloatArray, only: int | None = None) -> FloatArray:
    """Displacements in steady state of all actuators, or of one of them."""
    y = np.zeros_like(u)
    for j in range(AXES) if only is None else [only]:
        for delay in range(3):
            y += IMPULSE[:, j, delay][:, None, None] * np.roll(u[:, [j]], delay, axis=0)
    return y


def saved(array: FloatArray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def columns(csv: bytes) -> FloatArray:
    head, *rows = csv.decode().splitlines()
    assert head == "time [s],voltage [V],displacement [um]"
    return np.array([[float(cell) for cell in row.split(",")] for row in rows])


def test_the_linear_response_is_found() -> None:
    u = voltages(1, 6)
    displayed = linear_response(u, driven(u))
    truth = np.fft.rfft(IMPULSE, n=N, axis=2).transpose(2, 0, 1)
    truth[[0, -1]] = 0.0  # no voltage there
    np.testing.assert_allclose(displayed, truth, atol=1e-12 * 1e-6)


@pytest.mark.parametrize("axis", range(AXES))
def test_what_is_left_is_the_answer_to_the_own_voltage(axis: int) -> None:
    u = voltages(1, 6)
    t, v, x = columns(OneAxis(axis, -1, 2, 1, RATE).csv([saved(u), saved(driven(u))])).T
    np.testing.assert_allclose(t, np.arange(N) / RATE, atol=5e-9)
    np.testing.assert_allclose(v, u[:, axis, 2, 0], atol=6e-7)
    np.testing.assert_allclose(-x, 1e6 * driven(u, axis)[:, axis, 2, 0], atol=6e-5)


@pytest.mark.parametrize("axis", range(AXES))
def test_a_bend_of_the_own_answer_stays(axis: int) -> None:
    u = voltages(1, 6)
    y, item = driven(u), driven(u, axis)[:, axis]
    bend = 0.3e-6 * (item / 1e-6) ** 3
    y[:, axis] += bend
    x = columns(OneAxis(axis, 1, 2, 1, RATE).csv([saved(u), saved(y)]))[:, 2]
    lost = x - 1e6 * (item + bend)[:, 2, 0]
    # of six experiments the two other voltages can explain a third of what is no linear answer
    assert np.std(lost) < 0.6e6 * np.std(bend[:, 2, 0])


def test_a_test_signal_is_judged_by_the_response_of_the_training_signals() -> None:
    train, test = voltages(1, 6), voltages(2, 3)
    arrays = (train, driven(train), test, driven(test))
    t, v, x = columns(OneAxis(1, 1, 2, 2, RATE).csv([*map(saved, arrays)])).T
    assert len(t) == 2 * N
    np.testing.assert_allclose(v, np.tile(test[:, 1, 2, 0], 2), atol=6e-7)
    item = 1e6 * driven(test, 1)[:, 1, 2]
    np.testing.assert_allclose(x, item.T.reshape(-1), atol=6e-5)


@pytest.mark.slow
@pytest.mark.skipif(not any(ORIGINALS.glob("*.npy")), reason=f"no originals in {ORIGINALS}")
def test_the_published_arrays_give_the_stated_bytes() -> None:
    for name in ("steering_mirror", "steering_mirror_test"):
        for file in DATASETS[name].files:
            content = [(ORIGINALS / o.name).read_bytes() for o in file.originals]
            for original, what in zip(file.originals, content, strict=True):
                assert hashlib.sha256(what).hexdigest() == original.sha256
            assert hashlib.sha256(file.conversion.csv(content)).hexdigest() == file.sha256
