"""`psa simulate`: what a model does with a voltage."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import (
    ColumnsOption,
    EffectsOption,
    HistoryOption,
    ModelOption,
    Quiet,
    RestOption,
    SampleTimeOption,
    StackOption,
    SweepOption,
    show,
    tell_written,
    working,
)

if TYPE_CHECKING:
    from psa_casadi.model.compose import Model
    from psa_casadi.records import Record
    from psa_casadi.simulation.simulate import Trajectory
    from psa_casadi.units import FloatArray


def simulate(
    record: Annotated[
        Path, typer.Option("--input", help="Record with time and voltage, and load_force if any.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV to write.")],
    model: ModelOption = None,
    stack: StackOption = None,
    columns: ColumnsOption = None,
    sample_time: SampleTimeOption = None,
    effects: EffectsOption = None,
    start_voltage: Annotated[
        float | None,
        typer.Option(
            "--start-voltage",
            help="Voltage [V] that holds the stack when it starts, as in `psa export fmu`; by"
            " default the first one of the record.",
        ),
    ] = None,
    history: HistoryOption = None,
    sweep: SweepOption = 1.0,
    rest: RestOption = 0.0,
    quiet: Quiet = False,
) -> None:
    """Simulate a model on a measured or planned voltage; write every output with its unit.

    The stack starts settled at the first voltage, its hysteresis and creep relaxed, or as --history
    leaves them. With --start-voltage, or a model file that has start values, it starts like an FMU
    exported with the same options.
    """
    from psa_casadi.cli.inputs import Given
    from psa_casadi.records import write_record
    from psa_casadi.simulation.simulate import memory_after, simulate_record

    given = Given(effects)
    given.outputs({"--output": output}, [model, record])
    chosen = given.model_or_stack(model, stack)
    voltage = given.voltage(record, columns=columns, sample_time=sample_time)
    if start_voltage is not None:
        chosen = given.started(chosen, start_voltage, history, sweep=sweep, rest=rest)
    turns = given.numbers(history, "--history", "voltages in V")
    given.check()
    if chosen is None or voltage is None:
        return
    as_exported = start_voltage is not None or (history is None and chosen.starts_itself)
    with working("simulating", quiet):
        first = float(voltage.voltage[0])
        memory = (
            None
            if history is None or as_exported
            else memory_after(chosen, turns, at=first, sweep=sweep, rest=rest)
        )
        found = simulate_record(chosen, voltage, memory, as_exported=as_exported)
        written = output_columns(chosen, found)
        write_record(output, written)
    show(f"start: {start_sentence(chosen, voltage, history, as_exported)}", quiet)
    show(f"{voltage.n} samples over {voltage.duration:.6g} s in {found.steps} steps", quiet)
    show(f"columns: {', '.join(written)}", quiet)
    tell_written(output, quiet=quiet)


def start_sentence(model: "Model", record: "Record", history: str | None, as_exported: bool) -> str:
    """Say where a simulation on a record begins, and how an exported FMU begins there too."""
    from psa_casadi.simulation.start import initial_slope

    first = float(record.voltage[0])
    if not as_exported:
        memory = "relaxed" if history is None else f"where the history {history} V leaves them"
        rate = initial_slope(record.time, record.voltage)
        moving = f", moving at {rate:.4g} V/s" if rate else ""
        option = f"--start-voltage {first:.4g}" + (
            "" if history is None else f" --history {history}"
        )
        begins = f"an FMU of it begins at rest there with {option}"
        if history is None and first:
            begins = (
                f"an FMU with {option} has risen there from 0 V, which its hysteresis remembers:"
                f" give {option} here too to begin as it does"
            )
        return f"settled at {first:.4g} V{moving}, hysteresis and creep {memory}; {begins}"
    held = next(i.start for i in model.structure.inputs if i.name == "voltage")
    step = "" if held == first else f"; the record begins with a step from there to {first:.4g} V"
    return f"the start values of the model, at {held:.4g} V, as an exported FMU has them{step}"


def output_columns(model: "Model", found: "Trajectory") -> "dict[str, FloatArray]":
    """Return time, voltage and every output under headers such as "displacement [um]"."""
    from psa_casadi.units import convert

    columns = {"time [s]": found.time, "voltage [V]": found.voltage}
    for declared in model.structure.outputs:
        unit = declared.display_unit or declared.unit
        columns[f"{declared.name} [{unit}]"] = convert(
            found.outputs[declared.name], declared.unit, unit
        )
    return columns
