"""`psa simulate`: what a model does with its inputs."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import psa_casadi as psa
from psa_casadi.cli.inputs import Fitting, Inputs, own_model
from psa_casadi.cli.options import Reading, StackName, Start
from psa_casadi.cli.screen import show, show_written, working
from psa_casadi.common.display import with_units
from psa_casadi.common.errors import Problems

if TYPE_CHECKING:
    from psa_casadi.common.units import FloatArray


def simulate(
    *,
    input_: Path,
    output: Path,
    model: Path | None = None,
    fmu: Path | None = None,
    stack: StackName = None,
    value: list[str] | None = None,
    start: list[str] | None = None,
    hold: Literal["linear", "zero"] | None = None,
    figure: Path | None = None,
    reading: Reading,
    begin: Start,
    inputs: Inputs,
) -> None:
    """Simulate a model on measured or planned inputs; write every output with its unit.

    The stack starts settled at the first voltage, its hysteresis and creep relaxed, or as --history
    leaves them. With --start-voltage, or a model that has start values, it starts like an FMU
    exported with the same options. Your model, its file, FILE.py:FUNCTION or an FMU,
    starts at its start values.

    Options:
        input_: Record with time and voltage, and load_force if any; with the inputs of your
            model by their names.
        output: CSV to write.
        fmu: FMU of any tool, in the place of --model.
        value: Parameter in place of the model's, NAME=VALUE in SI units; repeat for several.
        start: Start of a state, NAME=VALUE in SI units; repeat for several.
        hold: What the inputs do between samples; by default what they did in the records that the
            model was identified from.
        figure: Picture of all inputs and outputs to write, PNG, SVG or PDF as its name
            ends.
        start_voltage: Voltage [V] that holds the stack when it starts, as in `psa export fmu`; by
            default the first one of the record.

    Example:
        psa simulate --stack P-885.51 --input voltage.csv --history 120,0 -o out.csv
    """
    from psa_casadi.report.plots.figures import columns_figure, write_figure

    inputs.outputs({"--output": output, "--figure": figure}, [model, fmu, input_])
    imported = fmu is not None or (model is not None and model.suffix.lower() == ".fmu")
    chosen_by = Fitting(fmu=fmu, value=value if imported else None)
    any_model = own_model(inputs, model, chosen_by, fitted=False)
    chosen, record = _read(inputs, any_model, model, stack, input_, begin, reading)
    turns = inputs.turns(begin.history)
    values = {} if imported else inputs.numbers("--value", value)
    starts = inputs.numbers("--start", start)
    if chosen is not None:
        chosen = inputs.attempt(partial(_changed, chosen, values, starts))
    chosen, record = inputs.ready(chosen), inputs.ready(record)
    hold = hold or chosen.provenance.hold
    with working("simulating"):
        applied = {n: c for n in chosen.input_names if (c := record.column(n)) is not None}
        if isinstance(record, psa.Record):
            outputs, report = _of_a_stack(chosen, applied, record, turns, begin, starts, hold)
        else:
            import numpy as np

            u = np.column_stack([np.empty((record.n, 0)), *applied.values()])
            x0 = np.array([q.start for q in chosen.structure.states])
            y = psa.run(chosen, record.time - record.time[0], u, x0, hold=hold).y
            outputs = dict(zip(chosen.output_names, y.T, strict=True))
            report = _start_values(chosen, starts), ""
        signals = _as_displayed(chosen, record.time, {**applied, **outputs})
        written = with_units(
            {"time": record.time, **signals.columns}, {"time": "s", **signals.units}
        )
        psa.write_record(output, written)
        if figure is not None:
            first = [n for n in chosen.output_names if n in outputs]
            write_figure(columns_figure(signals, first), figure)
    begin_times, took = report
    show(f"start: {begin_times}")
    show(f"{record.n} samples over {record.duration:.6g} s{took}")
    show(f"columns: {', '.join(written)}")
    show_written(output, figure)


def _read(
    inputs: Inputs,
    any_model: "psa.Model | None",
    model: Path | None,
    stack: str | None,
    input_: Path,
    begin: Start,
    reading: Reading,
) -> "tuple[psa.Model | None, psa.Record | psa.Signals | None]":
    """Return the model and the record of its inputs, `Signals` where it is no stack's."""
    from psa_casadi.identification.experiments import in_units

    if any_model is not None:
        problems = Problems()
        voltage = begin.start_voltage is not None
        inputs.refuse({"--stack": stack, "--start-voltage": voltage, "--history": begin.history})
        read = next(iter(inputs.signals(any_model, [input_], reading)), None)
        signals = read and in_units(any_model, read, problems)
        for sentence in problems.sentences():
            inputs.add(sentence)
        return any_model, signals
    chosen = inputs.model_or_stack(model, stack)
    columns = inputs.columns(reading.columns, [input_])
    record = None
    if columns is not None:
        read_record = partial(psa.read_record, input_, need_displacement=False, columns=columns)
        record = inputs.attempt(partial(read_record, sample_time=reading.sample_time))
    return (chosen if begin.start_voltage is None else inputs.started(chosen, begin)), record


