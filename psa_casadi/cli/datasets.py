"""`psa datasets`: public records, with source and licence."""

from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.options import names
from psa_casadi.cli.screen import show, show_table, tell_written, working
from psa_casadi.errors import InputError


def datasets(
    name: Annotated[str | None, typer.Argument(autocompletion=names("datasets"))] = None,
    *,
    output: Path | None = None,
    quiet: bool = False,
) -> None:
    """List public records; show the source and licence of one; write its records to a folder.

    Records come from the folder that PSA_CASADI_DATA names; where it is not set, they are
    downloaded from their authors and checked.

    Options:
        quiet: Print names only.
        name: Name of one dataset.
        output: Folder to write its records to, as CSV files.

    Example:
        psa datasets micromanipulator -o records
    """
    from psa_casadi.datasets import DATASETS, copy, find, origin_text
    from psa_casadi.report.words.tables import Table

    if name is None and output is not None:
        raise InputError("--output needs the name of a dataset; `psa datasets` lists them.")
    if name is None and quiet:
        show("\n".join(DATASETS))
    elif name is None:
        each = DATASETS.values()
        rows = tuple((d.name, str(len(d.files)), d.licence, d.description) for d in each)
        show_table(Table(("dataset", "records", "licence", "holds"), rows))
    elif output is None:
        show(find(name).name if quiet else origin_text(find(name)))
    else:
        with working(f"fetching {name}", quiet):
            written = copy(name, output)
        tell_written(*written, quiet=quiet)
