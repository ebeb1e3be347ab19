"""`psa export c`, `fmu`, `modelica` and `ssp`: a model in a format that other tools read."""

import json
import math
import zipfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

import psa_casadi as psa
from psa_casadi.cli.inputs import Fitting, Inputs, own_model, step_seconds
from psa_casadi.cli.options import PartName, Published, StackName, Start, names
from psa_casadi.cli.screen import show, show_table, show_written, working
from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_write, make_folder

#: The stack of a system without a model.
DEFAULT_STACK = "P-885.51"


def c(
    *,
    output: Path,
    step: str,
    model: Path | None = None,
    stack: StackName = None,
    part: PartName = None,
    precision: Literal["double", "single"] = "double",
    hold: Literal["linear", "zero"] = "linear",
    substeps: int | None = None,
    name: str | None = None,
    include_sensor: bool = False,
    start: Start,
    published: Published,
    inputs: Inputs,
) -> None:
    """Write a model as C99 for a controller: a step of fixed length and constant cost.

    Options:
        output: Folder of the two files.
        step: Time of a step with its unit, such as 10us.
        model: MODEL.json to export.
        precision: Precision of all numbers.
        hold: Inputs reached at a step's end on a line, or held over it.
        substeps: Equal parts of a step; by default as few as err by less than 0.1 %.
        name: Name of files and functions; by default the model's name.

    Example:
        psa export c --stack P-885.51 --step 10us -o code
    """
    seconds = inputs.attempt(lambda: step_seconds(step))
    chosen = _chosen(inputs, model, stack, part, seconds)
    chosen = inputs.ready(inputs.published(inputs.started(chosen, start), published))
    period = inputs.ready(seconds)
    with working("generating") as progress:
        progress("compiling and comparing")
        code_export = psa.export_c(
            chosen, output, step=period, precision=precision, name=name,
            include_sensor=include_sensor, hold=hold, substeps=substeps,
        )  # fmt: skip
    _show_inside(chosen, include_sensor)
    for note in chosen.provenance.notes if part else ():
        show(note)
    errors = {e.voltage: e.error for e in code_export.errors}
    _show_step(f"{period:g} s", code_export.substeps, precision, errors, code_export.limit)
    show_written(code_export.header, code_export.source)


def _chosen(
    inputs: Inputs,
    model: Path | None,
    stack: str | None,
    part: str | None,
    period: float | None = None,
) -> "psa.Model | None":
    """Return the model or named stack, or a part, tuned to these where one is named."""
    base, named = None, model is not None or stack is not None
    if named or part is None:
        base = inputs.model_or_stack(model, stack, any_model=True)
    if part is None or (named and base is None):
        return base
    return inputs.attempt(lambda: psa.part_for(part, base, period=period))


def _show_inside(model: "psa.Model", include_sensor: bool) -> "psa.Model":
    """Print which components an export holds, and which it leaves out; return what it holds."""
    kept = model if include_sensor else model.plant()
    show(f"inside: {', '.join(c.name for c in kept.components)}")
    left_out = [c.name for c in model.components if c not in kept.components]
    if left_out:
        show(f"left out: {', '.join(left_out)} (--include-sensor keeps them)")
    return kept


def _show_step(
    step: str, substeps: int, precision: str, errors: Mapping[str, float], limit: float
) -> None:
    """Print what a fixed step is, its error by reference voltage, and up to where it holds."""
    from psa_casadi.export.fixed_step.code import limit_words
    from psa_casadi.report.words.tables import Table

    each = "1 substep" if substeps == 1 else f"{substeps} substeps"
    show(f"step: {step}, {each}, {precision} precision")
    rows = tuple((voltage, f"{error:.1e}") for voltage, error in errors.items())
    show_table(Table(("voltage", "largest error over the range"), rows))
    show(limit_words(limit))


