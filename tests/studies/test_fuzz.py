"""Damaged inputs, kills and hostile surroundings: short runs; the long one is a benchmark.

`python -m tests.studies fuzz --help` lists the options of longer runs.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from psa_casadi.common.errors import InputError
from psa_casadi.common.units import parse_unit
from psa_casadi.records import read_record
from tests.tiers import slow

if not hasattr(os, "fork"):
    pytest.skip("the inputs are attacked in forked processes", allow_module_level=True)

from tests.studies.benchmarks.fuzz import TARGETS, app, tables
from tests.studies.fuzz import campaign, readers
from tests.studies.fuzz.campaign import Finding, Tally, Target, generator, replay, run
from tests.studies.fuzz.damage import damaged_bytes, damaged_json, damaged_table

#: Inputs of each target in the quick tier, and in the full one.
QUICK = {"records-csv": 500, "column-maps": 300, "paths": 200, "models": 200}
FULL = {
    "records-csv": 1500, "records-mat": 80, "records-parquet": 40, "records-xlsx": 40,
    "records-tdms": 40, "records-h5": 20, "records-npz": 40, "records-npy": 40, "records-lvm": 200,
    "records-dat": 200, "column-maps": 800, "units": 1000, "models": 400, "paths": 500,
    "checks": 10, "states": 250,
}  # fmt: skip
#: A command in odd surroundings. Kills and damaged caches are in `test_files` and
#: `test_compiler`.
SURROUNDED = {"surroundings": "HOME a file", "run": "simulate"}


def attacked(amounts: dict[str, int], keep: Path, jobs: int = 1) -> None:
    """Attack targets; on a failure show the tables, which name the inputs."""
    tally = run([TARGETS[n] for n in amounts], 1, inputs=amounts, jobs=jobs, keep=keep)
    assert {n: tally.inputs[n] for n in amounts} == amounts
    assert not tally.failures, "\n\n".join(map(str, tables(tally)))


def test_quickly(tmp_path: Path) -> None:
    attacked(QUICK, tmp_path)


@slow
@pytest.mark.parametrize("target", FULL)
def test_damaged_inputs(target: str, tmp_path: Path) -> None:
    attacked({target: FULL[target]}, tmp_path)


@slow
def test_a_command_in_odd_surroundings(tmp_path: Path) -> None:
    saved = tmp_path / "environments-1-0.json"
    saved.write_text(json.dumps(SURROUNDED))
    tally = replay(saved, TARGETS)
    assert tally.inputs["environments"] == 1
    assert not tally.failures, "\n\n".join(map(str, tables(tally)))


def test_the_files_that_are_damaged_are_sound(tmp_path: Path) -> None:
    for suffix, contents in readers.sound_files().items():
        for content in contents:
            path = tmp_path / f"r{suffix}"
            path.write_bytes(content)
            assert read_record(path).n == 18


_PIECES = st.sampled_from(
    ("m", "s", "kg", "V", "degC", "1", "%", "/", ".", "(", ")", "2", "-3", "x")
)


@settings(deadline=None, max_examples=60, derandomize=True, database=None)
@given(st.text(max_size=8) | st.lists(_PIECES, max_size=8).map("".join))
def test_any_text_is_a_unit_or_is_refused(text: str) -> None:
    try:
        unit = parse_unit(text)
    except InputError:
        return
    assert unit.ratio > 0


def _behaviour(data: bytes, folder: Path) -> Iterator[Finding]:
    """Behave as the input demands."""
    match data.decode():
        case "refuse":
            raise InputError("no.")
        case "crash":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "end":
            os._exit(0)
        case "hang":
            time.sleep(60)
        case "foreign":
            raise KeyError("x")
        case "false pass":
            yield Finding(campaign.FALSE_PASS, "it passes")
        case "left over":
            (folder.parent / "tmp" / "left").touch()
        case "memory" if sys.platform.startswith("linux"):
            bytearray(1 << 34)
        case "memory":  # the limit is Linux's
            raise MemoryError


_BEHAVIOURS = ("accept", "refuse", "crash", "end", "hang", "foreign", "false pass", "left over",
               "memory", "accept")  # fmt: skip


def _counted(**options: object) -> Tally:
    fake = Target(
        "fake", "fake", ".txt", lambda rng: _BEHAVIOURS[rng.turn].encode(), _behaviour, limit_s=0.6
    )
    return run([fake], 7, inputs={"fake": 10}, jobs=2, **options)  # type: ignore[arg-type]


def test_every_way_to_fail_is_detected_and_counted(tmp_path: Path) -> None:
    texts: list[str] = []
    tally = _counted(keep=tmp_path, progress=texts.append)
    kinds = {kind: n for (_, kind), n in tally.kinds.items()}
    expected = dict.fromkeys((campaign.HANG, campaign.FALSE_PASS, campaign.LEFT_OVER), 1)
    expected |= dict.fromkeys((campaign.CRASH, campaign.FOREIGN), 2)
    assert kinds == expected
    assert tally.inputs["fake"] == 10
    assert tally.accepted["fake"] >= 2
    first = {d.first.index: d for d in tally.distinct.values()}
    assert sorted(first) == [2, 3, 4, 5, 6, 7, 8]
    assert "SIGSEGV" in first[2].first.sentence
    assert "MemoryError" in first[8].first.sentence
    assert {p.read_text() for p in tmp_path.iterdir()} == set(_BEHAVIOURS[2:9])
    assert any(line.endswith(f"--replay {tmp_path}/fake-7-5.txt") for line in texts)
    text = "\n".join(map(str, tables(tally)))
    assert "Distinct failures" in text


def test_one_seed_gives_one_set_of_inputs() -> None:
    for name in QUICK:
        make = TARGETS[name].make
        first = [make(generator(3, name, k)) for k in range(20)]
        assert first == [make(generator(3, name, k)) for k in range(20)]
        assert first != [make(generator(4, name, k)) for k in range(20)]
        assert len(set(first)) > 15


def test_damage_changes_its_input() -> None:
    data, tree = bytes(range(256)) * 4, {"a": [1, 2.5, {"b": "c"}], "d": None}
    changed = [damaged_bytes(data, Random(k)) != data for k in range(200)]
    assert sum(changed) > 190
    assert len({damaged_json(tree, Random(k)) for k in range(200)}) > 100
    text = readers.sound_files()[".csv"][0].decode()
    assert len({damaged_table(text, Random(k)) for k in range(200)}) > 150
    assert tree == {"a": [1, 2.5, {"b": "c"}], "d": None}


def test_the_command_counts_and_replays(tmp_path: Path) -> None:
    options = ["--only", "column-maps", "--inputs", "20", "--keep", str(tmp_path), "-q"]
    assert CliRunner().invoke(app, options).exit_code == 0
    assert CliRunner().invoke(app, ["--only", "nothing"]).exit_code == 2
    assert CliRunner().invoke(app, ["--replay", str(tmp_path / "x")]).exit_code == 2
    saved = tmp_path / "column-maps-1-5.txt"
    saved.write_text("time=t:ms")
    result = CliRunner().invoke(app, ["--replay", str(saved)])
    assert result.exit_code == 0
    assert "column-maps" in result.output
