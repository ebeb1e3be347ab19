import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from psa_casadi.cli.app import app
from psa_casadi.components import BASE
from psa_casadi.effects import EFFECTS
from psa_casadi.model.compose import compose
from psa_casadi.model.model_file import dumps
from tests.record_files import HEADER, ROWS, write

MODEL = dumps(compose((*BASE, EFFECTS["slow_creep"])))


def psa(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def refused(*arguments: str | Path, outputs: Path, code: int = 2) -> str:
    """Run a command that must fail in the given way, and return what it says on stderr."""
    before = sorted(outputs.rglob("*"))
    result = psa(*arguments)
    assert result.exit_code == code, result.output
    assert isinstance(result.exception, SystemExit)
    assert "Traceback" not in result.output
    assert result.stdout == ""
    assert sorted(outputs.rglob("*")) == before
    return result.stderr


def rows_with(row: int, text: str) -> list[str]:
    return [*ROWS[:row], text, *ROWS[row + 1 :]]


RECORDS: dict[str, tuple[list[str], str]] = {
    "wrong unit": (["time [s],voltage [N],displacement [um]", *ROWS], "'N' does not measure"),
    "unknown unit": (["time [s],voltage [vlots],displacement [um]", *ROWS], "'vlots' is unknown"),
    "unit of a load": (
        [f"{HEADER},load_force [kg]", *(f"{r},0" for r in ROWS)], "'kg' does not measure force"
    ),
    "text in a number": ([HEADER, *rows_with(4, "0.004,abc,1")], "line 6, column 'voltage'"),
    "time goes back": ([HEADER, *rows_with(4, "0.001,1,1")], "time goes back"),
    "nan time": ([HEADER, *rows_with(4, "nan,1,1")], "line 6, column 'time': found no value"),
    "three samples": ([HEADER, *ROWS[:3]], "found 3 samples, expected at least"),
    "constant voltage": (
        [HEADER, *(f"{k},3,{k}" for k in range(20))], "expected a voltage that changes"
    ),
    "no displacement": ([HEADER, *(f"{k},{k % 3}," for k in range(20))], "found no valid values"),
    "no header": (ROWS, "expected a header"),
    "empty": ([""], "the file is empty"),
}  # fmt: skip


@pytest.mark.parametrize("case", RECORDS)
def test_a_record_with_a_mistake(tmp_path: Path, case: str) -> None:
    lines, expected = RECORDS[case]
    bad = write(tmp_path / "bad.csv", *lines)
    good = write(tmp_path / "good.csv", HEADER, *ROWS)
    model = write(tmp_path / "model.json", MODEL)
    out = tmp_path / "out"
    out.mkdir()
    commands: list[tuple[str | Path, ...]] = [
        ("identify", bad, "-o", out / "m.json", "--report", out / "r.html"),
        (
            "diagnose",
            bad,
            "-o",
            out / "m.json",
            "--json",
            out / "d.json",
            "--figure",
            out / "f.png",
        ),
    ]
    if case not in ("constant voltage", "no displacement"):
        commands.append(("simulate", "--model", model, "--input", bad, "-o", out / "y.csv"))
    if case != "constant voltage":
        commands.append(("diagnose", good, "--holdout", bad, "-o", out / "m.json"))
    for command in commands:
        said = refused(*command, outputs=tmp_path)
        assert str(bad) in said
        assert expected in said


def _edited(change: Callable[[dict[str, Any]], object]) -> str:
    content = json.loads(MODEL)
    change(content)
    return json.dumps(content)


MODELS = {
    "not JSON": ("{", "is not JSON"),
    "other JSON": ('{"format": "psa_casadi.diagnosis/1"}', "is not a model file"),
    "a list": ("[1, 2]", "is not a model file"),
    "unknown effect": (_edited(lambda m: m["effects"].append("warp")), "unknown name 'warp'"),
    "missing parameter": (
        _edited(lambda m: m["parameters"].pop("k_L")),
        "'k_L' [N/V] has no value",
    ),
    "out of bounds": (
        _edited(lambda m: m["parameters"]["creep_gain"].update(value=7.0)),
        "'creep_gain' is 7 1, outside its bounds",
    ),
    "text as a value": (
        _edited(lambda m: m["parameters"]["k_L"].update(value="1")),
        "give a number",
    ),
    "another unit": (_edited(lambda m: m["parameters"]["k_L"].update(unit="kN/V")), "convert it"),
}


@pytest.mark.parametrize("case", MODELS)
def test_a_model_file_with_a_mistake(tmp_path: Path, case: str) -> None:
    text, expected = MODELS[case]
    model = write(tmp_path / "model.json", text)
    good = write(tmp_path / "good.csv", HEADER, *ROWS)
    (tmp_path / "x.fmu").write_bytes(b"not read")
    for command in (
        ("identify", good, "--model", model, "-o", tmp_path / "m.json"),
        ("simulate", "--model", model, "--input", good, "-o", tmp_path / "y.csv"),
        ("diagnose", good, "--model", model, "--report", tmp_path / "r.html"),
        ("export", "fmu", "--model", model, "-o", tmp_path / "y.fmu"),
        ("check", tmp_path / "x.fmu", "--model", model),
    ):
        said = refused(*command, outputs=tmp_path)
        assert expected in said
        assert str(model) in said


def test_outputs_that_collide(tmp_path: Path) -> None:
    good = write(tmp_path / "good.csv", HEADER, *ROWS)
    same = tmp_path / "same"
    said = refused("diagnose", good, "-o", same, "--json", same, outputs=tmp_path)
    assert "both -o and --json name it" in said.replace("--output", "-o")
    said = refused("identify", good, "-o", good, outputs=tmp_path)
    assert "would overwrite an input" in said
    assert good.read_text(encoding="utf-8").startswith(HEADER)


def test_a_fault_of_the_package_ends_with_1_and_a_short_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = write(tmp_path / "good.csv", HEADER, *ROWS)

    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("one over none")

    monkeypatch.setattr("psa_casadi.identification.identify.identify", broken)
    monkeypatch.delenv("PSA_CASADI_DEBUG", raising=False)
    out = tmp_path / "m.json"
    said = refused("identify", good, "-o", out, "--quiet", outputs=tmp_path, code=1)
    assert "unexpected ZeroDivisionError (one over none)" in said
    assert len(said.splitlines()) == 1
    monkeypatch.setenv("PSA_CASADI_DEBUG", "1")
    assert isinstance(psa("identify", good, "-o", out).exception, ZeroDivisionError)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("compare", "absent.json", "b.json"), "absent.json: cannot be read (there is no such"),
        (
            ("simulate", "--model", "bytes", "--input", "x"),
            "bytes cannot be read (it is no text in",
        ),
        (("export", "c", "--step", "10us", "--stack", "demo", "-o", "bytes"), "there is a file of"),
        (("examples", "ci", "-o", "bytes"), "bytes: cannot be created, there is a file of that"),
        (("datasets", "micromanipulator", "-o", "bytes"), "bytes: cannot be created"),
        (("check", "bytes", "--timeout", "inf"), "'--timeout'"),
        (
            ("design", "experiment", "--stack", "demo", "--duration", "1", "--samples", "0"),
            "0 samples hold no experiment",
        ),
        (
            ("design", "mechanism", "--stack", "demo", "--damping", "0.5", "--max-force", "inf"),
            "The largest force is inf N; give a positive one",
        ),
    ],
)
def test_what_cannot_be_used_is_told_in_words(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bytes").write_bytes(bytes(range(256)))
    output = () if "-o" in words or words[0] == "check" else ("-o", "out")
    told = refused(*words, *output, outputs=tmp_path)
    assert said in " ".join(told.split())
    assert "Errno" not in told
