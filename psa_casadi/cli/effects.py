"""`psa effects`: what real stacks do that the base model does not."""

import contextlib
from pathlib import Path
from typing import Annotated

import typer

import psa_casadi as psa
from psa_casadi.cli.inputs import Given, similar
from psa_casadi.cli.options import names
from psa_casadi.cli.screen import show, show_table, tell_written, width


def effects(
    name: Annotated[str | None, typer.Argument(autocompletion=names("effects"))] = None,
    *,
    figure: Path | None = None,
    model: Path | None = None,
    effects: list[str] | None = None,
    quiet: bool = False,
) -> None:
    """List the effects that a diagnosis looks for; show one: equation, signature, size, remedy.

    Options:
        quiet: Print names only.
        name: Name of one effect.
        figure: Picture of the effect's signature to write, PNG, SVG or PDF as its name ends; needs
            NAME.
        model: MODEL.json of the stack for which NAME's size is told.

    Example:
        psa effects slow_creep --figure creep.png
    """
    from psa_casadi.diagnosis.remedy import example
    from psa_casadi.diagnosis.signature import signature
    from psa_casadi.effects.mechanics import MODAL_SERIES
    from psa_casadi.model.own_effects import known_effects
    from psa_casadi.report.plots.figures import save_signature
    from psa_casadi.report.words.tables import effects_table
    from psa_casadi.report.words.text import effect_page

    inputs = Given(effects=effects)
    listed = known_effects(inputs.own)
    known = {**listed, **{e.name: e for e in MODAL_SERIES.values()}}
    stack, size = inputs.model(model), None
    wanted = (name or "").strip().lower().replace("-", "_").replace(" ", "_")
    inputs.outputs({"--figure": figure}, [])
    if name is None and figure is not None:
        inputs.add(
            "--figure draws one effect and none is named; say which, as in"
            f" `psa effects {next(iter(known))} --figure {figure}`."
        )
    if name is not None and wanted not in known:
        meant = similar(wanted, known, f"there are {', '.join(known)}.")
        inputs.add(f"There is no effect named '{name}'; {meant}")
    inputs.check()
    if name is None and quiet:
        show("\n".join(listed))
    elif name is None:
        show_table(effects_table(listed.values()))
    else:
        if figure is not None:
            save_signature(known[wanted], signature(known[wanted]), figure)
        if quiet:
            show(wanted)
        else:
            with contextlib.suppress(psa.MachineError):  # no compiler to simulate it
                size = example(known[wanted], stack)
            show(effect_page(known[wanted], width(), size))
        tell_written(figure, quiet=quiet)
