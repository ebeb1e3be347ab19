"""`psa design input`: the voltage that makes a stack follow a path, or move in minimum time."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import Quiet, StackOption, show, show_table, tell_written, working

if TYPE_CHECKING:
    from psa_casadi.input_design.amplifier_limits import AmplifierLimits
    from psa_casadi.input_design.targets import Target
    from psa_casadi.model.compose import Model


def input_(
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV to write.")],
    model: Annotated[Path | None, typer.Option(help="MODEL.json of the stack.")] = None,
    stack: StackOption = None,
    target: Annotated[
        Path | None, typer.Option(help="CSV of the path: time [s], displacement [um].")
    ] = None,
    move: Annotated[
        tuple[float, float] | None, typer.Option(help="Quickest move FROM TO [um] instead.")
    ] = None,
    minimax: Annotated[
        bool, typer.Option("--minimax", help="Least largest error, not least mean square.")
    ] = False,
    fast: Annotated[
        bool, typer.Option("--fast", help="Inversion only: for long paths; no limits.")
    ] = False,
    max_voltage: Annotated[float | None, typer.Option(help="Highest voltage [V].")] = None,
    min_voltage: Annotated[float | None, typer.Option(help="Lowest voltage [V].")] = None,
    max_rate: Annotated[float | None, typer.Option(help="Largest |dv/dt| [V/s].")] = None,
    max_current: Annotated[float | None, typer.Option(help="Largest current [A].")] = None,
    report: Annotated[Path | None, typer.Option(help="HTML page to write.")] = None,
    check_fmu: Annotated[
        bool, typer.Option("--check-fmu/--no-check-fmu", help="Play it on the exported FMU too.")
    ] = True,
    quiet: Quiet = False,
) -> None:
    """Design the voltage for a path or for a quickest move; judge it by simulator and FMU."""
    from psa_casadi.cli.inputs import Given
    from psa_casadi.input_design.amplifier_limits import AmplifierLimits
    from psa_casadi.input_design.targets import read_target

    given = Given()
    given.outputs({"--output": output, "--report": report}, [model, target])
    if (target is None) == (move is None):
        given.add("Give one of --target PATH.csv and --move FROM TO: the path, or the two ends.")
    if fast and (move is not None or minimax):
        given.add("--fast follows a path by inversion; leave out --move and --minimax with it.")
    numbers = {
        "min_voltage": min_voltage, "max_voltage": max_voltage,
        "max_rate": max_rate, "max_current": max_current,
    }  # fmt: skip
    named = {name: value for name, value in numbers.items() if value is not None}
    limits = given.attempt(lambda: AmplifierLimits(**named))
    path = given.attempt(lambda: read_target(target)) if target is not None else None
    chosen = given.model_or_stack(model, stack)
    given.check()
    if chosen is None or limits is None:
        return
    plant = chosen.plant()
    if move is not None:
        _move(plant, move, limits, output, report, check_fmu, quiet)
    elif path is not None and fast:
        _invert(plant, path, limits, output, quiet)
    elif path is not None:
        _track(plant, path, limits, minimax, output, report, check_fmu, quiet)


def _track(
    plant: "Model", path: "Target", limits: "AmplifierLimits", minimax: bool,
    output: Path, report: Path | None, check_fmu: bool, quiet: bool,
) -> None:  # fmt: skip
    from psa_casadi.export.played import played_on_fmu
    from psa_casadi.input_design.tracking import track
    from psa_casadi.input_design.verification import error_of, uncompensated
    from psa_casadi.report.design_input_part import error_table, limits_table, tracking_pictures
    from psa_casadi.report.design_page import write_design_page
    from psa_casadi.report.phrases import number

    with working("designing", quiet) as progress:
        found = track(plant, path, limits, minimax=minimax, progress=progress)
        plain = uncompensated(plant, path)
        rows = [
            ("designed, full simulator", found.error),
            ("designed, the program itself", error_of(path, found.predicted)),
            ("inversion, full simulator", found.inverse.error),
            ("uncompensated, full simulator", error_of(path, plain.displacement)),
        ]
        if check_fmu:
            progress("exported FMU")
            shown = played_on_fmu(plant, path.time, found.voltage)
            rows.insert(1, ("designed, exported FMU", error_of(path, shown)))
        _write(output, found.response.time, found.voltage, found.response.displacement)
    errors, use = error_table(rows), limits_table(found.response, limits)
    summary = [
        f"The designed voltage follows the path to {number(found.error.rms_percent)} % of its range"
        f" rms, {number(found.error.largest_percent)} % at most, by the full simulator.",
        f"{len(path.time)} samples in {number(found.seconds)} s, {found.iterations} iterations.",
        f"Kinks at reversals were rounded over {number(found.width)} V/s in the program only.",
    ]
    if not found.converged:
        summary.append("IPOPT ran out of iterations: a better voltage within limits may exist.")
    if report is not None:
        pictures = tracking_pictures(found, plain.displacement)
        write_design_page(
            report, title="Designed input", summary=summary, tables=(errors, use),
            figures=pictures, badges=("least largest error" if minimax else "least squares",),
        )  # fmt: skip
    _tell(summary, (errors.table, use.table), quiet)
    tell_written(output, report, quiet=quiet)


def _invert(
    plant: "Model", path: "Target", limits: "AmplifierLimits", output: Path, quiet: bool
) -> None:
    from psa_casadi.errors import InputError
    from psa_casadi.input_design.inversion import invert
    from psa_casadi.input_design.verification import broken
    from psa_casadi.report.design_input_part import error_table, limits_table

    with working("inverting", quiet):
        found = invert(plant, path)
    problems = broken(found.response, limits)
    if problems:
        raise InputError([*problems, "Leave --fast out: the full design keeps the limits."])
    _write(output, path.time, found.response.voltage, found.response.displacement)
    errors = error_table([("inversion, full simulator", found.error)])
    use = limits_table(found.response, limits)
    _tell([f"{len(found.trials)} trials on the simulator."], (errors.table, use.table), quiet)
    tell_written(output, quiet=quiet)


def _move(
    plant: "Model", ends: tuple[float, float], limits: "AmplifierLimits",
    output: Path, report: Path | None, check_fmu: bool, quiet: bool,
) -> None:  # fmt: skip
    import numpy as np

    from psa_casadi.export.played import played_on_fmu
    from psa_casadi.input_design.minimum_time import quickest_move
    from psa_casadi.report.design_input_part import limits_table, move_pictures
    from psa_casadi.report.design_page import write_design_page
    from psa_casadi.report.phrases import number

    with working("designing", quiet) as progress:
        found = quickest_move(plant, 1e-6 * ends[0], 1e-6 * ends[1], limits, progress=progress)
        response = found.response
        summary = [
            f"The move takes {number(1e6 * found.move_time)} us; the linear part alone would take"
            f" {number(1e6 * found.linear_time)} us.",
            f"Behind it the displacement swings by {number(100.0 * found.residual, 2)} % of the"
            f" move at most, {number(100.0 * found.offset, 2)} % off its end, by the simulator.",
        ]
        if check_fmu:
            progress("exported FMU")
            shown = played_on_fmu(plant, response.time, response.voltage)
            worst = np.max(np.abs(shown - response.displacement)) / abs(found.end - found.begin)
            summary.append(
                f"The exported FMU differs from the simulator by {number(100.0 * worst, 2)} % of"
                " the move at most."
            )
        _write(output, response.time, response.voltage, response.displacement)
    use = limits_table(response, limits)
    if report is not None:
        write_design_page(
            report, title="Quickest move", summary=summary, tables=(use,),
            figures=move_pictures(found),
        )  # fmt: skip
    _tell(summary, (use.table,), quiet)
    tell_written(output, report, quiet=quiet)


def _write(output: Path, time: object, voltage: object, displacement: object) -> None:
    import numpy as np

    from psa_casadi.experiment import write_record

    metres = np.asarray(displacement, dtype=float)
    columns = {"time [s]": time, "voltage [V]": voltage, "displacement [um]": 1e6 * metres}
    write_record(output, columns)  # type: ignore[arg-type]


def _tell(summary: list[str], tables: tuple[object, ...], quiet: bool) -> None:
    for sentence in summary:
        show(sentence, quiet)
    for table in tables:
        show("", quiet)
        show_table(table, quiet)  # type: ignore[arg-type]
