"""`psa effects`: what real stacks do that the base model does not."""

import difflib
from typing import Annotated

import typer

from psa_casadi.cli.screen import show, show_table, width


def effects(
    name: Annotated[str | None, typer.Argument(help="Name of one effect.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print names only.")] = False,
) -> None:
    """List the effects that a diagnosis looks for; show one with equation, signature and source."""
    from psa_casadi.effects import EFFECTS
    from psa_casadi.errors import InputError
    from psa_casadi.report.tables import effects_table
    from psa_casadi.report.text import effect_page

    if name is None:
        if quiet:
            show("\n".join(EFFECTS))
        else:
            show_table(effects_table(EFFECTS.values()))
        return
    wanted = name.strip().lower().replace("-", "_").replace(" ", "_")
    if wanted not in EFFECTS:
        near = difflib.get_close_matches(wanted, EFFECTS, n=3, cutoff=0.4)
        meant = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(EFFECTS)}."
        raise InputError(f"There is no effect named '{name}'; {meant}")
    show(wanted if quiet else effect_page(EFFECTS[wanted], width()))
