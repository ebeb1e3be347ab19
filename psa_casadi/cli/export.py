"""`psa export c`, `fmu` and `modelica`: a model in a format that other tools read."""

import json
import math
import zipfile
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
    show_table,
    tell_written,
    working,
)

if TYPE_CHECKING:
    from psa_casadi.model.compose import Model
    from psa_casadi.report.words.tables import Table


SensorOption = Annotated[
    bool, typer.Option("--include-sensor", help="Keep effects of sensor and environment.")
]


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
    include_sensor: SensorOption = False,
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


class FmiVersion(StrEnum):
    """Versions of the standard."""

    TWO = "2"
    THREE = "3"


class Solver(StrEnum):
    """Ways through a communication step."""

    ADAPTIVE = "adaptive"
    FIXED = "fixed"


def fmu(
    output: Annotated[Path, typer.Option("-o", "--output", help="FMU to write.")],
    model: ModelOption = None,
    stack: StackOption = None,
    part: PartOption = None,
    fmi: Annotated[FmiVersion, typer.Option(help="Version of the standard.")] = FmiVersion.TWO,
    platforms: Annotated[
        str, typer.Option(help="host, all, or names such as x86_64-linux,x86_64-windows.")
    ] = "host",
    solver: Annotated[
        Solver, typer.Option(help="adaptive: to a tolerance; fixed: steps of constant cost.")
    ] = Solver.ADAPTIVE,
    step: Annotated[
        str | None, typer.Option(help="Time of a fixed step with its unit, such as 10us.")
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Model identifier, a C name; by default the model's name.")
    ] = None,
    include_sensor: SensorOption = False,
    start_voltage: StartVoltageOption = None,
    parameter_sets: Annotated[
        int,
        typer.Option(
            help="Random parameter sets within the uncertainty to put inside, beside their mean and"
            " sigma points; 0 leaves all of them out.",
            min=0,
            max=999,
        ),
    ] = 20,
    sets_to: Annotated[
        Path | None,
        typer.Option("--sets-to", help="Folder to write the parameter sets to as well."),
    ] = None,
    validity_output: Annotated[
        bool,
        typer.Option(
            "--validity-output",
            help="Add the output outside_validity: how far a run has left what the records show.",
        ),
    ] = False,
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
    """Write a model as an FMU: FMI 2.0 or 3.0, co-simulation and model exchange in one archive."""
    from psa_casadi.cli.inputs import Given
    from psa_casadi.export.fixed_step.code import limit_words
    from psa_casadi.export.fmu.archive import export_fmu
    from psa_casadi.export.fmu.platforms import chosen_platforms
    from psa_casadi.export.fmu.sources import FIXED_ENTRY
    from psa_casadi.simulation.compiler import INSTALL_ZIG, has_zig

    given = Given(effects)
    given.outputs({"--output": output}, [model])
    if sets_to is not None and sets_to.exists() and not sets_to.is_dir():
        given.add(f"{sets_to}: is a file; name a folder for the parameter sets.")
    wanted = [p.strip() for p in platforms.split(",") if p.strip()]
    targets = given.attempt(lambda: chosen_platforms(wanted))
    seconds = given.fixed_step(step, wanted=solver is Solver.FIXED)
    chosen = given.model_or_stack(model, stack, part=part, any_model=True)
    chosen = given.started(chosen, start_voltage, history, sweep=sweep, rest=rest)
    chosen = given.published(
        chosen, author=author, version=version, copyright=copyright_, license=license_
    )
    given.check()
    if chosen is None or targets is None:
        return
    with working("compiling", quiet) as progress:
        progress(", ".join(t.name for t in targets))
        export_fmu(
            chosen,
            output,
            name=name,
            include_sensor=include_sensor,
            platforms=wanted,
            fmi=int(fmi),
            parameter_sets=parameter_sets,
            validity_output=validity_output,
            step=seconds,
        )
    kept = show_inside(chosen, include_sensor=include_sensor, quiet=quiet)
    sets = write_sets(kept, parameter_sets, sets_to)
    show(f"platforms: {', '.join(t.name for t in targets)}", quiet)
    show(f"start: {start_words(kept)}", quiet)
    if seconds is None:
        show(f"evidence: {evidence_words(kept, sets)}", quiet)
    else:
        with zipfile.ZipFile(output) as archive:
            fixed = json.loads(archive.read(FIXED_ENTRY))
        show(step_words(seconds, fixed["substeps"], "double"), quiet)
        show_table(error_table(fixed["errors"]), quiet)
        show(limit_words(fixed.get("voltage_limit", math.inf)), quiet)
    if not has_zig():
        show(
            "The binary is by this machine's compiler, for systems like this one; after"
            f" `{INSTALL_ZIG}` it loads on older ones too.",
            quiet,
        )
    tell_written(output, quiet=quiet)


def write_sets(model: "Model", samples: int, folder: Path | None) -> int:
    """Write the parameter sets to a folder, if one is named, and return how many there are."""
    from psa_casadi.export.fmu.evidence import set_files
    from psa_casadi.files import atomic_write, make_folder

    texts = set_files(model, samples)
    if folder is not None and texts:
        make_folder(folder)
        for place, text in texts.items():
            atomic_write(folder / place.rpartition("/")[2], text)
    return len(texts)


def evidence_words(model: "Model", sets: int) -> str:
    """Say what the FMU holds of what stands behind its values."""
    if model.evidence is None:
        return "none; a MODEL.json of `psa identify` or `psa diagnose` has it"
    of = ", ".join(r.record for r in model.evidence.runs)
    return f"documentation/evidence.html (records: {of}), {sets} parameter sets"


def start_words(model: "Model") -> str:
    """Say where an exported model starts."""
    voltage = next((i.start for i in model.structure.inputs if i.name == "voltage"), None)
    held = "" if voltage is None else f" at {voltage:.4g} V"
    if model.own_starts():
        return f"the start values of the model{held}, as its page lists them"
    settled = "; --start-voltage starts it settled" if voltage is not None else ""
    return f"relaxed{held}{settled}"


def modelica(
    output: Annotated[Path, typer.Option("-o", "--output", help="Modelica file to write.")],
    model: ModelOption = None,
    stack: StackOption = None,
    part: PartOption = None,
    name: Annotated[str, typer.Option(help="Name of the package.")] = "PiezoStack",
    include_sensor: SensorOption = False,
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
