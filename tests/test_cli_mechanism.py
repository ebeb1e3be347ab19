"""The command `psa design mechanism`: files, page, and what it says of mistakes."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from psa_casadi.cli.app import app
from psa_casadi.design.mechanism.mechanism import design_mechanism
from psa_casadi.model.model_file import load_model
from psa_casadi.model.stacks import stack_model
from tests.tiers import slow

STACK = "PTBS200"


@slow
def test_command_writes_model_port_and_page(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("mount.json", "stack.json", "page.html")]
    arguments = ["design", "mechanism", "--stack", STACK, "--damping", "0.7", "--starts", "1"]
    arguments += ["-o", str(files[0]), "--port", str(files[1]), "--report", str(files[2])]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "no mechanism moves it" in result.output
    expected = design_mechanism(stack_model(STACK), damping=0.7, starts=1)
    mount, port = load_model(files[0]), load_model(files[1])
    assert mount.values["m_m"] == pytest.approx(expected.mounting.mass, rel=1e-3)
    assert "prestress_force" in port.input_names
    page = files[2].read_text(encoding="utf-8")
    assert "Root locus" in page
    assert "lag, cannot be moved" in page
    assert "Change the model and see" in page
    assert '"kind": "report"' in page
    assert page.count("data:image/png") == 1
    assert len(page) < 3e6
    assert json.loads(files[0].read_text())["components"] == ["prestress_mechanism"]


def test_command_tells_every_mistake(tmp_path: Path) -> None:
    arguments = ["design", "mechanism", "--stack", STACK, "--poles", "fast"]
    arguments += ["--max-stroke-loss", "much", "-o", str(tmp_path / "no" / "mount.json")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    for part in ("'fast' is no pole", "'much' is no share", "does not exist"):
        assert part in " ".join(result.output.split())
