"""`psa web`: a page that runs a stack, for everyone who has a browser."""

from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.screen import EffectsOption, Quiet, StackOption, tell_written, working


def web(
    model: Annotated[
        Path | None,
        typer.Argument(help="MODEL.json to play with; by default the stack P-885.51."),
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="HTML page to write.")] = Path(
        "playground.html"
    ),
    stack: StackOption = None,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Write a page to play with a stack: any voltage, every effect, no network.

    It needs the compiler of the extra `compiler`; the page needs a browser alone.
    """
    from psa_casadi.cli.inputs import Given
    from psa_casadi.report.page.playground_page import write_playground

    given = Given(effects)
    given.outputs({"--output": output}, [model])
    chosen = None
    if model is not None or stack is not None:
        chosen = given.model_or_stack(model, stack)
    given.check()
    with working("compiling", quiet):
        write_playground(output, chosen)
    tell_written(output, quiet=quiet)
