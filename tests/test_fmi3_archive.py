"""The archive of FMI 3.0, and the command that writes it."""

import io
import zipfile
from pathlib import Path
from xml.etree import ElementTree as ET

import fmpy
import pytest
from fmpy.validation import validate_fmu
from typer.testing import CliRunner

from psa_casadi.cli.app import app
from psa_casadi.errors import InputError
from psa_casadi.export.common.variable_table import variable_table
from psa_casadi.export.fmu.archive import export_fmu, write_archive
from psa_casadi.export.fmu.description import model_description
from psa_casadi.model.stacks import STACKS
from tests.fmu_models import exported, model_named
from tests.tiers import slow_but

#: Two models in both versions, the others in one of them in turn.
TWICE = ("P-885.51", "flexure")
TRIED = [(name, fmi) for name in TWICE for fmi in (2, 3)]
TRIED += [
    (name, 2 + k % 2)
    for k, name in enumerate((*STACKS, "every_effect", "single_mass")) if name not in TWICE
]  # fmt: skip


@pytest.mark.usefixtures("without_binary")
@pytest.mark.parametrize(("name", "fmi"), slow_but(TRIED[:4], TRIED))
def test_archives_are_valid(name: str, fmi: int, tmp_path: Path) -> None:
    """What is checked are the description and the list of sources."""
    path = export_fmu(model_named(name), tmp_path / "m.fmu", name="m", fmi=fmi, include_sensor=True)
    assert validate_fmu(str(path)) == []
    description = fmpy.read_model_description(str(path))
    assert description.fmiVersion == f"{fmi}.0"
    assert len(description.modelVariables) == len(variable_table(model_named(name)))


@pytest.mark.parametrize(
    "breakage", slow_but(["order"], ["unit", "dependencies", "start", "order"])
)
def test_the_validation_finds_faults(breakage: str, tmp_path: Path) -> None:
    text = model_description(model_named("flexure"), "m", "{t}", fmi=3)
    broken = {
        "unit": text.replace('<Unit name="kg">', '<Unit name="kilo">'),
        "dependencies": text.replace('dependencies="2"', 'dependencies="2 3"', 1),
        "start": text.replace('causality="input" variability="continuous"', "", 1),
        "order": text.replace("<Output ", "<EventIndicator ", 1),
    }[breakage]
    assert broken != text
    with zipfile.ZipFile(exported("flexure", 3)) as archive:
        entries = {n: archive.read(n) for n in archive.namelist()}
    write_archive(tmp_path / "m.fmu", {**entries, "modelDescription.xml": broken.encode()})
    assert validate_fmu(str(tmp_path / "m.fmu"))


@pytest.mark.usefixtures("without_binary")
def test_archive_of_fmi_3(tmp_path: Path) -> None:
    """Folders are named by FMI 3's platform tuples; the same model gives the same bytes."""
    paths = [tmp_path / "a.fmu", tmp_path / "b.fmu"]
    for path in paths:
        export_fmu(model_named("demo"), path, name="demo", platforms=["all"], fmi=3)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    with zipfile.ZipFile(paths[0]) as archive:
        names = archive.namelist()
        assert names == sorted(names)
        assert {i.date_time for i in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    binaries = {n.removeprefix("binaries/") for n in names if n.startswith("binaries/")}
    assert binaries == {
        "x86_64-linux/demo.so",
        "aarch64-linux/demo.so",
        "riscv64-linux/demo.so",
        "aarch32-linux/demo.so",
        "x86-linux/demo.so",
        "x86_64-windows/demo.dll",
        "x86-windows/demo.dll",
        "x86_64-darwin/demo.dylib",
        "aarch64-darwin/demo.dylib",
    }
    assert {"sources/buildDescription.xml", "sources/README.txt", "resources/model.json"} < {*names}
    with pytest.raises(InputError, match="FMI 4 is not known"):
        export_fmu(model_named("demo"), tmp_path / "c.fmu", fmi=4)


def test_the_token_follows_the_version() -> None:
    tokens = []
    for fmi, key in ((2, "guid"), (3, "instantiationToken")):
        with zipfile.ZipFile(exported("P-885.51", fmi)) as archive:
            root = ET.parse(io.BytesIO(archive.read("modelDescription.xml"))).getroot()
        tokens.append(root.attrib[key])
    assert tokens[0] != tokens[1]


@pytest.mark.usefixtures("without_binary")
def test_command(tmp_path: Path) -> None:
    path = tmp_path / "x.fmu"
    arguments = ["export", "fmu", "--stack", "demo", "--fmi", "3", "-o", str(path)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert fmpy.read_model_description(str(path)).fmiVersion == "3.0"
