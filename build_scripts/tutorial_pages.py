"""Hook of mkdocs: every notebook in `docs/tutorials/` is executed, and becomes a page.

A notebook is kept without outputs. A cell that fails ends the build.
"""

import os
import re
import sysconfig
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import nbformat
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import MarkdownExporter

FOLDER = "tutorials"
LIMIT_S = 600

_TITLE = re.compile(r"\A# .*\n")
#: A heading, or a picture that has no alternative text yet.
_HEADING_OR_PICTURE = re.compile(r"^#+ (?P<heading>.*)$|!\[(?:png|svg)\]\(", re.MULTILINE)


def on_files(files: Files, *, config: Any, **_: Any) -> Files:
    """Add the page of every notebook, and its pictures, to the files of the site."""
    for file in list(files):
        path = PurePosixPath(file.src_uri)
        if path.parent.name != FOLDER or path.suffix != ".ipynb":
            continue
        page, pictures = notebook_page(path.name, Path(str(file.abs_src_path)).read_text("utf-8"))
        page_uri = path.with_suffix(".md").as_posix()
        files.append(File.generated(config, page_uri, content=page))
        for name, content in pictures.items():
            uri = path.with_name(name).as_posix()
            files.append(File.generated(config, uri, content=content))
    return files


@cache
def notebook_page(name: str, text: str) -> tuple[str, Mapping[str, bytes]]:
    """Execute a notebook; return its page in Markdown and its pictures by their names.

    Raises:
        PluginError: a cell failed, or took longer than `LIMIT_S`.
    """
    notebook = nbformat.reads(text, as_version=4)
    binaries = sysconfig.get_path("scripts")
    path = os.pathsep.join((binaries, os.environ.get("PATH", os.defpath)))
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook,
            timeout=LIMIT_S,
            kernel_name="python3",
            coalesce_streams=True,
            extra_arguments=["--log-level=ERROR"],
            resources={"metadata": {"path": folder}},
        )
        try:
            client.execute(env=os.environ | {"PATH": path, "NO_COLOR": "1"})
        except (CellExecutionError, TimeoutError) as error:
            raise PluginError(f"The notebook {name} does not run:\n{error}") from error
    stem = name.removesuffix(".ipynb")
    page, resources = MarkdownExporter().from_notebook_node(
        notebook, {"output_files_dir": ".", "unique_key": stem}
    )
    note = f"\n*This page is a notebook: [download it]({name}), and run it where psa_casadi is.*\n"
    page = _TITLE.sub(lambda title: title[0] + note, described(page), count=1)
    return page, resources["outputs"]


def described(page: str) -> str:
    """Return a page whose pictures are described by the heading above them."""
    heading = ""

    def words(match: re.Match[str]) -> str:
        nonlocal heading
        if match["heading"] is None:
            return f"![Figure: {heading}]("
        heading = match["heading"]
        return match[0]

    return _HEADING_OR_PICTURE.sub(words, page)