def fmu(
    *,
    output: Path,
    model: Path | None = None,
    stack: StackName = None,
    part: PartName = None,
    fmi: Literal["2", "3"] = "2",
    platforms: str = "host",
    solver: Literal["adaptive", "fixed"] = "adaptive",
    step: str | None = None,
    name: str | None = None,
    include_sensor: bool = False,
    parameter_sets: Annotated[int, typer.Option(min=0, max=999)] = 20,
    sets_to: Path | None = None,
    validity_output: bool = False,
    start: Start,
    published: Published,
    inputs: Inputs,
) -> None:
    """Write a model as an FMU: FMI 2.0 or 3.0, co-simulation and model exchange in one archive.

    The file of an FMU's model becomes an FMU of FMI 2.0 that holds the original and the effects.

    Options:
        output: FMU to write.
        fmi: Version of the standard.
        solver: adaptive: to a tolerance; fixed: steps of constant cost.
        step: Time of a fixed step with its unit, such as 10us.
        name: Model identifier, a C name; by default the model's name.
        parameter_sets: Random parameter sets within the uncertainty to put inside, besides their
            mean and sigma points; 0 leaves all of them out.
        sets_to: Folder to write the parameter sets to as well.
        validity_output: Add the output outside_validity: how far a run has left what the records
            show.

    Example:
        psa export fmu --model extended.json -o stack.fmu
    """
    from psa_casadi.export.fmu.evidence import set_files
    from psa_casadi.export.fmu.platforms import chosen_platforms
    from psa_casadi.export.fmu.sources import FIXED_ENTRY
    from psa_casadi.simulation.compiler import INSTALL_ZIG, has_zig

    inputs.outputs({"--output": output}, [model], ("an FMU", ".fmu"))
    if sets_to is not None and sets_to.exists() and not sets_to.is_dir():
        inputs.add(f"{sets_to}: is a file; name a folder for the parameter sets.")
    wanted = [p.strip() for p in platforms.split(",") if p.strip()]
    targets = inputs.attempt(lambda: chosen_platforms(wanted))
    if (solver == "fixed") != (step is not None):
        inputs.add("--solver fixed and --step belong together; give both or neither.")
    seconds = (
        inputs.attempt(lambda: step_seconds(step))
        if step is not None and solver == "fixed"
        else None
    )
    chosen = _chosen(inputs, model, stack, part, seconds)
    chosen = inputs.ready(inputs.published(inputs.started(chosen, start), published))
    targets = inputs.ready(targets)
    if chosen.structure.foreign:
        _refuse_around_fmu({
            "--fmi 3": fmi == "3", "--platforms": platforms != "host", "--step": seconds,
            "--name": name, "--sets-to": sets_to, "--validity-output": validity_output,
        })  # fmt: skip
        psa.export_extended(chosen, output)
        show_written(output)
        return
    with working("compiling") as progress:
        progress(", ".join(t.name for t in targets))
        psa.export_fmu(
            chosen, output, name=name, include_sensor=include_sensor, platforms=wanted,
            fmi=int(fmi), parameter_sets=parameter_sets, validity_output=validity_output,
            step=seconds,
        )  # fmt: skip
    kept = _show_inside(chosen, include_sensor)
    sets = set_files(kept, parameter_sets)
    if sets_to is not None and sets:
        make_folder(sets_to)
        for place, text in sets.items():
            atomic_write(sets_to / place.rpartition("/")[2], text)
    show(f"platforms: {', '.join(t.name for t in targets)}")
    _show_start(kept, len(sets) if seconds is None else None)
    if seconds is not None:
        fixed = json.loads(zipfile.Path(output, FIXED_ENTRY).read_bytes())
        limit = fixed.get("voltage_limit", math.inf)
        _show_step(f"{seconds:g} s", fixed["substeps"], "double", fixed["errors"], limit)
    if not has_zig():
        show(
            "The binary is by this machine's compiler, for systems like this one; after"
            f" `{INSTALL_ZIG}` it loads on older ones too."
        )
    show_written(output)


def _refuse_around_fmu(options: Mapping[str, object]) -> None:
    """Raise InputError for options with a value that an FMU around another one does not take."""
    if refused := [option for option, value in options.items() if value]:
        raise InputError(
            "an FMU that holds another FMU is of FMI 2.0, for this machine, with the other's"
            f" steps and names; leave {' and '.join(refused)} out."
        )


