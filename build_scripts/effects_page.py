"""Hook of mkdocs: the gallery of effects is made from the table of effects, and the playground."""

import re
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
from mkdocs.structure.files import File, Files

from psa_casadi.diagnosis.generic import effects_of
from psa_casadi.diagnosis.remedy import example, signature
from psa_casadi.model.component import Component
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.effects.mechanics import FEWEST, MODAL_SERIES
from psa_casadi.model.ode_model import ode_model
from psa_casadi.report.page.playground import playground
from psa_casadi.report.plots.figures import save_signature, size_sentence
from psa_casadi.report.words.remedy_words import effect_advice, effect_size
from psa_casadi.report.words.tables import Table, effect_parameter_table
from psa_casadi.simulation.sizes import Sizes

PAGE, PICTURES = "effects.md", "pictures/effects"
#: The page that runs every effect; its name with # and an effect starts with that effect.
PLAYGROUND = "playground.html"
#: The heading of the page below which the effects of any model are.
ANY_MODEL = "## Effects of any model"


def on_files(files: Files, *, config: Any, **_: Any) -> Files:
    """Add the picture of every effect's signature, and the playground, to the files of the site."""
    files.append(File.generated(config, PLAYGROUND, content=playground()))
    for name in EFFECTS:
        content, _caption = picture(name)
        files.append(File.generated(config, f"{PICTURES}/{name}.png", content=content))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return the text of a page, the one of effects with all of them below."""
    if page.file.src_uri != PAGE:
        return markdown
    stack, heading, any_model = markdown.partition(ANY_MODEL)
    parts = [
        stack.rstrip(),
        f"In the [playground]({PLAYGROUND}) each effect has a switch and sliders, under any"
        " voltage ([how](howto/web.md)).",
        markdown_table(overview()),
    ]
    for place in dict.fromkeys(e.belongs_to for e in EFFECTS.values()):
        parts.append(f"## In the {place}")
        parts += [section(e) for e in EFFECTS.values() if e.belongs_to == place]
    parts += ["## Several modes", section(MODAL_SERIES[FEWEST]), heading + any_model.rstrip()]
    return "\n\n".join([*parts, markdown_table(of_any_model())])


def overview() -> Table:
    """Return what every effect looks like, in a line each."""
    rows = tuple(  # a narrow column may break a name behind an underscore
        (f"[<code>{e.name.replace('_', '_<wbr>')}</code>](#{e.name})", e.belongs_to,
         _sentence(e.looks_like))
        for e in EFFECTS.values()
    )  # fmt: skip
    return Table(("effect", "in the", "what it looks like"), rows)


def of_any_model() -> Table:
    """Return one effect of each kind that a model's ports have: of a mass on a spring."""
    x, v, u, k = (ca.SX.sym(n) for n in ("x", "v", "u", "k"))
    ode = {"x": [x, v], "u": u, "p": k, "y": x, "ode": [v, u - k * x]}
    model = ode_model(ode, name="any", outputs=["y"], values={"k": 1.0})
    ones = dict.fromkeys(("x", "v", "u", "y"), 1.0)
    each: dict[str, tuple[str, ...]] = {}
    for effect in effects_of(model, Sizes(ones, ones, sample=1.0, duration=1.0)):
        c = effect.component
        fitted = [(p.name.removeprefix(f"{c.name}_"), p) for p in c.parameters if p.fitted]
        law = re.sub(r"\|(\w+)\|", r"abs(\1)", c.equation_text)
        row = (
            f"`{c.name}`",
            c.description.removeprefix(f"{effect.port.words}: "),
            f"`{law}`",
            "; ".join(f"`{name}` {p.description}" for name, p in fitted),
        )
        each.setdefault(re.split("_of_|_in_", effect.name)[0], row)
    return Table(("effect", "what it is", "equation", "parameters"), tuple(each.values()))


@cache
def picture(name: str) -> tuple[bytes, str]:
    """Return the picture of an effect's signature as PNG, and a sentence on its record."""
    effect = EFFECTS[name]
    observed = signature(effect)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "signature.png"
        save_signature(effect, observed, path)
        return path.read_bytes(), size_sentence(observed)


def section(effect: Component) -> str:
    """Return one effect in Markdown: description, equation, signature, remedy, parameters."""
    size, (remedy, record) = effect_size(effect, *example(effect)), effect_advice(effect)
    parts = [
        f"### `{effect.name}`",
        f"{_sentence(effect.description)}",
        "```text\n" + effect.equation_text.replace(",  ", "\n") + "\n```",
        f"*What it looks like*: {_sentence(effect.looks_like)}",
        f"*How large*: {_sentence(size)}",
        f"*What now*: {_sentence(remedy)}",
        f"*Record that shows it*: {_sentence(record)}",
        f"*Source*: {_sentence(effect.source)}",
        markdown_table(effect_parameter_table(effect)),
    ]
    if effect.name in EFFECTS:
        path, words = f"{PICTURES}/{effect.name}.png", picture(effect.name)[1]
        text = f"![Signature of {effect.name}. {words}]({path}){{ loading=lazy }}"
        parts.insert(4, f"[{text}]({path})")
        parts.insert(5, f"[Switch it on and change it]({PLAYGROUND}#{effect.name})")
    return "\n\n".join(parts)


def markdown_table(table: Table) -> str:
    """Return a table in Markdown."""
    rows = [table.head, ["---"] * len(table.head), *table.rows]
    cells = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"
