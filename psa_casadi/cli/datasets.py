"""`psa datasets`: public records, with source and licence."""

from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.completion import names
from psa_casadi.cli.screen import show, show_table, tell_written, working


def datasets(
    name: Annotated[
        str | None, typer.Argument(help="Name of one dataset.", autocompletion=names("datasets"))
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Folder to write its records to, as CSV files."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print names only.")] = False,
) -> None:
    """List public records; show the source and licence of one; write its records to a folder.

    Records come from the folder that PSA_CASADI_DATA names; where it is not set, they are
    downloaded from their authors and checked.
    """
    from psa_casadi.datasets import DATASETS, copy, find, origin_text
    from psa_casadi.errors import InputError
    from psa_casadi.report.words.tables import Table

    if name is None:
        if output is not None:
            raise InputError("--output needs the name of a dataset; `psa datasets` lists them.")
        if quiet:
            show("\n".join(DATASETS))
            return
        rows = tuple(
            (d.name, str(len(d.files)), d.licence, d.description) for d in DATASETS.values()
        )
        show_table(Table(("dataset", "records", "licence", "holds"), rows))
        return
    dataset = find(name)
    if output is None:
        show(name if quiet else origin_text(dataset))
        return
    with working(f"fetching {name}", quiet):
        written = copy(name, output)
    tell_written(*written, quiet=quiet)
