"""`psa export c`: a model as two files of C for a controller."""

from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import (
    AuthorOption,
    CopyrightOption,
    EffectsOption,
    HistoryOption,
    LicenseOption,
    ModelVersionOption,
    Quiet,
    RestOption,
    StackOption,
    StartVoltageOption,
    SweepOption,
    show,
    show_inside,
    show_table,
    tell_written,
    working,
)

if TYPE_CHECKING:
    from psa_casadi.report.words.tables import Table


class PrecisionName(StrEnum):
    """Precisions of the numbers."""

    DOUBLE = "double"
    SINGLE = "single"


class Hold(StrEnum):
    """What inputs do over a step."""

    LINEAR = "linear"
    ZERO = "zero"


def c(
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the two files.")],
    step: Annotated[str, typer.Option(help="Time of a step with its unit, such as 10us.")],
    model: Annotated[Path | None, typer.Option(help="MODEL.json to export.")] = None,
    stack: StackOption = None,
    part: Annotated[
        str | None,
        typer.Option(
            help="Part to export, tuned to the stack of --stack or --model where one is given:"
            " position_controller, hysteresis_compensator, hysteresis_observer, feed_forward,"
            " adaptive_feed_forward, online_identification. Others have their default values:"
            " flexure_stage, voltage_amplifier, charge_amplifier, prestress_mechanism."
        ),
    ] = None,
    precision: Annotated[
        PrecisionName, typer.Option(help="Precision of all numbers.")
    ] = PrecisionName.DOUBLE,
    hold: Annotated[
        Hold, typer.Option(help="Inputs reached at a step's end on a line, or held over it.")
    ] = Hold.LINEAR,
    substeps: Annotated[
        int | None,
        typer.Option(help="Equal parts of a step; by default as few as err by less than 0.1 %."),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of files and functions; by default the model's name.")
    ] = None,
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
    """Write a model as C99 for a controller: a step of fixed length and constant cost."""
    from psa_casadi.cli.inputs import Given, step_seconds
    from psa_casadi.export.fixed_step.code import limit_words
    from psa_casadi.export.fixed_step.export import export_c
    from psa_casadi.online import part_for

    given = Given(effects)
    seconds = given.attempt(lambda: step_seconds(step))
    base = chosen = None
    if part is None or model or stack:
        base = chosen = given.model_or_stack(model, stack, any_model=True)
    if part is not None and seconds is not None and bool(model or stack) == (base is not None):
        chosen = given.attempt(lambda: part_for(part, base, period=seconds))
    chosen = given.started(chosen, start_voltage, history, sweep=sweep, rest=rest)
    chosen = given.published(
        chosen, author=author, version=version, copyright=copyright_, license=license_
    )
    given.check()
    if chosen is None or seconds is None:
        return
    with working("generating", quiet) as progress:
        progress("compiling and comparing")
        found = export_c(
            chosen, output, step=seconds, precision=precision.value, name=name,
            include_sensor=include_sensor, hold=hold.value, substeps=substeps,
        )  # fmt: skip
    show_inside(chosen, include_sensor=include_sensor, quiet=quiet)
    for note in chosen.provenance.notes if part else ():
        show(note, quiet)
    show(step_words(seconds, found.substeps, precision.value), quiet)
    show_table(error_table({e.voltage: e.error for e in found.errors}), quiet)
    show(limit_words(found.limit), quiet)
    tell_written(found.header, found.source, quiet=quiet)


def step_words(step: float, substeps: int, precision: str) -> str:
    """Say what a fixed step is."""
    each = "1 substep" if substeps == 1 else f"{substeps} substeps"
    return f"step: {step:g} s, {each}, {precision} precision"


def error_table(errors: Mapping[str, float]) -> "Table":
    """Return a table of the errors of a fixed step by reference voltage."""
    from psa_casadi.report.words.tables import Table

    rows = tuple((voltage, f"{error:.1e}") for voltage, error in errors.items())
    return Table(("voltage", "largest error over the range"), rows)
