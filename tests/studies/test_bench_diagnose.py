"""What the benchmark `diagnose` counts: on cases made up here, so that every figure can be told."""

import pytest

from tests.studies.benchmarks.diagnose import (
    RELIABILITY,
    Covered,
    in_class,
    intervals_table,
    result_tables,
)
from tests.studies.benchmarks.hidden_cases import Case, Found, Kind


def _found(kind: Kind, effect: str | None, named: dict[str, float], *, rho: float = 1.0) -> Found:
    """Return a case in which the most probable effect is named, nothing if there is none."""
    first = max(named, key=lambda name: named[name], default=None)
    return Found(
        case=Case(kind, effect, 1),
        rho=rho if effect else 0.0,
        verdict="cause_named" if first else "adequate",
        named=(first,) if first else (),
        within=(first,) if first else (),
        blind=(),
        confidence=named[first] if first else 0.0,
        probability=named,
        evidence={},
        ratio=1.0,
        seconds=1.0,
    )


FOUND = [
    _found("known", "slow_creep", {"slow_creep": 0.97, "offset_drift": 0.03}),
    _found("known", "slow_creep", {"slow_creep": 0.99}),
    _found("known", "offset_drift", {"slow_creep": 0.9, "offset_drift": 0.1}),
    _found("known", "offset_drift", {"slow_creep": 0.99}, rho=0.01),  # not as visible as asked for
    _found("left out", "slow_creep", {"offset_drift": 0.98}),
    _found("foreign", "dry_friction", {}),
    _found("clean", None, {}),
    _found("clean", None, {"slow_creep": 0.99}),
]


@pytest.mark.parametrize(
    ("figure", "reached"),
    [
        ("right name alone, rho 0.3 to 3", "67 % (2 of 3)"),
        ("a single wrong name, rho 0.3 to 3", "33 % (1 of 3)"),
        ("clean, white noise: a cause named", "50 % (1 of 2)"),
        ("own entry left out: not named alone", "0 % (0 of 1)"),
        ("foreign plants: not named alone", "100 % (1 of 1)"),
    ],
)
def test_shares_are_of_the_cases_as_visible_as_asked_for(figure: str, reached: str) -> None:
    summary = result_tables(FOUND)[0]
    assert [row[2] for row in summary.table.rows if row[0] == figure] == [reached]


def test_a_probability_is_held_against_how_often_the_effect_is_the_cause() -> None:
    inside, every = RELIABILITY
    assert in_class(FOUND, inside, 0.95, 1.0) == [(0.97, True), (0.99, True)]
    assert in_class(FOUND, inside, 0.02, 0.2) == [(0.03, False), (0.1, True)]
    assert in_class(FOUND, every, 0.95, 1.0) == [(0.97, True), (0.99, True), (0.98, False)]
    rows = {row[0]: row[1:] for row in result_tables(FOUND)[2].table.rows}
    assert rows["80 to 95 %"] == ("90 %", "0 %", "1", "90 %", "0 %", "1")
    assert rows["95 to 100 %"] == ("98 %", "100 %", "2", "98 %", "67 %", "3")


def test_an_interval_of_the_gain_is_held_against_the_records_it_does_not_know() -> None:
    found = [
        Covered("slow_creep", 50.0, (40.0, 45.0), ((45.0, 55.0), (51.0, 60.0)), (50.0, 50.5)),
        Covered("ageing", 30.0, (10.0, 60.0), ((25.0, 35.0), (20.0, 31.0)), (30.0, 30.0)),
    ]
    blocks, records = intervals_table(found).table.rows
    assert blocks[1:] == ("50 % (1 of 2)", "27.5 %")
    assert records[1:] == ("75 % (3 of 4)", "10.0 %")