def _show_start(model: "psa.Model", sets: int | None) -> None:
    """Print where an exported model starts, and its evidence, if it has parameter `sets`."""
    from psa_casadi.report.words.catalogue import say
    from psa_casadi.simulation.start import is_stack

    voltage = next((i.start for i in model.structure.inputs if i.name == "voltage"), None)
    begin = say("command.exported_start", voltage=voltage, own=model.changed_starts())
    show(f"start: {begin}")
    if sets is not None:
        evidence = say("command.evidence", model=model, sets=sets, stack=is_stack(model))
        show(f"evidence: {evidence}")


def modelica(
    *,
    output: Path,
    model: Path | None = None,
    stack: StackName = None,
    part: PartName = None,
    name: str | None = None,
    include_sensor: bool = False,
    start: Start,
    published: Published,
    inputs: Inputs,
) -> None:
    """Write a model as a Modelica package: signals, connectors, examples in one file.

    Options:
        output: Modelica file to write.
        name: Name of the package; by default PiezoStack, or that of your model.

    Example:
        psa export modelica --model extended.json -o PiezoStack.mo
    """
    from psa_casadi.export.modelica.package import class_names, package_name

    inputs.outputs({"--output": output}, [model])
    chosen = _chosen(inputs, model, stack, part)
    chosen = inputs.ready(inputs.published(inputs.started(chosen, start), published))
    name = name or package_name(chosen)
    psa.export_modelica(chosen, output, name=name, include_sensor=include_sensor)
    kept = _show_inside(chosen, include_sensor)
    show(f"classes: {', '.join(f'{name}.{c}' for c in class_names(kept))}")
    show_written(output)


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
    inputs: Inputs,
) -> None:
    """Write a nanopositioner as SSP: controller, compensator, amplifier, stack, flexure, wired.

    The file of an FMU's model, as `psa diagnose --fmu` writes it, becomes that FMU between FMUs of
    the effects that were identified at its inputs and outputs.

    Options:
        output: SSP archive to write.
        stack: Named stack in place of a model; `psa stacks` lists them.
        no_compensator: Leave the hysteresis compensator out.
        picture: Picture of the wiring to write, .svg or .png.

    Example:
        psa export ssp --stack P-885.51 -o stage.ssp
    """
    from psa_casadi.export.fmu.platforms import chosen_platforms
    from psa_casadi.export.ssp import OUTSIDE, Port, layout_of, save_wiring, stable_step, wiring_of

    files = {"--output": output, "--picture": picture}
    inputs.outputs(files, [model], ("an SSP archive", ".ssp"))
    if picture is not None and picture.suffix.lower() not in (".svg", ".png"):
        inputs.add(f"{picture}: a picture of the wiring is .svg or .png; name it so.")
    wanted = [p.strip() for p in platforms.split(",") if p.strip()]
    inputs.attempt(lambda: chosen_platforms(wanted))
    any_model = own_model(inputs, model, Fitting())
    if any_model is not None and any_model.structure.foreign:
        inputs.refuse({"--picture": picture, "--stack": stack, "--no-compensator": no_compensator})
        inputs.check()
        psa.export_extended(any_model, output, platforms=wanted)
        show_written(output)
        return
    chosen = inputs.model_or_stack(model, stack or (DEFAULT_STACK if model is None else None))
    chosen = inputs.published(chosen, published)
    system = None
    if chosen is not None:
        made = partial(psa.nanopositioner, chosen, compensated=not no_compensator)
        system = inputs.attempt(made)
    chosen, system = inputs.ready(chosen), inputs.ready(system)
    with working("compiling") as progress:
        progress(", ".join(system.parts))
        psa.export_ssp(system, output, platforms=wanted, publication=chosen.publication)
    wiring = wiring_of(system)
    if picture is not None:
        save_wiring(wiring, layout_of(wiring), picture)
    show(f"parts: {', '.join(system.parts)}")
    for kind in ("input", "output"):
        ports = [n for n, direction in wiring.ports(OUTSIDE) if direction == kind]
        named = (f"{n} [{wiring.unit(Port(OUTSIDE, n))}]" for n in ports)
        show(f"{kind}s: {', '.join(named)}")
    if not inputs.quiet:
        held, sloped = (1e6 * stable_step(wiring, rates=rates) for rates in (False, True))
        show(
            f"communication step: unstable above {held:.3g} us with inputs held over a step, above"
            f" {sloped:.3g} us with input derivatives"
        )
    show_written(output, picture)
