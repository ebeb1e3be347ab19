"""Author, version, copyright and licence: stated where a model is passed on, with all notices."""

import re
import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
from typer.testing import CliRunner

from psa_casadi.cli.app import app
from psa_casadi.export.check.description import missing_notices, published_as, unreproducible_parts
from psa_casadi.export.common.publication import LICENSE_ENTRY
from psa_casadi.export.importer.archive import Archive
from psa_casadi.model.model_file import dumps, loads, save_model
from psa_casadi.variables import Publication
from tests.export.fmu_models import assert_valid, entries, exported, model_named, rewritten
from tests.tiers import slow_but

STACK = "P-885.51"
SAID = Publication("A. Author", "1.2", "(c) 2026 A. Author & sons", "CC-BY-4.0")
LICENSE = (Path(__file__).parents[2] / "LICENSE").read_text(encoding="utf-8")


@pytest.mark.parametrize("fmi", [2, 3])
def test_every_fmu_holds_the_notices_that_its_licences_ask_for(fmi: int) -> None:
    """BSD 3-Clause for the code, BSD 2-Clause for the headers, in the binaries' documentation."""
    inside = entries(STACK, fmi)
    assert LICENSE_ENTRY == "documentation/licenses/license.txt"
    text = inside[LICENSE_ENTRY].decode()
    assert LICENSE in text
    assert 'Modelica Association Project "FMI"' in text
    assert "Redistributions in binary form" in text.partition("B. Headers")[2]
    assert inside["sources/LICENSE.txt"].decode() == LICENSE
    root = ET.fromstring(inside["modelDescription.xml"])
    assert LICENSE_ENTRY in root.attrib["license"]
    assert LICENSE.splitlines()[2] in root.attrib["copyright"]
    assert not {"author", "version"} & set(root.attrib)


def test_what_a_model_states_is_in_its_file_and_comes_back() -> None:
    model = replace(model_named("flexure"), publication=SAID)
    assert loads(dumps(model)).publication == SAID
    assert "publication" not in dumps(model_named("flexure"))


@pytest.mark.parametrize("fmi", slow_but([3], [2, 3]))
def test_the_command_states_them_over_the_file_s_and_the_check_agrees(
    fmi: int, tmp_path: Path
) -> None:
    plain, path = tmp_path / "model.json", tmp_path / "m.fmu"
    model = replace(model_named("flexure"), publication=Publication(author="file", version="0.9"))
    save_model(model, plain)
    options = ["--author", SAID.author, "--copyright", SAID.copyright, "--license", SAID.license]
    command = ["export", "fmu", "--model", str(plain), "--fmi", str(fmi), "-o", str(path)]
    done = CliRunner().invoke(app, [*command, *options])
    assert done.exit_code == 0, done.output
    with zipfile.ZipFile(path) as archive:
        xml = archive.read("modelDescription.xml").decode()
        terms, page = (archive.read(f"documentation/{n}").decode()
                       for n in ("licenses/license.txt", "index.html"))  # fmt: skip
    assert_valid(xml, "schema", f"fmi{fmi}", f"fmi{fmi}ModelDescription.xsd")
    stated = replace(SAID, version="0.9").stated
    assert {n: ET.fromstring(xml).attrib[n] for n in stated} == stated
    assert all(f"{name}: {text}" in terms for name, text in stated.items())
    assert "(c) 2026 A. Author &amp; sons" in page
    with Archive(path) as archived:
        assert list(missing_notices(archived)) == []
        as_exported = published_as(archived, model.plant())
        assert as_exported.publication.stated == stated
        assert list(unreproducible_parts(archived, as_exported)) == []
    refused = CliRunner().invoke(app, [*command, "--author", " "])
    assert refused.exit_code == 2
    assert "--author is ' '" in refused.output


def test_a_licence_that_was_lost_is_found(tmp_path: Path) -> None:
    path = tmp_path / "m.fmu"
    gone = {LICENSE_ENTRY: lambda _: b"all rights reserved\n"}
    with Archive(rewritten(exported("flexure", 2), path, gone)) as archive:
        (found,) = missing_notices(archive)
    assert "lacks the notice 'Copyright (c)" in found
    unsaid = {"modelDescription.xml": lambda xml: re.sub(rb' license="[^"]*"', b"", xml)}
    with Archive(rewritten(exported("flexure", 2), path, unsaid)) as archive:
        assert list(missing_notices(archive)) == ["the description states no license"]
