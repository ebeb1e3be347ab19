"""`psa stacks`: stacks by name, with the sources of their figures."""

import textwrap
from typing import Annotated

import typer

import psa_casadi as psa
from psa_casadi.cli.options import names
from psa_casadi.cli.screen import show, show_table, width


def stacks(
    name: Annotated[str | None, typer.Argument(autocompletion=names("stacks"))] = None,
    *,
    quiet: bool = False,
) -> None:
    """List the stacks that can be used by name; show the figures of one with their sources.

    Options:
        quiet: Print names only.
        name: Name of one stack.

    Example:
        psa stacks P-885.51
    """
    from psa_casadi.report.words.tables import stack_table, stacks_table

    description = psa.stack_model(name).description if name is not None else ""
    if quiet:
        show(name or "\n".join(psa.STACKS))
    elif name is None:
        show_table(stacks_table(psa.STACKS.values()))
    else:
        show(textwrap.fill(f"{name}: {description}", width()) + "\n")
        show_table(stack_table(psa.STACKS[name]))
