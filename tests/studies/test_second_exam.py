"""The second exam: its plants agree with its table."""

from pathlib import Path

import numpy as np
import pytest

from tests.studies.exam.marks import HYSTERESIS
from tests.studies.second_exam.cases import HALVES, TABLE, play, question, size_um, write
from tests.studies.second_exam.lab import FOREIGN, VOLTAGES
from tests.studies.second_exam.plants import SUB, simulate
from tests.tiers import slow_but

HIDDEN = [name for name in TABLE if question(name).group != "clean"]
CLEAN = [name for name in TABLE if question(name).group == "clean"]


def test_it_shares_no_code_with_what_it_examines() -> None:
    for path in (Path(__file__).parent / "second_exam").glob("*.py"):
        imported = [x for x in path.read_text("utf-8").split("\n") if x.startswith("from")]
        assert not any("psa_casadi" in line or "studies.plants" in line for line in imported)


def test_the_halves_have_the_same_number_of_each_group_and_name_what_exists() -> None:
    groups = [
        [question(name).group for name in TABLE if name[0] == letter] for letter in HALVES.values()
    ]
    assert len(TABLE) == 72
    assert sorted(groups[0]) == sorted(groups[1])
    assert {row["wave"][0] for row in TABLE.values()} == set(VOLTAGES)
    assert {row["extra"] for row in TABLE.values() if "extra" in row} == set(FOREIGN)
    of_group = {"clean": 0, "one": 1, "two": 2, "three": 3, "foreign": 1}
    for name in TABLE:
        requested = question(name)
        assert len(requested.accepted) in {of_group[requested.group], "hum" in name}


def test_a_seed_makes_a_record_and_another_one_another(tmp_path: Path) -> None:
    def written(seed: int) -> bytes:
        write("t_single_play", seed, tmp_path / "record.csv")
        return (tmp_path / "record.csv").read_bytes()

    assert written(1) == written(1) != written(2)


@pytest.mark.parametrize("name", slow_but(("t_single_quad", "r_foreign_brownout"), HIDDEN))
def test_what_is_hidden_is_larger_than_the_noise(name: str) -> None:
    assert size_um(name, 3) > 5.0 * TABLE[name]["noise_um"]


@pytest.mark.parametrize("name", slow_but(("t_clean_pink_stairs",), CLEAN))
def test_healthy_stacks_are_healthy_and_their_noise_is_as_large_as_said(name: str) -> None:
    p, statement = play(name, 3), TABLE[name]["noise_um"]
    assert not p.plant.hidden
    assert not question(name).other_hysteresis
    assert size_um(name, 3) < 1e-9
    spread = float(np.std(p.reading - p.clean))
    assert spread == pytest.approx(statement, rel={"outliers": 3.0}.get(name.split("_")[2], 0.35))


def test_hidden_forms_move_the_reading_as_said() -> None:
    """A gauge's sag by 1.5 %, a missing code of 0.22 um, no strain beyond where a stage ends."""
    sag = play("r_foreign_brownout", 3)
    step = 1 / TABLE["r_foreign_brownout"]["rate"]
    _, well = simulate(sag.plant, sag.voltage, step, np.random.default_rng(0))
    assert set(np.round(sag.clean[1:] / well[SUB::SUB], 9).tolist()) == {0.985, 1.0}
    jump = play("r_single_jump", 3)
    steps = np.abs(np.diff(jump.clean))
    assert np.max(steps) == pytest.approx(0.22, rel=0.3)
    assert np.median(steps) < 0.05
    clip = play("r_single_clip", 3)
    whole = np.quantile(clip.voltage, 0.999) - clip.plant.lo
    assert whole > 0.9 * (clip.plant.hi - clip.plant.lo)
    assert np.ptp(clip.clean) < 0.92 * clip.plant.stroke


def test_other_hysteresis_counts_neither_way_unless_it_is_what_is_hidden() -> None:
    for name in TABLE:
        requested = question(name)
        if requested.other_hysteresis and requested.group != "foreign":
            memory = [names for names in requested.accepted if names & HYSTERESIS]
            assert all("hysteresis_memory" in names for names in memory)
