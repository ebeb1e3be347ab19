"""`psa examples`: worked examples and recipes for other tools, shown, copied or run."""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.completion import names
from psa_casadi.cli.screen import Quiet, show, show_table, tell_written, working

if TYPE_CHECKING:
    from psa_casadi.examples.index import Example


def examples(
    name: Annotated[
        str | None,
        typer.Argument(help="Name of an example or a recipe.", autocompletion=names("examples")),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Folder for its files; it is created."),
    ] = None,
    copy_only: Annotated[
        bool, typer.Option("--copy-only", help="Copy the files to the folder, run nothing.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """List examples and recipes; show one; with -o copy it to a folder and run an example there."""
    from psa_casadi.examples.index import copy_example, run_example
    from psa_casadi.examples.index import examples as known
    from psa_casadi.files import make_folder

    found = _chosen(name, output, copy_only)
    if found is None:
        if quiet:
            show("\n".join(known()))
        else:
            _list(known())
        return
    if output is None:
        show(found.text.rstrip("\n"))
        return
    make_folder(output)
    before = {p.name for p in output.iterdir()}
    written = copy_example(found, output)
    result: object = None
    if found.kind == "example" and not copy_only:
        with working(f"running {found.name}", quiet):
            result = run_example(found.name, output)
    _tell(result, quiet)
    new = sorted(p for p in output.iterdir() if p.name not in before and p not in written)
    tell_written(*written, *new, quiet=quiet)


def _chosen(name: str | None, output: Path | None, copy_only: bool) -> "Example | None":
    """Return what is meant; InputError with every mistake."""
    from psa_casadi.cli.inputs import Given
    from psa_casadi.examples.index import examples as known

    given = Given()
    if name is None and output is not None:
        given.add("-o needs the name of an example or a recipe; `psa examples` lists them.")
    if copy_only and output is None:
        given.add("--copy-only needs a folder to copy to; name it with -o.")
    found = None
    if name is not None:
        wanted = name.strip().lower().replace("-", "_").removesuffix(".py").removesuffix(".md")
        found = known().get(wanted)
        if found is None:
            near = difflib.get_close_matches(wanted, list(known()), n=3, cutoff=0.4)
            meant = f"did you mean {' or '.join(near)}?" if near else "`psa examples` lists them."
            given.add(f"There is no example or recipe named '{name}'; {meant}")
    given.check()
    return found


def _list(found: "Mapping[str, Example]") -> None:
    from psa_casadi.report.words.tables import Table

    rows = tuple((e.name, e.kind, e.title) for e in found.values())
    show_table(Table(("name", "kind", "what it shows"), rows))
    show("\npsa examples NAME shows one; psa examples NAME -o FOLDER copies it and runs an example")


def _tell(result: object, quiet: bool) -> None:
    """Show what an example found: a text as it is, named figures one in each line."""
    if isinstance(result, Mapping):
        show("\n".join(f"{name}: {_figure(value)}" for name, value in result.items()), quiet)
    elif isinstance(result, str):
        show(result, quiet)


def _figure(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
