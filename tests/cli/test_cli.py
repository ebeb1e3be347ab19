import json
import re
import shlex
from dataclasses import dataclass, replace
from pathlib import Path

import fmpy
import pytest
from typer.testing import CliRunner, Result

import psa_casadi
from build_scripts.page_commands import block_in_tests, run_block
from psa_casadi.cli.app import app
from psa_casadi.cli.demo import FILES
from psa_casadi.components import BASE
from psa_casadi.effects import EFFECTS
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.model.compose import compose
from psa_casadi.model.model_file import load_model, save_model
from psa_casadi.records import multisine, read_record, time_grid, write_record
from psa_casadi.records.split import whole
from tests.identification.identified_plants import same_as_the_named_stack
from tests.report.html_page import Page, figures
from tests.report.test_report import png_size
from tests.report.test_schemas import valid
from tests.tiers import slow

#: The demo takes half a minute: with pytest-xdist's loadgroup it runs once, else once per process.
pytestmark = pytest.mark.xdist_group("demo")

#: The record that the demonstration copies.
DEMO = Path(psa_casadi.__file__).parent / "data" / "demo.csv"


@dataclass(frozen=True)
class Demo:
    directory: Path
    said: str
    progress: str


def psa(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def done(*arguments: str | Path) -> Result:
    result = psa(*arguments)
    assert result.exit_code == 0, result.output
    return result


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    directory = tmp_path_factory.mktemp("demo") / "new" / "psa_demo"
    result = done("demo", "-o", directory)
    return Demo(directory, result.stdout, result.stderr)


@pytest.fixture
def planned(tmp_path: Path) -> tuple[Path, Path]:
    """Return a model with a delay in its sensor, and a voltage that nobody has measured yet."""
    model, voltage = tmp_path / "model.json", tmp_path / "planned.csv"
    save_model(compose((*BASE, EFFECTS["sensor_delay"]), {"sensor_delay": 1e-3}), model)
    time = time_grid(0.2, 1e-3)
    drive = multisine(time, 5.0, 95.0, (5.0, 50.0), seed=1)
    write_record(voltage, {"time [s]": time, "voltage [V]": drive})
    return model, voltage


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
def test_the_demo_leaves_what_it_says(demo: Demo) -> None:
    assert {p.name for p in demo.directory.iterdir()} == set(FILES)
    for name in FILES:
        assert (demo.directory / name).stat().st_size > 1000
        assert name in demo.said.split("left in ")[1]
    assert "slow creep" in demo.said
    assert "passed all" in demo.said
    assert "FAIL" not in demo.said
    assert "synthetic_record (synthetic:" in demo.said
    assert "(measured" not in demo.said
    assert "base fit" in demo.progress


@slow
def test_the_demo_names_the_hidden_effect_and_gains_by_it(demo: Demo) -> None:
    d = json.loads((demo.directory / "diagnosis.json").read_text(encoding="utf-8"))
    assert set(d) >= {"format", "verdict", "causes", "candidates", "errors", "gain", "blind_to",
                      "remaining", "next_experiment"}  # fmt: skip
    assert d["verdict"] == "cause_named"
    assert [c["effect"] for c in d["causes"]] == ["slow_creep"]
    assert set(d["causes"][0]) >= {"belongs_to", "confidence", "parameters", "cannot_be_told_from"}
    assert d["gain"]["holdout_rms_reduction_percent"] > 50.0
    assert d["records"][0]["name"] == "synthetic_record"
    record = read_record(demo.directory / "synthetic_record.csv")
    assert d["records"][0]["sha256"] == record.sha256
    base = load_model(demo.directory / "model.json")
    extended = load_model(demo.directory / "extended.json")
    assert [c.name for c in base.effects] == []
    assert [c.name for c in extended.effects] == ["slow_creep"]
    assert extended.provenance.identified_from == (("synthetic_record", record.sha256),)


@slow
def test_the_demos_report_is_whole_and_calls_its_data_synthetic(demo: Demo) -> None:
    text = (demo.directory / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.loaded == []
    assert len(text) < 8e6
    assert len(figures(text)) >= 4
    assert "synthetic data" in page.text
    assert "measured" not in page.text.replace("measured minus model", "")
    for part in ("The cause is slow creep", "Every effect", "What remains", "could not have shown",
                 "Next experiment", "Parameters of the extended model", "SHA-256"):  # fmt: skip
        assert part in page.text
    assert png_size(demo.directory / "diagnosis.png") == (1600, 1000)


@slow
def test_the_demos_fmu_is_valid_and_can_be_checked_again(demo: Demo) -> None:
    fmu = demo.directory / "extended.fmu"
    assert fmpy.read_model_description(str(fmu)).coSimulation is not None
    checked = done("check", fmu, "--model", demo.directory / "extended.json", "--quiet")
    assert checked.output == ""
    other = psa("check", fmu, "--model", demo.directory / "model.json")
    assert other.exit_code == 1
    assert "FAIL" in other.stdout
    assert "did not pass" in other.stdout


@slow
def test_the_commands_of_the_page_go_on_from_the_demo(demo: Demo) -> None:
    block = block_in_tests("docs/fmu.md")
    begin, *rest = block.commands
    assert shlex.split(begin) == ["psa", "demo"]
    assert demo.directory.name == "psa_demo"
    assert run_block(replace(block, commands=tuple(rest)), demo.directory.parent) is None


@slow
def test_the_demos_stack_is_what_its_record_gives(demo: Demo) -> None:
    record = read_record(demo.directory / "synthetic_record.csv")
    found = load_model(demo.directory / "model.json")
    sigma = [1e-3 * record.range_m]
    rms = fit(found, [whole(record)], [], sigma=sigma).rms
    same_as_the_named_stack(rms, record, "demo")


@slow
def test_identify_starts_from_a_model_and_writes_its_page(demo: Demo, tmp_path: Path) -> None:
    model, page = tmp_path / "m.json", tmp_path / "fit.html"
    record = demo.directory / "synthetic_record.csv"
    result = done(
        "identify", record, "--model", demo.directory / "model.json", "--stiffness", "5e7",
        "-o", model, "--report", page, "--origin", "synthetic", "--json", tmp_path / "fit.json",
    )  # fmt: skip
    for part in ("k_L", "95 % interval", "N/V", "written:", "(synthetic:"):
        assert part in result.stdout
    content = valid("identification", (tmp_path / "fit.json").read_text(encoding="utf-8"))
    found = load_model(model)
    assert {n: p["value"] for n, p in content["parameters"].items()} == found.values
    assert found.provenance.identified_from[0][1] == read_record(record).sha256
    assert set(found.provenance.free) <= set(found.provenance.intervals)
    shown = Page(page.read_text(encoding="utf-8"))
    assert shown.loaded == []
    assert "synthetic and model" in shown.text
    assert "95 % interval" in shown.text


def test_diagnose_writes_only_what_is_asked_for_and_can_be_quiet(
    tmp_path: Path,
) -> None:
    record = read_record(DEMO)
    parts = [record.slice(0, 1200), record.slice(1200, 2000)]
    paths = [tmp_path / "a.csv", tmp_path / "b.csv"]
    for path, part in zip(paths, parts, strict=True):
        assert part.displacement is not None
        write_record(
            path,
            {
                "time [s]": part.time,
                "voltage [V]": part.voltage,
                "displacement [m]": part.displacement,
            },
        )
    events = tmp_path / "e.jsonl"
    left_out = set(EFFECTS) - {"charge_leakage", "hysteresis_memory", "offset_drift", "sensor_lag"}
    result = done(
        "diagnose", paths[0], "--holdout", paths[1], "--json", tmp_path / "d.json", "--quiet",
        "--events", events, *(word for name in left_out for word in ("--leave-out", name)),
    )  # fmt: skip
    assert result.output == ""
    assert {p.name for p in tmp_path.iterdir()} == {"a.csv", "b.csv", "d.json", "e.jsonl"}
    d = json.loads((tmp_path / "d.json").read_text(encoding="utf-8"))
    assert [r["name"] for r in d["records"]] == ["a", "b"]
    tried = [json.loads(line) for line in events.read_text(encoding="utf-8").splitlines()]
    assert tried[0]["causes"] == []
    assert [t["state"] for t in tried].count("best") == 1
    assert {c["effect"] for c in d["causes"]} <= set(tried[-1]["causes"])
    assert any(t["causes"] for t in tried)
    assert not [t for t in tried if left_out & set(t["causes"])]
    assert "slow_creep" in d["notes"][-1]


@pytest.mark.usefixtures("without_binary")
def test_export_leaves_the_sensor_out_unless_asked(
    planned: tuple[Path, Path], tmp_path: Path
) -> None:
    model, fmu = planned[0], tmp_path / "x.fmu"
    said = done("export", "fmu", "--model", model, "-o", fmu, "--name", "my_stack").stdout
    assert "left out: sensor, sensor_delay" in said
    description = fmpy.read_model_description(str(fmu))
    assert description.coSimulation.modelIdentifier == "my_stack"
    assert "sensor_delay" not in [v.name for v in description.modelVariables]
    said = done("export", "fmu", "--model", model, "-o", fmu, "--include-sensor").stdout
    assert "left out" not in said
    assert "sensor_delay" in [v.name for v in fmpy.read_model_description(str(fmu)).modelVariables]
