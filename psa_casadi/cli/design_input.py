"""`psa design input`: the voltage that makes a stack follow a path, or move in minimum time."""

from pathlib import Path

from psa_casadi.cli.inputs import Inputs
from psa_casadi.cli.options import Reading, StackName


def input_(
    *,
    output: Path,
    model: Path | None = None,
    stack: StackName = None,
    target: Path | None = None,
    move: tuple[float, float] | None = None,
    measured: Path | None = None,
    minimax: bool = False,
    fast: bool = False,
    max_voltage: float | None = None,
    min_voltage: float | None = None,
    max_rate: float | None = None,
    max_current: float | None = None,
    report: Path | None = None,
    check_fmu: bool = True,
    still: bool = False,
    inputs: Inputs,
) -> None:
    """Design the voltage for a path or for a quickest move; test it on simulator and FMU.

    Options:
        output: CSV to write.
        target: CSV of the path: time [s], displacement [um].
        move: Quickest move FROM TO [um] instead.
        measured: Measured trial of an earlier voltage for this path, to correct it.
        minimax: Minimise the largest error, not the mean square.
        fast: Only invert the model and cut at the limits: for long paths.
        max_voltage: Highest voltage [V].
        min_voltage: Lowest voltage [V].
        max_rate: Largest |dv/dt| [V/s].
        max_current: Largest current [A].
        report: HTML page to write.
        check_fmu: Simulate the exported FMU too.

    Example:
        psa design input --stack P-885.51 --move 2 10 --min-voltage -20
        --max-voltage 120 -o move.csv
    """
    from psa_casadi.cli import design_input_runs as runs
    from psa_casadi.design.tracking.targets import AmplifierLimits, read_target

    inputs.outputs({"--output": output, "--report": report}, [model, target, measured])
    if (target is None) == (move is None):
        inputs.add("Give one of --target PATH.csv and --move FROM TO: the path, or the two ends.")
    ways = {"--fast": fast, "--minimax": minimax, "--measured": measured is not None}
    wanted = " and ".join(name for name, chosen in ways.items() if chosen)
    if sum(ways.values()) > 1:
        inputs.add(f"{wanted} exclude each other; leave all but one of them out.")
    if move is not None and target is None and wanted:
        inputs.add(f"{wanted}: for a path only; leave it out with --move.")
    numbers = {
        "min_voltage": min_voltage, "max_voltage": max_voltage,
        "max_rate": max_rate, "max_current": max_current,
    }  # fmt: skip
    named = {name: value for name, value in numbers.items() if value is not None}
    limits = inputs.attempt(lambda: AmplifierLimits(**named))
    path = inputs.attempt(lambda: read_target(target)) if target is not None else None
    trial = inputs.records([measured], Reading()) if measured is not None else []
    chosen = inputs.model_or_stack(model, stack)
    plant, limits = inputs.ready(chosen).plant(), inputs.ready(limits)
    task = runs.Task(plant, limits, output, report, still, check_fmu)
    if move is not None:
        runs.move(task, move)
    elif path is not None and trial:
        runs.correct(task, path, trial[0])
    elif path is not None and fast:
        runs.invert(task, path)
    elif path is not None:
        runs.track(task, path, minimax)
