"""Hook of mkdocs: the page of JSON files is made from the schemas that the package ships."""

import json
from collections.abc import Mapping
from typing import Any

from mkdocs.structure.files import File, Files

from build_scripts.effects_page import markdown_table
from build_scripts.schemas import schema_texts
from psa_casadi.report.words.tables import Table

PAGE, FOLDER = "json.md", "schemas"
#: What writes each file, by the name of its schema.
WRITTEN_BY = {
    "model": "`psa identify -o`, `psa diagnose -o`, `psa.save_model`",
    "diagnosis": "`psa diagnose --json`",
    "own_model": "`psa.diagnose(model, records).to_json()`",
    "identification": "`psa identify --json`",
    "posterior": "`psa sample --json`",
    "check": "`psa check --json`",
    "device": "`psa batch`, in the folder of each device",
}
_COUNTED = ("string", "number", "integer")
Schema = Mapping[str, Any]


def on_files(files: Files, *, config: Any, **_: Any) -> Files:
    """Add the schemas themselves to the files of the site."""
    for name, text in schema_texts().items():
        files.append(File.generated(config, f"{FOLDER}/{name}", content=text))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return the text of a page, the one of JSON files with all schemas below."""
    if page.file.src_uri != PAGE:
        return markdown
    texts = {name.partition(".")[0]: text for name, text in schema_texts().items()}
    sections = (section(name, json.loads(texts[name])) for name in WRITTEN_BY)
    return "\n\n".join([markdown, *sections])


def section(name: str, schema: Schema) -> str:
    """Return one file in Markdown: what writes it, its members, and the records inside it."""
    file = f"{name}.schema.json"
    link = f"[`{file}`]({FOLDER}/{file})"
    parts = [
        f"## {name.capitalize().replace('_', ' ')}",
        f"{schema['description']} Written by {WRITTEN_BY[name]}; schema: {link}.",
        markdown_table(_members(name, schema)),
    ]
    for record, inner in schema.get("$defs", {}).items():
        parts += [f"### {record} {{ #{_anchor(name, record)} }}", inner["description"]]
        parts += [markdown_table(_members(name, inner))] if "properties" in inner else []
    return "\n\n".join(parts)


def kind(name: str, schema: Schema) -> str:
    """Return the allowed values in words; records link to their description."""
    if "$ref" in schema:
        record = schema["$ref"].rpartition("/")[2]
        return f"[{record}](#{_anchor(name, record)})"
    values = [schema["const"]] if "const" in schema else schema.get("enum", [])
    if values:
        return ", ".join(f"`{json.dumps(value)}`" for value in values)
    if "anyOf" in schema:
        return " or ".join(kind(name, s) for s in schema["anyOf"])
    if "prefixItems" in schema:
        return f"[{', '.join(kind(name, s) for s in schema['prefixItems'])}]"
    if schema.get("type") == "array":
        kinds = [kind(name, s) for s in schema["items"].get("anyOf", [schema["items"]])]
        return f"list of {' or '.join(k + 's' * (k in _COUNTED) for k in kinds)}"
    named = schema.get("additionalProperties")
    return f"by name: {kind(name, named)}" if named else str(schema.get("type", "anything"))


def _members(name: str, schema: Schema) -> Table:
    needed = schema.get("required", ())
    rows = tuple(
        (f"`{member}`", kind(name, inner), "yes" if member in needed else "")
        for member, inner in schema["properties"].items()
    )
    return Table(("member", "value", "always there"), rows)


def _anchor(name: str, record: str) -> str:
    return f"{name}-{record}".lower()
