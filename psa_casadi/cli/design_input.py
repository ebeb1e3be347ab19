"""`psa design input`: the voltage that makes a stack follow a path, or move in minimum time."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import (
    EffectsOption,
    ModelOption,
    Quiet,
    StackOption,
    StillOption,
)

if TYPE_CHECKING:
    from psa_casadi.cli.inputs import Given


def input_(
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV to write.")],
    model: ModelOption = None,
    stack: StackOption = None,
    target: Annotated[
        Path | None, typer.Option(help="CSV of the path: time [s], displacement [um].")
    ] = None,
    move: Annotated[
        tuple[float, float] | None, typer.Option(help="Quickest move FROM TO [um] instead.")
    ] = None,
    measured: Annotated[
        Path | None,
        typer.Option(help="Measured trial of an earlier voltage for this path, to correct it."),
    ] = None,
    minimax: Annotated[
        bool, typer.Option("--minimax", help="Minimise the largest error, not the mean square.")
    ] = False,
    fast: Annotated[
        bool,
        typer.Option("--fast", help="Only invert the model and cut at the limits: for long paths."),
    ] = False,
    max_voltage: Annotated[float | None, typer.Option(help="Highest voltage [V].")] = None,
    min_voltage: Annotated[float | None, typer.Option(help="Lowest voltage [V].")] = None,
    max_rate: Annotated[float | None, typer.Option(help="Largest |dv/dt| [V/s].")] = None,
    max_current: Annotated[float | None, typer.Option(help="Largest current [A].")] = None,
    report: Annotated[Path | None, typer.Option(help="HTML page to write.")] = None,
    check_fmu: Annotated[
        bool, typer.Option("--check-fmu/--no-check-fmu", help="Simulate the exported FMU too.")
    ] = True,
    still: StillOption = False,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Design the voltage for a path or for a quickest move; test it on simulator and FMU."""
    from psa_casadi.cli import design_input_runs as runs
    from psa_casadi.cli.inputs import Given
    from psa_casadi.design.tracking.targets import AmplifierLimits, read_target

    given = Given(effects)
    given.outputs({"--output": output, "--report": report}, [model, target, measured])
    _one_task(given, target, move, {"--fast": fast, "--minimax": minimax}, measured)
    numbers = {
        "min_voltage": min_voltage, "max_voltage": max_voltage,
        "max_rate": max_rate, "max_current": max_current,
    }  # fmt: skip
    named = {name: value for name, value in numbers.items() if value is not None}
    limits = given.attempt(lambda: AmplifierLimits(**named))
    path = given.attempt(lambda: read_target(target)) if target is not None else None
    trial = given.records([measured])[0:1] if measured is not None else []
    chosen = given.model_or_stack(model, stack)
    given.check()
    if chosen is None or limits is None:
        return
    task = runs.Task(chosen.plant(), limits, output, report, still, check_fmu, quiet)
    if move is not None:
        runs.move(task, move)
    elif path is not None and trial:
        runs.correct(task, path, trial[0])
    elif path is not None and fast:
        runs.invert(task, path)
    elif path is not None:
        runs.track(task, path, minimax)


def _one_task(
    given: "Given",
    target: Path | None,
    move: tuple[float, float] | None,
    ways: dict[str, bool],
    measured: Path | None,
) -> None:
    """Note what does not go together."""
    if (target is None) == (move is None):
        given.add("Give one of --target PATH.csv and --move FROM TO: the path, or the two ends.")
    chosen = [name for name, wanted in ways.items() if wanted]
    chosen += ["--measured"] if measured is not None else []
    if len(chosen) > 1:
        given.add(f"{' and '.join(chosen)} exclude each other; leave all but one of them out.")
    if move is not None and target is None and chosen:
        given.add(f"{' and '.join(chosen)}: for a path only; leave it out with --move.")
