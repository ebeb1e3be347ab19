"""What examples and recipes there are: their titles, sources, scripts, and how to run one.

An example is a module of this package with a docstring and a function `main(folder)`, which leaves
its files in the folder and returns its figures. A recipe is a page in `recipes/`; its code blocks
that are named after their language (```matlab run_stack.m) are scripts to take away.
"""

import pkgutil
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module, resources
from pathlib import Path

from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_write

_PACKAGE = "psa_casadi.examples"
_NOT_EXAMPLES = ("index", "linearisation_trial")
_BLOCK = re.compile(r"^```(\w+) +(\S+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Script:
    """A file that a page shows: its language, its name, its text."""

    language: str
    name: str
    text: str


@dataclass(frozen=True)
class Example:
    """An example or a recipe: its name, its title in one line, its text."""

    name: str
    kind: str
    title: str
    text: str

    @property
    def file_name(self) -> str:
        """Name of the file that its text is copied to."""
        return f"{self.name}.{'py' if self.kind == 'example' else 'md'}"

    @property
    def scripts(self) -> tuple[Script, ...]:
        """The scripts of a recipe, in the order of the page."""
        if self.kind != "recipe":
            return ()
        return tuple(Script(*result) for result in _BLOCK.findall(self.text))


@cache
def examples() -> Mapping[str, Example]:
    """Return all examples and then all recipes by their names, each group sorted."""
    folder = resources.files(_PACKAGE)
    table = {}
    for module in sorted(pkgutil.iter_modules([str(folder)]), key=lambda m: m.name):
        if module.name in _NOT_EXAMPLES or module.ispkg:
            continue
        text = folder.joinpath(f"{module.name}.py").read_text(encoding="utf-8")
        title = text.split('"""')[1].strip().split("\n")[0].rstrip(".")
        table[module.name] = Example(module.name, "example", title, text)
    pages = folder.joinpath("recipes")
    for page in sorted(pages.iterdir(), key=lambda p: p.name):
        if page.name.endswith(".md"):
            text = page.read_text(encoding="utf-8")
            name = page.name.removesuffix(".md")
            title = text.split("\n")[0].removeprefix("# ")
            table[name] = Example(name, "recipe", title, text)
    return table


def run_example(name: str, folder: Path) -> object:
    """Run an example; it leaves its files in the folder, which must exist. Return what it returns.

    Raises InputError for a name that is no example.
    """
    example = examples().get(name)
    if example is None or example.kind != "example":
        runnable = [e.name for e in examples().values() if e.kind == "example"]
        raise InputError(f"There is no example named '{name}' to run; there are {runnable}.")
    return import_module(f"{_PACKAGE}.{name}").main(folder)


def copy_example(example: Example, folder: Path) -> tuple[Path, ...]:
    """Write an example's or a recipe's text, and its scripts, to a folder that exists."""
    texts = {example.file_name: example.text} | {s.name: s.text for s in example.scripts}
    for name, text in texts.items():
        atomic_write(folder / name, text)
    return tuple(folder / name for name in texts)
