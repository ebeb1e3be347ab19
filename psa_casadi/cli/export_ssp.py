"""`psa export ssp`: a closed-loop nanopositioner around a stack as an SSP archive."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.completion import names
from psa_casadi.cli.screen import (
    AuthorOption,
    CopyrightOption,
    EffectsOption,
    LicenseOption,
    ModelOption,
    ModelVersionOption,
    Quiet,
    show,
    tell_written,
    working,
)

if TYPE_CHECKING:
    from psa_casadi.export.ssp.structure import WiredParts

#: The stack of a system for which no model is given.
DEFAULT_STACK = "P-885.51"


def ssp(
    output: Annotated[Path, typer.Option("-o", "--output", help="SSP archive to write.")],
    model: ModelOption = None,
    stack: Annotated[
        str | None,
        typer.Option(
            "--stack",
            help="Named stack in place of a model; `psa stacks` lists them.",
            show_default=DEFAULT_STACK,
            autocompletion=names("stacks"),
        ),
    ] = None,
    no_compensator: Annotated[
        bool, typer.Option("--no-compensator", help="Leave the hysteresis compensator out.")
    ] = False,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the wiring to write, .svg or .png.")
    ] = None,
    platforms: Annotated[
        str, typer.Option(help="host, all, or names such as x86_64-linux,x86_64-windows.")
    ] = "host",
    author: AuthorOption = None,
    version: ModelVersionOption = None,
    copyright_: CopyrightOption = None,
    license_: LicenseOption = None,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Write a nanopositioner as SSP: controller, compensator, amplifier, stack, flexure, wired."""
    from psa_casadi.cli.inputs import Given
    from psa_casadi.export.fmu.platforms import chosen_platforms
    from psa_casadi.export.ssp.archive import export_ssp, layout_of, save_wiring, wiring_of
    from psa_casadi.model.nanopositioner import nanopositioner

    given = Given(effects)
    given.outputs({"--output": output, "--picture": picture}, [model])
    if picture is not None and picture.suffix.lower() not in (".svg", ".png"):
        given.add(f"{picture}: a picture of the wiring is .svg or .png; name it so.")
    wanted = [p.strip() for p in platforms.split(",") if p.strip()]
    given.attempt(lambda: chosen_platforms(wanted))
    chosen = given.model_or_stack(model, stack or (DEFAULT_STACK if model is None else None))
    chosen = given.published(
        chosen, author=author, version=version, copyright=copyright_, license=license_
    )
    system = None
    if chosen is not None:
        system = given.attempt(lambda: nanopositioner(chosen, compensated=not no_compensator))
    given.check()
    if chosen is None or system is None:
        return
    with working("compiling", quiet) as progress:
        progress(", ".join(system.parts))
        export_ssp(system, output, platforms=wanted, publication=chosen.publication)
    wiring = wiring_of(system)
    if picture is not None:
        save_wiring(wiring, layout_of(wiring), picture)
    show(f"parts: {', '.join(system.parts)}", quiet)
    _ports(wiring, quiet)
    _steps(wiring, quiet)
    tell_written(output, picture, quiet=quiet)


def _ports(wiring: "WiredParts", quiet: bool) -> None:
    from psa_casadi.export.ssp.drawing import OUTSIDE, Port

    for kind in ("input", "output"):
        named = [
            f"{name} [{wiring.unit(Port(OUTSIDE, name))}]"
            for name, found in wiring.ports(OUTSIDE)
            if found == kind
        ]
        show(f"{kind}s: {', '.join(named)}", quiet)


def _steps(wiring: "WiredParts", quiet: bool) -> None:
    from psa_casadi.export.ssp.steps import stable_step

    if quiet:
        return
    held, sloped = (1e6 * stable_step(wiring, rates=rates) for rates in (False, True))
    show(
        f"communication step: unstable above {held:.3g} us with inputs held over a step, above"
        f" {sloped:.3g} us with input derivatives"
    )
