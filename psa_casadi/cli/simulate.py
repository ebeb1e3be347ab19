"""`psa simulate`: what a model does with a voltage."""

from pathlib import Path

import psa_casadi as psa
from psa_casadi.cli.inputs import Given
from psa_casadi.cli.options import Reading, StackName, Start
from psa_casadi.cli.own_model import simulated_own
from psa_casadi.cli.screen import show, tell_written, working


def simulate(
    *,
    input_: Path,
    output: Path,
    model: Path | None = None,
    stack: StackName = None,
    reading: Reading,
    start: Start,
    given: Given,
) -> None:
    """Simulate a model on a measured or planned voltage; write every output with its unit.

    The stack starts settled at the first voltage, its hysteresis and creep relaxed, or as --history
    leaves them. With --start-voltage, or a model file that has start values, it starts like an FMU
    exported with the same options. A model of your own, a file of that, FILE.py:FUNCTION or an FMU,
    starts at its start values; its inputs are lines between samples.

    Options:
        input_: Record with time and voltage, and load_force if any; with the inputs of a model of
            your own by their names.
        output: CSV to write.
        start_voltage: Voltage [V] that holds the stack when it starts, as in `psa export fmu`; by
            default the first one of the record.
    """
    from psa_casadi.units import convert

    others = {
        "--stack": stack, "--start-voltage": start.start_voltage is not None,
        "--history": start.history,
    }  # fmt: skip
    if simulated_own(model, input_, output, reading, given, others=others):
        return
    given.outputs({"--output": output}, [model, input_])
    chosen = given.model_or_stack(model, stack)
    columns = given.columns(reading.columns, [input_])
    record = (
        columns
        if columns is None
        else given.attempt(
            lambda: psa.read_record(
                input_, need_displacement=False, columns=columns, sample_time=reading.sample_time
            )
        )
    )
    if start.start_voltage is not None:
        chosen = given.started(chosen, start)
    turns = given.turns(start.history)
    given.check()
    if chosen is None or record is None:
        return
    as_exported = start.start_voltage is not None or (
        start.history is None and chosen.starts_itself
    )
    with working("simulating", given.quiet):
        first, memory = float(record.voltage[0]), None
        if start.history is not None and not as_exported:
            memory = psa.memory_after(chosen, turns, at=first, sweep=start.sweep, rest=start.rest)
        found = psa.simulate_record(chosen, record, memory, as_exported=as_exported)
        written = {"time [s]": found.time, "voltage [V]": found.voltage}
        for declared in chosen.structure.outputs:
            unit = declared.display_unit or declared.unit
            values = convert(found.outputs[declared.name], declared.unit, unit)
            written[f"{declared.name} [{unit}]"] = values
        psa.write_record(output, written)
    show(f"start: {start_sentence(chosen, record, start.history, as_exported)}", given.quiet)
    show(f"{record.n} samples over {record.duration:.6g} s in {found.steps} steps", given.quiet)
    show(f"columns: {', '.join(written)}", given.quiet)
    tell_written(output, quiet=given.quiet)


def start_sentence(
    model: "psa.Model", record: "psa.Record", history: str | None, as_exported: bool
) -> str:
    """Say where a simulation on a record begins, and how an exported FMU begins there too."""
    from psa_casadi.simulation.start import initial_slope

    first = float(record.voltage[0])
    if as_exported:
        held = next(i.start for i in model.structure.inputs if i.name == "voltage")
        step = f"; the record begins with a step from there to {first:.4g} V" * (held != first)
        return f"the start values of the model, at {held:.4g} V, as an exported FMU has them{step}"
    memory = "relaxed" if history is None else f"where the history {history} V leaves them"
    rate = initial_slope(record.time, record.voltage)
    moving = f", moving at {rate:.4g} V/s" if rate else ""
    option = f"--start-voltage {first:.4g}" + ("" if history is None else f" --history {history}")
    begins = f"an FMU of it begins at rest there with {option}"
    if history is None and first:
        begins = (
            f"an FMU with {option} has risen there from 0 V, which its hysteresis remembers:"
            f" give {option} here too to begin as it does"
        )
    return f"settled at {first:.4g} V{moving}, hysteresis and creep {memory}; {begins}"
