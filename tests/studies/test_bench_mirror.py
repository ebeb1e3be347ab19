"""The benchmark `mirror`: its score is that of the authors, and a model is simulated settled."""

from pathlib import Path

import numpy as np
import pytest

from psa_casadi.datasets.devices import linear_response
from psa_casadi.errors import InputError
from psa_casadi.model.stacks import stack_model
from tests.datasets.test_datasets_one_axis import N as PERIOD
from tests.datasets.test_datasets_one_axis import driven, voltages
from tests.studies.benchmarks.mirror import RATE, SKIPPED, run_on, scores, settled


def test_an_exact_response_scores_nothing_and_noise_scores_its_share() -> None:
    train, test = (np.tile(voltages(seed, k), (4, 1, 1, 1)) for seed, k in ((1, 6), (2, 3)))
    y = driven(test)
    response = linear_response(train, driven(train))
    assert len(y) == 4 * PERIOD > SKIPPED
    assert scores(test, y, response, 0, None)[0] < 1e-9
    rng = np.random.default_rng(4)
    noisy = y + 1e-8 * rng.standard_normal(y.shape)
    share, rms = scores(test, noisy, response, 1, None)
    assert rms == pytest.approx(1e-8, rel=0.05)
    assert share == pytest.approx(1e-8 / np.std(y[:, 1]), rel=0.1)


def test_a_settled_model_repeats_itself_and_has_no_mean() -> None:
    model = stack_model("P-885.51")
    one = 20.0 * np.sin(2 * np.pi * np.arange(2000) / 500.0)
    shown = settled(model, np.column_stack([one, one]))
    assert shown.shape == (2000, 2)
    np.testing.assert_allclose(shown[:, 0], shown[:, 1], atol=2e-3 * np.ptp(shown))
    assert abs(np.mean(shown)) < 1e-6 * np.ptp(shown)
    assert np.ptp(shown) > 1e-7
    assert RATE == 6400.0


def test_a_folder_without_models_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no model axis_1_"):
        run_on(lambda _: None, tmp_path)
