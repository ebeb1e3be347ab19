"""Pages that are made when the site is built: commands, effects, recipes."""

import json
import re

import pytest
import yaml  # type: ignore[import-untyped]

import psa_casadi as psa
from build_scripts import copied_pages, ports_page, python_page
from build_scripts.commands_page import commands
from build_scripts.effects_page import PICTURES, overview, section
from build_scripts.measured_data import ROOT
from build_scripts.schemas import FILES, schema_texts
from build_scripts.schemas_page import WRITTEN_BY
from build_scripts.schemas_page import section as schema_section
from psa_casadi.examples.index import examples
from tests.cli.test_cli import EVERY


def test_the_page_of_commands_holds_every_command_and_option() -> None:
    parts = dict(part.split("`\n", 1) for part in commands().split("# `")[1:])
    single = {path: c for path, c in EVERY.items() if not hasattr(c, "commands")}
    assert len(single) >= 15
    for path, command in single.items():
        part = parts[" ".join(("psa", *path))].splitlines()
        listed = "".join(line for line in part if line.startswith("* `"))
        options = [o for p in command.params for o in p.opts if o.startswith("--")]
        assert [o for o in options if o not in listed] == [], path
    assert "Example: `psa demo my_demo`" in parts["psa demo"]


def test_the_gallery_lists_every_effect() -> None:
    items = [row[0].replace("<wbr>", "") for row in overview().rows]
    assert items == [f"[<code>{name}</code>](#{name})" for name in psa.EFFECTS]


def test_an_effect_has_equation_picture_source_and_parameters() -> None:
    effect = psa.EFFECTS["backlash"]
    text = section(effect)
    assert effect.equation_text.split(",  ", maxsplit=1)[0] in text
    assert f"]({PICTURES}/backlash.png)" in text
    assert "](playground.html#backlash)" in text
    assert effect.source[1:] in text
    assert all(f"| {p.name} | {p.unit} |" in text for p in effect.parameters)


@pytest.mark.parametrize("name", copied_pages.RECIPES)
def test_a_recipe_is_a_page_with_its_scripts(name: str) -> None:
    page = copied_pages.recipe_page(name)
    for script in examples()[name].scripts:
        assert f'```{script.language} title="{script.name}"\n{script.text}```' in page
    assert f"`psa examples {name} -o FOLDER`" in page


def test_every_page_is_in_the_menu() -> None:
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("nav:\n")[2]
    names = yaml.safe_load(f"nav:\n{menu}")["nav"]
    pages = {p for section in names for entry in section.values() for p in _pages(entry)}
    written = {p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md")}
    assert written <= pages


def _pages(entry: object) -> list[str]:
    if isinstance(entry, str):
        return [entry]
    entries = entry.values() if isinstance(entry, dict) else entry
    assert not isinstance(entries, str)
    return [page for e in entries for page in _pages(e)]  # type: ignore[attr-defined]


def test_the_page_of_json_files_holds_every_member_of_every_schema() -> None:
    assert set(WRITTEN_BY) == set(FILES)
    for name in FILES:
        schema = json.loads(schema_texts()[f"{name}.schema.json"])
        text = schema_section(name, schema)
        records = [schema, *schema.get("$defs", {}).values()]
        members = [member for record in records for member in record.get("properties", ())]
        assert [m for m in members if f"| `{m}` |" not in text] == []
        linked = set(re.findall(r"\]\(#([\w-]+)\)", text))
        assert linked == set(re.findall(r"\{ #([\w-]+) \}", text))


def test_the_page_of_ports_has_every_port_with_its_sign() -> None:
    text = "\n".join(ports_page.sections())
    for name in psa.PARTS:
        rows = text.split(f"### `{name}`\n")[1].split("\n#")[0]
        for port in (*psa.part_model(name).input_names, *psa.part_model(name).output_names):
            assert f"| `{port}` |" in rows
    for effect in psa.EFFECTS.values():
        assert all(f"| `{i.name}` | in | {i.unit} |" in text for i in effect.inputs)
    assert "| `load_force` | in | N | 0 |" in text
    names = {i.name for c in psa.COMPONENTS.values() for i in c.inputs}
    names |= {o.name for c in psa.COMPONENTS.values() for o in c.outputs}
    assert names <= {*re.findall(r"^\|.*?`(\w+)` \| (?:in|out) \|", text, re.MULTILINE)}


def test_the_page_of_python_has_every_public_name_once() -> None:
    written = " ".join(python_page.SECTIONS.values()).split()
    assert len(written) == len({*written})
    names = {n.removeprefix("design.") for n in written}
    assert names == {*psa.__all__, *psa.design.__all__, *psa.online.__all__, *psa.system.__all__}
    text = python_page.with_names((ROOT / "docs" / "python.md").read_text(encoding="utf-8"))
    assert text.count("\n::: psa_casadi.") == len(names) + 2  # two have a second form
    with pytest.raises(ValueError, match="headings of python"):
        python_page.with_names("# Python\n\n## Records\n")
