"""Hook of mkdocs: pages whose text is kept elsewhere, once: recipes, and pages of the checkout."""

import re
from typing import Any

from mkdocs.structure.files import File, Files

from build_scripts.measured_data import ROOT
from psa_casadi.examples.index import examples

#: The how-to pages are recipes of `psa examples`, whose tests run what can be run.
RECIPES = ("simulink", "dymola", "openmodelica", "omsimulator", "fmpy", "own_effect")
CHECKOUT = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}

_NAMED_BLOCK = re.compile(r"^```(\w+) +(\S+)$", re.MULTILINE)
_TITLE = re.compile(r"\A# .*\n")
#: Links that lead to files of the checkout, which the site has as pages.
_RECIPE_LINK = re.compile(r"\]\((?:\.\./)+psa_casadi/examples/recipes/(\w+\.md)")
_NOTEBOOK_LINK = re.compile(r"(\]\([\w./]+)\.ipynb\b")


def on_files(files: Files, *, config: Any, **_: Any) -> Files:
    """Add these pages to the files of the site."""
    for name in RECIPES:
        files.append(File.generated(config, f"howto/{name}.md", content=recipe_page(name)))
    for page, source in CHECKOUT.items():
        text = (ROOT / source).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Return the text of a page with its links to recipes and notebooks leading to their pages."""
    up = "../" * page.file.src_uri.count("/")
    return _NOTEBOOK_LINK.sub(r"\1.md", _RECIPE_LINK.sub(rf"]({up}howto/\1", markdown))


def recipe_page(name: str) -> str:
    """Return a recipe as a page: its scripts have their file names as titles."""
    text = _NAMED_BLOCK.sub(r'```\1 title="\2"', examples()[name].text)
    note = f"\n`psa examples {name} -o FOLDER` writes this page and its scripts to a folder.\n"
    return _TITLE.sub(lambda title: title[0] + note, text, count=1)
