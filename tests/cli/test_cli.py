"""The version, and what goes on from the demonstration; `tests/contract` has the commands."""

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

import psa_casadi
from build_scripts.page_commands import block_in_tests, run_block
from psa_casadi.cli.app import app
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.model.model_file import load_model
from psa_casadi.records import read_record
from psa_casadi.records.split import whole
from tests.identification.identified_plants import same_as_the_named_stack
from tests.tiers import slow


def psa(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def done(*arguments: str | Path) -> Result:
    result = psa(*arguments)
    assert result.exit_code == 0, result.output
    return result


def test_the_version_is_one() -> None:
    assert done("--version").stdout == f"psa_casadi {psa_casadi.__version__}\n"
    root = Path(__file__).parents[2]
    citation = (root / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {psa_casadi.__version__}\n" in citation
    released = re.search(r"^date-released: (\S+)$", citation, re.MULTILINE)
    assert released is not None
    heading = f"\n## [{psa_casadi.__version__}] - {released[1]}\n"
    assert heading in (root / "CHANGELOG.md").read_text(encoding="utf-8")


@slow
@pytest.mark.xdist_group("demo")
def test_the_page_goes_on_from_the_demo_whose_stack_is_what_its_record_gives(
    tmp_path: Path,
) -> None:
    block = block_in_tests("docs/fmu.md")
    assert shlex.split(block.commands[0]) == ["psa", "demo"]
    assert run_block(block, tmp_path) is None
    record = read_record(tmp_path / "psa_demo" / "synthetic_record.csv")
    found = load_model(tmp_path / "psa_demo" / "model.json")
    rms = fit(found, [whole(record)], [], sigma=[1e-3 * record.range_m]).rms
    same_as_the_named_stack(rms, record, "demo")
