"""Hook of mkdocs: the page of effects is made from the table of effects."""

from typing import Any

from psa_casadi.component import Component
from psa_casadi.effects import EFFECTS
from psa_casadi.effects.modal_series import FEWEST, MODAL_SERIES
from psa_casadi.report.words.tables import Table, effect_parameter_table

PAGE = "effects.md"


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return the text of a page, the one of effects with all of them below."""
    if page.file.src_uri != PAGE:
        return markdown
    places = dict.fromkeys(e.belongs_to for e in EFFECTS.values())
    sections = [
        "\n\n".join(
            [f"## In the {place}", *(section(e) for e in EFFECTS.values() if e.belongs_to == place)]
        )
        for place in places
    ]
    return "\n\n".join([markdown, *sections, "## Several modes", section(MODAL_SERIES[FEWEST])])


def section(effect: Component) -> str:
    """Return one effect in Markdown: what it is, equation, signature, source, parameters."""
    return "\n\n".join(
        (
            f"### `{effect.name}`",
            f"{_sentence(effect.description)}",
            "```text\n" + effect.equation_text.replace(",  ", "\n") + "\n```",
            f"*What it looks like*: {_sentence(effect.looks_like)}",
            f"*Source*: {_sentence(effect.source)}",
            markdown_table(effect_parameter_table(effect)),
        )
    )


def markdown_table(table: Table) -> str:
    """Return a table in Markdown."""
    rows = [table.head, ["---"] * len(table.head), *table.rows]
    cells = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"
