"""`psa export ssp`: what it writes and says, and what it refuses."""

from pathlib import Path

import pytest
from fmpy.ssp.ssd import read_ssd
from typer.testing import CliRunner, Result

from psa_casadi.cli.app import app
from psa_casadi.export.ssp.archive import wiring_of
from psa_casadi.export.ssp.steps import stable_step
from psa_casadi.model.nanopositioner import nanopositioner
from tests.tiers import slow


def psa(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


@slow
def test_the_archive_and_its_picture_are_written(tmp_path: Path) -> None:
    """Of the default stack, where none is named."""
    archive, picture = tmp_path / "stage.ssp", tmp_path / "wiring.png"
    found = psa(
        "export", "ssp", "--no-compensator", "-o", str(archive), "--picture", str(picture),
    )  # fmt: skip
    assert found.exit_code == 0, found.output
    parts = [c.name for c in read_ssd(str(archive)).system.elements]
    assert parts == ["controller", "amplifier", "stack", "flexure"]
    assert f"parts: {', '.join(parts)}" in found.output
    assert "inputs: reference [m]" in found.output
    wiring = wiring_of(nanopositioner("P-885.51", compensated=False))
    for rates in (False, True):
        assert f"above {1e6 * stable_step(wiring, rates=rates):.3g} us" in found.output
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "sentences"),
    [
        (("--model", "m.json", "--stack", "demo", "-o", "stage.ssp"), ("both given",)),
        (
            ("--stack", "P-1", "-o", "absent/stage.ssp", "--picture", "wiring.gif"),
            ("P-1", "absent does not exist", "is .svg or .png"),
        ),
        (("--stack", "P-885.51", "--platforms", "vax", "-o", "stage.ssp"), ("vax",)),
    ],
)
def test_mistakes_are_told_at_once_and_nothing_is_written(
    arguments: tuple[str, ...],
    sentences: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    found = psa("export", "ssp", *arguments)
    assert found.exit_code == 2
    for sentence in sentences:
        assert sentence in found.output
    assert not list(tmp_path.iterdir())
