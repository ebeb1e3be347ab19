"""`psa export modelica`: a model as a Modelica package."""

from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.screen import (
    AuthorOption,
    CopyrightOption,
    EffectsOption,
    HistoryOption,
    LicenseOption,
    ModelOption,
    ModelVersionOption,
    PartOption,
    Quiet,
    RestOption,
    StackOption,
    StartVoltageOption,
    SweepOption,
    show,
    show_inside,
    tell_written,
)


def modelica(
    output: Annotated[Path, typer.Option("-o", "--output", help="Modelica file to write.")],
    model: ModelOption = None,
    stack: StackOption = None,
    part: PartOption = None,
    name: Annotated[str, typer.Option(help="Name of the package.")] = "PiezoStack",
    include_sensor: Annotated[
        bool, typer.Option("--include-sensor", help="Keep effects of sensor and environment.")
    ] = False,
    start_voltage: StartVoltageOption = None,
    history: HistoryOption = None,
    sweep: SweepOption = 1.0,
    rest: RestOption = 0.0,
    author: AuthorOption = None,
    version: ModelVersionOption = None,
    copyright_: CopyrightOption = None,
    license_: LicenseOption = None,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Write a model as a Modelica package: signals, connectors, examples in one file."""
    from psa_casadi.cli.inputs import Given
    from psa_casadi.export.modelica.package import class_names, export_modelica

    given = Given(effects)
    given.outputs({"--output": output}, [model])
    chosen = given.model_or_stack(model, stack, part=part, any_model=True)
    chosen = given.started(chosen, start_voltage, history, sweep=sweep, rest=rest)
    chosen = given.published(
        chosen, author=author, version=version, copyright=copyright_, license=license_
    )
    given.check()
    if chosen is None:
        return
    export_modelica(chosen, output, name=name, include_sensor=include_sensor)
    kept = show_inside(chosen, include_sensor=include_sensor, quiet=quiet)
    show(f"classes: {', '.join(f'{name}.{c}' for c in class_names(kept))}", quiet)
    tell_written(output, quiet=quiet)
