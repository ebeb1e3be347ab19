from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from psa_casadi.cli.app import app
from tests.record_files import HEADER, ROWS, write


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
