"""`psa stacks`: stacks by name, with the sources of their figures."""

import textwrap
from typing import Annotated

import typer

from psa_casadi.cli.completion import names
from psa_casadi.cli.screen import show, show_table, width


def stacks(
    name: Annotated[
        str | None, typer.Argument(help="Name of one stack.", autocompletion=names("stacks"))
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print names only.")] = False,
) -> None:
    """List the stacks that can be used by name; show the figures of one with their sources."""
    from psa_casadi.model.stacks import STACKS, stack_model
    from psa_casadi.report.words.tables import stack_table, stacks_table

    if name is None:
        if quiet:
            show("\n".join(STACKS))
        else:
            show_table(stacks_table(STACKS.values()))
        return
    description = stack_model(name).description
    if quiet:
        show(name)
        return
    show(textwrap.fill(f"{name}: {description}", width()) + "\n")
    show_table(stack_table(STACKS[name]))
