"""Where held-out samples cannot confirm a cause, none is named, and the sentence states why."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import sawtooth

from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.held_out import Gain, coverage_notes, unconfirmed
from psa_casadi.diagnosis.task import LIMITS
from psa_casadi.identification.start.doubts import doubtful_quantity
from psa_casadi.model.effects import EFFECTS
from psa_casadi.records.record import Record
from psa_casadi.records.split import Experiment, whole
from psa_casadi.records.suspects import suspects
from psa_casadi.report.words.text import story
from tests.studies.plants.base import simulate_base
from tests.studies.plants.stack import draw_stack
from tests.tiers import slow


@pytest.fixture(scope="module")
def triangle() -> Record:
    """A record of triangles without a hidden effect, 29 um at 60 V."""
    rng = np.random.default_rng(3)
    stack, time = draw_stack(rng), np.arange(1200) / 200.0
    voltage = np.round(0.95 * stack.u_rated * (0.5 + 0.5 * sawtooth(2 * np.pi * time, 0.5)), 3)
    y = simulate_base(stack, time, voltage).displacement
    noise = 2e-4 * np.ptp(y) * rng.standard_normal(y.size)
    return Record(name="r", time=time, voltage=voltage, displacement=y + noise)


def shown_up_to(record: Record, share: float) -> Record:
    """Return the record of a sensor that is saturated above a share of its range."""
    y = record.displacement
    assert y is not None
    return replace(record, displacement=np.minimum(y, y.min() + share * np.ptp(y)))


@slow
@pytest.mark.parametrize(
    ("share", "effect", "told"),
    [
        (0.12, "self_heating", "only 4 of the readings that count are held out, and no model"),
        pytest.param(
            0.15,
            "hysteresis_memory",
            "the sensor is saturated in 94 % of the readings",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_record_that_hides_nearly_all_names_no_cause(
    share: float, effect: str, told: str, triangle: Record
) -> None:
    result = diagnose([shown_up_to(triangle, share)], effects=[EFFECTS[effect]])
    assert result.causes == ()
    assert told in result.doubt
    assert result.doubt in " ".join(story(result).split())


@pytest.mark.parametrize("share", [0.12, 0.15, 0.2, 0.5])
def test_an_end_is_told_however_little_is_shown_below_it(share: float, triangle: Record) -> None:
    record = shown_up_to(triangle, share)
    y = record.displacement
    assert y is not None
    (end,) = suspects(record).ends
    np.testing.assert_array_equal(end.where, y == y.max())


def test_a_window_of_the_motion_is_no_integral(triangle: Record) -> None:
    """Within it, the voltage of rises is higher than that of falls: it follows the rate."""
    y = triangle.displacement
    assert y is not None
    observed = np.abs(y - y.min() - 0.5 * np.ptp(y)) < 0.03 * np.ptp(y)
    assert not doubtful_quantity([replace(triangle, displacement=np.where(observed, y, np.nan))])


def held(record: Record, count: int) -> tuple[Experiment, ...]:
    e = whole(record)
    last = np.arange(record.n) >= record.n - count
    return (replace(e, used=e.used & ~last, held_out=e.used & last),)


@pytest.mark.parametrize(
    ("count", "interval", "lost", "partly", "hidden", "told"),
    [
        (15, (50.0, 60.0), -9.0, False, 0.0, "only 15 of the readings that count"),
        (16, (50.0, 60.0), -9.0, False, 0.51, "saturated in 51 % of the readings"),
        (16, (-101.0, 98.0), 1.1, False, 0.0, "gain, -101 to 98 %, reaches from an error that"),
        (16, (-101.0, 98.0), 0.9, False, 0.0, ""),
        (16, (-101.0, 97.0), 1.1, False, 0.0, ""),
        (16, (-99.0, 98.0), 1.1, True, 0.5, ""),
    ],
)
def test_what_held_out_samples_confirm(
    count: int,
    interval: tuple[float, float],
    lost: float,
    partly: bool,
    hidden: float,
    told: str,
    triangle: Record,
) -> None:
    experiments = held(triangle, count)
    gain = Gain(40.0, interval)
    note = unconfirmed(
        experiments, gain, whole=97.5, lost=lost, partly=partly, hidden=hidden, limits=LIMITS
    )
    assert told in str(note)
    assert (note is not None) == bool(told)
    few = [n for n in coverage_notes(experiments) if n.code == "held_out_says_little"]
    assert len(few) == (count < 16)
