"""`psa export ssp`: a closed-loop nanopositioner around a stack as an SSP archive."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

import psa_casadi as psa
from psa_casadi.cli.inputs import Given
from psa_casadi.cli.options import Published, names
from psa_casadi.cli.screen import show, tell_written, working

#: The stack of a system for which no model is given.
DEFAULT_STACK = "P-885.51"


def ssp(
    *,
    output: Path,
    model: Path | None = None,
    stack: Annotated[
        str | None, typer.Option(show_default=DEFAULT_STACK, autocompletion=names("stacks"))
    ] = None,
    no_compensator: bool = False,
    picture: Path | None = None,
    platforms: str = "host",
    published: Published,
    given: Given,
) -> None:
    """Write a nanopositioner as SSP: controller, compensator, amplifier, stack, flexure, wired.

    Options:
        output: SSP archive to write.
        stack: Named stack in place of a model; `psa stacks` lists them.
        no_compensator: Leave the hysteresis compensator out.
        picture: Picture of the wiring to write, .svg or .png.
    """
    from psa_casadi.export.fmu.platforms import chosen_platforms
    from psa_casadi.export.ssp import OUTSIDE, Port, layout_of, save_wiring, stable_step, wiring_of

    given.outputs({"--output": output, "--picture": picture}, [model])
    if picture is not None and picture.suffix.lower() not in (".svg", ".png"):
        given.add(f"{picture}: a picture of the wiring is .svg or .png; name it so.")
    wanted = [p.strip() for p in platforms.split(",") if p.strip()]
    given.attempt(lambda: chosen_platforms(wanted))
    chosen = given.model_or_stack(model, stack or (DEFAULT_STACK if model is None else None))
    chosen = given.published(chosen, published)
    system = None
    if chosen is not None:
        made = partial(psa.nanopositioner, chosen, compensated=not no_compensator)
        system = given.attempt(made)
    chosen, system = given.ready(chosen), given.ready(system)
    with working("compiling", given.quiet) as progress:
        progress(", ".join(system.parts))
        psa.export_ssp(system, output, platforms=wanted, publication=chosen.publication)
    wiring = wiring_of(system)
    if picture is not None:
        save_wiring(wiring, layout_of(wiring), picture)
    show(f"parts: {', '.join(system.parts)}", given.quiet)
    for kind in ("input", "output"):
        ports = [n for n, found in wiring.ports(OUTSIDE) if found == kind]
        named = (f"{n} [{wiring.unit(Port(OUTSIDE, n))}]" for n in ports)
        show(f"{kind}s: {', '.join(named)}", given.quiet)
    if not given.quiet:
        held, sloped = (1e6 * stable_step(wiring, rates=rates) for rates in (False, True))
        show(
            f"communication step: unstable above {held:.3g} us with inputs held over a step, above"
            f" {sloped:.3g} us with input derivatives"
        )
    tell_written(output, picture, quiet=given.quiet)