def _changed(model: "psa.Model", values: dict[str, float], starts: dict[str, float]) -> "psa.Model":
    """Return a model with other parameters and starts. Raises InputError."""
    for name in values:
        model.parameter(name)
    return model.with_values(values).with_starts(starts)


def _start_values(model: "psa.Model", starts: dict[str, float]) -> str:
    """Say that the model's start values hold, and which of them --start has set."""
    from psa_casadi.report.words.catalogue import say

    every: list[psa.State | psa.Input] = [*model.structure.states, *model.structure.inputs]
    units = {v.name: v.unit for v in every}
    return say("command.start_values", starts=[(n, v, units[n]) for n, v in starts.items()])


def _of_a_stack(
    model: "psa.Model",
    inputs: dict[str, Any],
    record: "psa.Record",
    turns: tuple[float, ...],
    begin: Start,
    starts: dict[str, float],
    hold: str,
) -> "tuple[dict[str, FloatArray], tuple[str, str]]":
    """Return the outputs of a stack, and texts on its start and its steps."""
    as_exported = begin.start_voltage is not None or (begin.history is None and model.starts_itself)
    first, memory = float(record.voltage[0]), None
    if begin.history is not None and not as_exported:
        memory = psa.memory_after(model, turns, at=first, sweep=begin.sweep, rest=begin.rest)
    result = psa.simulate(
        model, record.time, memory=memory, as_exported=as_exported, hold=hold, **inputs
    )
    values = _start_values(model, starts) if as_exported else ""
    text = start_sentence(model, record, begin.history, values)
    return dict(result.outputs), (text, f" in {result.steps} steps")


def _as_displayed(
    model: "psa.Model", time: "FloatArray", columns: "dict[str, FloatArray]"
) -> "psa.Signals":
    """Return inputs and outputs in the units that they are displayed in."""
    from psa_casadi.common.units import convert

    every: list[psa.Input | psa.Output] = [*model.structure.inputs, *model.structure.outputs]
    there = [v for v in every if v.name in columns]
    units = {v.name: v.display_unit or v.unit for v in there}
    values = {v.name: convert(columns[v.name], v.unit, units[v.name]) for v in there}
    return psa.Signals(name=model.name, time=time, columns=values, units=units)


def start_sentence(
    model: "psa.Model", record: "psa.Record", history: str | None, values: str
) -> str:
    """Say where a simulation on a record starts, and how an exported FMU starts there too.

    `values` is the text for start values, if it starts at these.
    """
    from psa_casadi.report.words.catalogue import say
    from psa_casadi.simulation.start import initial_slope

    first = float(record.voltage[0])
    if values:
        held = next(i.start for i in model.structure.inputs if i.name == "voltage")
        return say("command.as_exported", values=values, held=held, first=first)
    rate = initial_slope(record.time, record.voltage)
    return say("command.settled", first=first, rate=rate, history=history)
