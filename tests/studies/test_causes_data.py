"""The data set of hidden causes: the score on answers with known figures, and its bytes."""

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from tests.studies.benchmarks.causes import data as writing
from tests.studies.benchmarks.causes.data import cases_of
from tests.tiers import slow

DATA = Path(writing.__file__).parent
SCORE = DATA / "score.py"
#: Alone: no folder of ours on the path; numpy's is added by hand.
ALONE = "import sys, runpy; sys.path.append(sys.argv.pop(1)); sys.argv.pop(0);" \
    " runpy.run_path(sys.argv[0], run_name='__main__')"  # fmt: skip
HIDDEN = {
    "001": ("known", ["slow_creep"]),
    "002": ("known", ["load_stiffness"]),
    "003": ("clean", []),
    "004": ("foreign", ["dry_friction"]),
    "005": ("two", ["backlash", "ageing"]),
    "006": ("weak", ["backlash"]),
}
NOISE, EXCESS = np.array([1.0, -1.0, 1.0, -1.0]), np.array([2.0, 2.0, -2.0, -2.0])


def put(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content), "utf-8")


def table(head: str, *columns: np.ndarray[Any, Any]) -> str:
    rows = [",".join(f"{x:.6f}" for x in row) for row in zip(*columns, strict=True)]
    return "\n".join([head, *rows]) + "\n"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Six cases of four samples: noise of rms 1, a base that misses an effect of rms 2."""
    folder, clean, t = tmp_path / "data", np.array([5.0, 6.0, 7.0, 8.0]), np.arange(4.0)
    causes = ["slow_creep", "load_stiffness", "sensor_nonlinearity", "backlash", "ageing"]
    put(folder / "data.json", {"causes": causes})
    true = {n: {"kind": k, "hidden": h} for n, (k, h) in HIDDEN.items()}
    put(folder / "truth" / "truth.json", {"cases": true})
    for name in HIDDEN:
        head = "time [s],displacement [um],displacement without noise [um]"
        put(folder / "truth" / f"{name}.csv", table(head, t, clean + NOISE, clean))
        head = "time [s],voltage [V],base displacement [um]"
        put(folder / "cases" / name / "base_holdout.csv", table(head, t, t, clean + EXCESS))
    return folder


def give(data: Path, name: str, causes: list[dict[str, float]], **more: Any) -> None:
    content = {"format": "psa_causes.answer/1", "case": name, "detected": bool(causes)}
    content |= {"causes": causes, **more}
    schema = json.loads((DATA / "answer.schema.json").read_text("utf-8"))
    jsonschema.Draft202012Validator(schema).validate(content)
    put(data.parent / "answers" / f"{name}.json", content)


def scored(data: Path) -> subprocess.CompletedProcess[str]:
    out = data.parent / "score.json"
    words = [str(SCORE), str(data), str(data.parent / "answers"), "--json", str(out)]
    numpys = str(Path(np.__file__).parent.parent)
    return subprocess.run(
        [sys.executable, "-I", "-S", "-c", ALONE, numpys, *words],
        capture_output=True, text=True, check=False, cwd=data,
    )  # fmt: skip


def test_the_score_of_answers_made_by_hand_is_as_counted(data: Path) -> None:
    clean = [5.0, 6.0, 7.0, 8.0]
    gain = {"value": 60.0, "low": 50.0, "high": 60.0}  # it is 1 - 1/sqrt(5): 55.3 %
    give(data, "001", [{"slow_creep": 1.0}], displacement_um=clean, gain_percent=gain)
    give(data, "002", [{"load_stiffness": 0.5, "sensor_nonlinearity": 0.5}])
    give(data, "003", [{"ageing": 0.6}])
    curve = {"column": "voltage", "at": [0.0, 1.0, 2.0, 3.0], "adds_um": (-EXCESS / 2).tolist()}
    give(data, "004", [], detected=True, patch=curve)
    give(data, "005", [{"ageing": 0.9}, {"backlash": 0.8}])
    done = scored(data)
    assert done.returncode == 0, done.stderr
    result = json.loads((data.parent / "score.json").read_text("utf-8"))
    matches = result["figures"]
    expected = {
        "answered": [5, 6],
        "detected, 0.3 to 3 times the noise": [2, 2],
        "right name in the set": [2, 2],
        "right name alone": [1, 2],
        "right name alone, the two bends not counted": [1, 1],
        "a single wrong name": [0, 3],
        "weak (0.1 to 0.3): right name in the set": [0, 1],
        "clean: a cause named": [1, 1],
        "clean: any alarm": [1, 1],
        "foreign: detected": [1, 1],
        "foreign: no single name": [1, 1],
        "two causes: both in the sets": [1, 1],
        "two causes: both named first, no third": [1, 1],
        "interval of the gain holds it": [1, 1],
    }
    assert {k: matches[k] for k in expected} == expected
    assert matches["held-out error over the noise, median"] == pytest.approx(1.0)
    assert matches["the fitted base's, median"] == pytest.approx(np.sqrt(5.0))
    # half of an effect of power 4 is left: a power of 1 besides the noise
    assert matches["foreign: share of the excess removed, median"] == pytest.approx(0.75)
    # 0; 0.25 + 0.25; 0.36 + 0.36; 0; and 2 for the weak one that has no answer
    assert matches["Brier score"] == pytest.approx((0.0 + 0.5 + 0.72 + 0.0 + 2.0) / 5)
    assert [r["of"] for r in result["reliability"]] == [2, 1, 1]


def test_malformed_answers_are_reported_in_sentences(data: Path) -> None:
    give(data, "001", [{"gremlins": 0.9}], displacement_um=[1.0])
    put(data.parent / "answers" / "002.json", "{")
    put(data.parent / "answers" / "999.json", {})
    done = scored(data)
    assert done.returncode == 2
    for words in ("no cause 'gremlins'", "must hold 4 numbers", "002.json is no JSON", "999.json"):
        assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_the_score_imports_numpy_and_the_standard_library_only() -> None:
    lines = [s for s in SCORE.read_text("utf-8").splitlines() if s.startswith(("import", "from"))]
    names = {line.split()[1].split(".")[0] for line in lines}
    assert names <= {"numpy", *sys.stdlib_module_names}


@slow
def test_a_seed_gives_the_same_bytes_and_the_truth_stays_apart(tmp_path: Path) -> None:
    case = next(c for c in cases_of(5, 10) if c.kind == "clean")
    first, again = tmp_path / "first", tmp_path / "again"
    for folder in (first, again):
        writing.write_case(folder, 1, case)
        writing.write_sums(folder)
    sums = (first / "SHA256SUMS").read_text("utf-8")
    assert sums == (again / "SHA256SUMS").read_text("utf-8")
    for line in sums.splitlines():
        digest, name = line.split("  ")
        assert hashlib.sha256((first / name).read_bytes()).hexdigest() == digest
    heads = (first / "cases/001/holdout.csv").read_text("utf-8").splitlines()[0]
    assert heads == "time [s],voltage [V],temperature [degC]"
    assert {c.kind for c in cases_of(6, 60)} == {"known", "clean", "foreign", "weak", "two"}
