"""`psa simulate`: what a model does with a voltage."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import (
    ColumnsOption,
    EffectsOption,
    HistoryOption,
    Quiet,
    RestOption,
    StackOption,
    SweepOption,
    show,
    tell_written,
    working,
)

if TYPE_CHECKING:
    from psa_casadi.model.compose import Model
    from psa_casadi.simulation.simulate import Trajectory
    from psa_casadi.units import FloatArray


def simulate(
    record: Annotated[
        Path, typer.Option("--input", help="Record with time and voltage, and load_force if any.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV to write.")],
    model: Annotated[Path | None, typer.Option(help="MODEL.json to simulate.")] = None,
    stack: StackOption = None,
    columns: ColumnsOption = None,
    effects: EffectsOption = None,
    history: HistoryOption = None,
    sweep: SweepOption = 1.0,
    rest: RestOption = 0.0,
    quiet: Quiet = False,
) -> None:
    """Simulate a model on a measured or planned voltage; write every output with its unit.

    Hysteresis and creep begin where --history leaves them, else relaxed. Example:
    psa simulate --stack P-885.51 --input voltage.csv --history 120,0,120 -o out.csv
    """
    from psa_casadi.cli.inputs import Given
    from psa_casadi.records import write_record
    from psa_casadi.simulation.history import memory_after
    from psa_casadi.simulation.simulate import simulate_record

    given = Given(effects)
    given.outputs({"--output": output}, [model, record])
    chosen = given.model_or_stack(model, stack)
    voltage = given.voltage(record, columns=columns)
    turns = given.numbers(history, "--history", "voltages in V")
    given.check()
    if chosen is None or voltage is None:
        return
    with working("simulating", quiet):
        first = float(voltage.voltage[0])
        memory = (
            None
            if history is None
            else memory_after(chosen, turns, at=first, sweep=sweep, rest=rest)
        )
        found = simulate_record(chosen, voltage, memory)
        written = output_columns(chosen, found)
        write_record(output, written)
    show(f"{voltage.n} samples over {voltage.duration:.6g} s in {found.steps} steps", quiet)
    show(f"columns: {', '.join(written)}", quiet)
    tell_written(output, quiet=quiet)


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
