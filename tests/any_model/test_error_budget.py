"""The error budget of any model: shares and intervals against draws whose shares are known."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import binom

from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.held_out import Removed, Share
from psa_casadi.records.signals import Signals
from psa_casadi.records.split import Channel, Experiment

#: Noise of two outputs, each in its unit, and what each of two causes adds to them.
NOISE = np.array([2e-6, 0.3])
ONE, OTHER = NOISE * [2.0, 3.0], NOISE * [1.0, 4.0]
#: Of all that is above the noise (4 + 9 + 1 + 16), what the first cause makes.
SHARE = 13.0 / 30.0
SAMPLES, DRAWS = 240, 150


CHANNELS = tuple(Channel(n, "1", (n,), offset=False, factors=False) for n in "yz")


def _signals(outputs: FloatArray) -> Any:
    columns = dict(zip("yz", outputs.T, strict=True))
    return Signals(name="run", time=np.arange(SAMPLES, dtype=np.float64), columns=columns)


def _drawn(
    rng: np.random.Generator, records: int
) -> tuple[list[Experiment], list[FloatArray], list[FloatArray]]:
    """Return runs of two outputs with noise, and what either cause adds along each."""
    runs, one, other = [], [], []
    for k in range(records):
        time: FloatArray = np.arange(SAMPLES, dtype=np.float64)
        outputs = NOISE * rng.standard_normal((SAMPLES, 2))
        outputs[rng.random(SAMPLES) < 0.3, 1] = np.nan  # the second sensor is slower
        held = time % 4 == 3 if records < 4 else np.full(SAMPLES, k > 0)
        runs.append(Experiment(_signals(outputs), ~held, held, CHANNELS))
        one.append(ONE * rng.standard_normal((SAMPLES, 2)))
        other.append(OTHER * rng.standard_normal((SAMPLES, 2)))
    return runs, one, other


@dataclass(frozen=True)
class _Drawn:
    first: Share
    other: Share
    together: Share


def _shares(rng: np.random.Generator, records: int) -> _Drawn:
    runs, one, other = _drawn(rng, records)
    none = [np.zeros((SAMPLES, 2)) for _ in runs]
    both = [a + b for a, b in zip(one, other, strict=True)]
    removed = Removed(runs, both, NOISE.tolist())
    return _Drawn(
        removed.share("first", one, none),
        removed.share("other", other, none),
        removed.share("together", both, none),
    )


def _covered(shares: Sequence[Share], truth: float) -> int:
    return sum(s.interval[0] <= truth <= s.interval[1] for s in shares)


@pytest.mark.parametrize("records", [1, 7])  # blocks of one, and six that are held out whole
def test_intervals_cover_the_known_shares(records: int) -> None:
    rng = np.random.default_rng(29)
    items = [_shares(rng, records) for _ in range(DRAWS)]
    low, high = binom.interval(0.999, DRAWS, 0.95)
    for shares, truth in (
        ([f.first for f in items], SHARE),
        ([f.other for f in items], 1.0 - SHARE),
        ([f.together for f in items], 1.0),
    ):
        centres = np.array([s.share for s in shares])
        assert np.mean(centres) == pytest.approx(truth, abs=4.0 * np.std(centres) / DRAWS**0.5)
        assert low <= _covered(shares, truth) <= high


def test_a_share_is_displayed_from_0_to_1_and_without_noise_it_is_that_of_the_power() -> None:
    assert Share("worse", -0.2, (-0.5, 0.1)).clipped == (0.0, 0.0, 0.1)
    assert Share("all", 1.01, (0.9, 1.2)).clipped == (1.0, 0.9, 1.0)
    assert Share("half", 0.5, (0.4, 0.62)).text == "50 % (40 to 62 %)"
    assert Share("all", 0.9995, (0.9992, 0.9999)).text == "99.95 % (99.92 to 99.99 %)"
    assert Share("most", 0.996, (0.98, 1.01)).text == "99.6 % (98.0 to 100.0 %)"
    assert Share("nothing", 0.0004, (0.0, 0.005)).percents == ("under 0.1", "0.0", "0.5")
    assert Share("little", 0.004, (0.0, 0.02)).text == "under 1 % (0 to 2 %)"
    runs, one, _ = _drawn(np.random.default_rng(2), 1)
    (run,) = runs
    quiet = [replace(run, record=_signals(np.zeros((SAMPLES, 2))))]
    left = Removed(quiet, one, (0.0, 0.0)).share("half", one, [0.5 * one[0]])
    assert left.share == pytest.approx(0.75, rel=1e-9)
    still = Removed(quiet, [0.0 * one[0]], (0.0, 0.0)).share("none", one, one)
    assert (still.share, still.interval) == (0.0, (0.0, 0.0))
