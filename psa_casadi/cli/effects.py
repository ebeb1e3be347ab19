"""`psa effects`: what real stacks do that the base model does not."""

import difflib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.completion import names
from psa_casadi.cli.screen import EffectsOption, show, show_table, tell_written, width

if TYPE_CHECKING:
    from psa_casadi.cli.inputs import Given
    from psa_casadi.component import Component
    from psa_casadi.diagnosis.remedy import Size
    from psa_casadi.model.compose import Model


def effects(
    name: Annotated[
        str | None, typer.Argument(help="Name of one effect.", autocompletion=names("effects"))
    ] = None,
    figure: Annotated[
        Path | None,
        typer.Option(help="PNG picture of the effect's signature to write; needs NAME."),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(help="MODEL.json of the stack for which NAME's size is told."),
    ] = None,
    modules: EffectsOption = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print names only.")] = False,
) -> None:
    """List the effects that a diagnosis looks for; show one: equation, signature, size, remedy."""
    from psa_casadi.cli.inputs import Given
    from psa_casadi.effects.mechanics import MODAL_SERIES
    from psa_casadi.model.own_effects import known_effects
    from psa_casadi.report.words.tables import effects_table
    from psa_casadi.report.words.text import effect_page

    given = Given(modules)
    listed = known_effects(given.effects)
    known = {**listed, **{e.name: e for e in MODAL_SERIES.values()}}
    stack = given.model(model)
    wanted = _known(given, name, list(known), figure)
    if wanted is None:
        if quiet:
            show("\n".join(listed))
        else:
            show_table(effects_table(listed.values()))
        return
    if figure is not None:
        _draw(known[wanted], figure)
    show(wanted if quiet else effect_page(known[wanted], width(), _seen(known[wanted], stack)))
    tell_written(figure, quiet=quiet)


def _known(given: "Given", name: str | None, names: list[str], figure: Path | None) -> str | None:
    """Return the effect that is meant; InputError with every mistake if it or the path is bad."""
    wanted = None
    given.outputs({"--figure": figure}, [])
    if name is None and figure is not None:
        given.add(
            "--figure draws one effect and none is named; say which, as in"
            f" `psa effects {names[0]} --figure {figure}`."
        )
    if name is not None:
        wanted = name.strip().lower().replace("-", "_").replace(" ", "_")
        if wanted not in names:
            near = difflib.get_close_matches(wanted, names, n=3, cutoff=0.4)
            meant = (
                f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(names)}."
            )
            given.add(f"There is no effect named '{name}'; {meant}")
    given.check()
    return wanted


def _seen(effect: "Component", stack: "Model | None") -> "tuple[Model, tuple[Size, ...]] | None":
    """Return how large an effect is on a stack, None where there is no compiler to simulate it."""
    from psa_casadi.diagnosis.remedy import example
    from psa_casadi.errors import MachineError

    try:
        return example(effect, stack)
    except MachineError:
        return None


def _draw(effect: "Component", path: Path) -> None:
    from psa_casadi.diagnosis.signature import signature
    from psa_casadi.report.plots.figures import save_signature

    save_signature(effect, signature(effect), path)
