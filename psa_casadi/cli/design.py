"""`psa design experiment`, `input` and `mechanism`: what to measure, to play, to mount."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import psa_casadi as psa
from psa_casadi.cli.inputs import Fitting, Inputs, own_model
from psa_casadi.cli.options import Reading, StackName, names
from psa_casadi.cli.screen import show, show_results, show_table, show_written, working
from psa_casadi.common.errors import InputError

#: Samples of a record by default.
_SAMPLES = 1000


def experiment(
    more: Annotated[
        list[str] | None,
        typer.Argument(show_default=False, metavar="EFFECT", autocompletion=names("effects")),
    ] = None,
    *,
    model: Path | None = None,
    stack: StackName = None,
    record: list[Path] | None = None,
    separate: Annotated[list[str] | None, typer.Option(autocompletion=names("effects"))] = None,
    parameter: list[str] | None = None,
    optimality: Literal["D", "E", "A"] = "D",
    family: Literal["any", "free", "triangles", "steps", "multisine"] = "any",
    input_: list[str] | None = None,
    low: float | None = None,
    high: float | None = None,
    duration: float | None = None,
    samples: int | None = None,
    rate: float | None = None,
    current: float | None = None,
    bandwidth: float | None = None,
    noise: list[str] | None = None,
    correlation: float = 0.0,
    starts: int = 2,
    seed: int = 1,
    output: Path | None = None,
    report: Path | None = None,
    still: bool = False,
    reading: Reading,
    fitting: Fitting,
    inputs: Inputs,
) -> None:
    """Design the record to measure next: best for parameters, or to separate effects.

    With --separate the rivals are fitted to the supplied records, else they have ordinary sizes.

    Options:
        more: Further effects to separate.
        model: MODEL.json, or your model, whose inputs --input names.
        record: Record already measured (repeat for several); the rivals are fitted to it, and the
            design has a stack's voltages and length of it.
        separate: Effect to separate from the others that are named.
        parameter: Parameter to determine (repeat for several); all that records of loops determine
            where none is named.
        optimality: Volume, worst direction or mean square of the intervals.
        family: Family of inputs.
        input_: Input of your model that may move, NAME=LOW:HIGH, with its largest rate
            NAME=LOW:HIGH:RATE, in SI units; repeat for several.
        low: Lowest voltage [V].
        high: Highest voltage [V].
        duration: Length of the record [s].
        samples: Number of samples.
        rate: Largest rate [V/s].
        current: Largest current [A].
        bandwidth: Bandwidth [Hz].
        noise: Noise of the sensor, rms [nm]; for your model NAME=RMS for each output, in
            its unit. By default 0.1 % of what the output moves.
        correlation: Correlation of the noise in neighbouring samples.
        starts: Inputs that are improved, at most.
        seed: Seed of the drawn inputs.
        output: CSV with the inputs to apply.
        report: HTML page to write.

    Example:
        psa design experiment --stack P-885.51 --duration 2 --separate field_dependent_gain
        rate_independent_asymmetry -o voltage.csv
    """
    from psa_casadi.design.experiment.experiment import columns_to_play
    from psa_casadi.design.experiment.limits import KINDS
    from psa_casadi.design.experiment.next_record import design_experiment
    from psa_casadi.design.experiment.search import Effort
    from psa_casadi.report.words.design_words import design_tables, sentences

    inputs.outputs({"--output": output, "--report": report}, [model, *(record or [])])
    chosen = own_model(inputs, model, fitting)
    wanted = {
        "low": low, "high": high, "duration": duration, "samples": samples,
        "rate": rate, "current": current, "bandwidth": bandwidth,
    }  # fmt: skip
    effects: Sequence[Any] = [*dict.fromkeys([*(separate or []), *(more or [])])]
    if chosen is not None:
        inputs.refuse({"--stack": stack, "--low": low, "--high": high, "--current": current})
        records: Sequence[psa.Signals] = inputs.signals(chosen, record or [], reading)
        known = {c.name: c for c in inputs.effects_of_any_model()}
        effects = [known.get(n, n) for n in effects]
    else:
        records = inputs.records(record, reading) if record else []
        effects = _stacks_effects(inputs, effects)
        chosen = inputs.model_or_stack(model, stack)
    if len(effects) == 1:
        inputs.add("One effect alone cannot be separated from anything; name two effects or more.")
    if effects and parameter:
        inputs.add("--separate and --parameter exclude each other; design one record for each.")
    if not 0.0 <= correlation < 1.0:
        inputs.add(f"--correlation is {correlation:g}; give a number from 0 to below 1.")
    if starts < 1:
        inputs.add(f"--starts is {starts}; give 1 or more.")
    limits = inputs.attempt(lambda: _limits(chosen, records, input_ or [], wanted))
    level = inputs.attempt(lambda: _noise(chosen, noise or []))
    chosen, limits = inputs.ready(chosen), inputs.ready(limits)
    with working("designing an experiment") as progress:
        design = design_experiment(
            chosen, limits, records=records, separate=effects, parameters=parameter or [],
            optimality=optimality, noise=level, correlation=correlation,
            kinds=[k for k in KINDS if family in ("any", k)],
            effort=Effort(starts=starts, seed=seed), progress=progress, **fitting.words,
        )  # fmt: skip
        if output is not None:
            psa.write_record(output, columns_to_play(design))
        if report is not None:
            _write_page(report, design, chosen, still)
    show("\n".join(sentences(design)))
    for titled in design_tables(design):
        show(f"\n{titled.title}\n")
        show_table(titled.table)
    show_written(output, report)


def _stacks_effects(inputs: Inputs, wanted: Sequence[str]) -> "list[psa.Component]":
    """Return the effects of a stack to separate; all mistakes are noted."""
    from psa_casadi.model.user_effects import known_effects

    known = known_effects(inputs.user_effects)
    for name in [n for n in wanted if n not in known]:
        inputs.add(f"There is no effect '{name}'; `psa effects` lists them.")
    return [known[n] for n in wanted if n in known]


def _limits(
    model: "psa.Model | None",
    records: "Sequence[Any]",
    inputs: Sequence[str],
    wanted: Mapping[str, float | None],
) -> "dict[str, psa.design.Limits]":
    """Return the limits: by the options, else of a stack's records, else its rated voltage."""
    from psa_casadi.design.experiment.limits import Limits, limits_of
    from psa_casadi.simulation.start import is_stack

    if model is None:
        return {}
    given_limits = {k: v for k, v in wanted.items() if v is not None}
    if is_stack(model) and records:
        return {"voltage": limits_of(records, **wanted)}
    if "duration" not in given_limits:
        raise InputError("The length is missing; add --duration SECONDS, or --record with records.")
    samples = int(given_limits.pop("samples", _SAMPLES))
    if is_stack(model):
        given_limits = {"low": 0.0, "high": model.values.get("u_rated", 0.0), **given_limits}
        if not given_limits["high"]:
            raise InputError("The model has no rated voltage; add --high VOLTS.")
        return {"voltage": Limits(samples=samples, **given_limits)}
    limits = {}
    for text in inputs:
        name, _, figures = text.partition("=")
        try:
            low, high, *steepest = (float(f) for f in figures.split(":"))
        except ValueError:
            raise InputError(
                f"--input is '{text}'; give NAME=LOW:HIGH, such as {model.input_names[0]}=0:10."
            ) from None
        settings = {**given_limits, "rate": steepest[0]} if steepest else given_limits
        limits[name] = Limits(low=low, high=high, samples=samples, **settings)
    if not limits:
        raise InputError(
            f"No input may move; add --input NAME=LOW:HIGH, of {', '.join(model.input_names)}."
        )
    return limits


def _noise(model: "psa.Model | None", texts: Sequence[str]) -> dict[str, float] | float | None:
    """Return the noise of every output by the option: of a stack in nm, else in its unit."""
    values: dict[str, float] = {}
    for text in texts:
        name, _, figure = text.rpartition("=")
        try:
            values[name] = float(figure)
        except ValueError:
            raise InputError(f"--noise is '{text}'; give a number, or NAME=RMS.") from None
        if not values[name] > 0.0:
            raise InputError(f"--noise is {text}; give the positive rms of the sensor's noise.")
    if "" in values:
        from psa_casadi.simulation.start import is_stack

        return values[""] * (1e-9 if model is None or is_stack(model) else 1.0)
    return values or None


def _write_page(path: Path, design: Any, model: "psa.Model", still: bool) -> None:
    """Write the page of a design, with the model that runs in it unless it is `still`."""
    from psa_casadi.report.page.designs import write_experiment_page
    from psa_casadi.report.page.live import live_design, live_experiment
    from psa_casadi.simulation.simulate import simulate
    from psa_casadi.simulation.start import is_stack

    live = None
    if not still and is_stack(model):
        time, voltage = design.record.time, design.record.columns["voltage"]
        live = live_design(model, (time, voltage, simulate(model, time, voltage).displacement))
    elif not still:
        live = live_experiment(model, design.record)
    write_experiment_page(path, design, live)


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
    reading: Reading,
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
    paths, trials = [[p] if p is not None else [] for p in (target, measured)]
    path, trial = None, []
    columns = inputs.columns(reading.columns, None if trials else paths)  # else `records` checks
    if columns is not None and paths:
        path = inputs.attempt(lambda: read_target(paths[0], columns, reading.sample_time))
    if columns is not None and trials:
        trial = inputs.records(trials, reading, others=paths)
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


def mechanism(
    *,
    output: Path,
    model: Path | None = None,
    stack: StackName = None,
    damping: float | None = None,
    bandwidth: float | None = None,
    poles: str | None = None,
    max_stroke_loss: str = "10%",
    max_force: float | None = None,
    min_mass: float = 0.0,
    max_mass: float = 1.0,
    max_damping: float = 1e5,
    acts_on: Literal["wafers", "tip"] = "wafers",
    starts: int = 6,
    port: Path | None = None,
    report: Path | None = None,
    still: bool = False,
    inputs: Inputs,
) -> None:
    """Design a prestress mechanism for a wanted damping, bandwidth or poles, within limits.

    MECHANISM.json is a model: `psa export fmu --model MECHANISM.json` makes an FMU of it.

    Options:
        output: MECHANISM.json to write.
        damping: Least damping ratio of all mechanical poles.
        bandwidth: Least bandwidth of the mechanics [Hz].
        poles: One or two pairs of poles [rad/s]: -4e4+4e4j,-4e4-4e4j
        max_stroke_loss: Share of the stroke that the stiffness may take.
        max_force: Largest force in the mechanism in a step of rated voltage [N].
        min_mass: Least mass [kg].
        max_mass: Largest mass [kg].
        max_damping: Largest damping [N.s/m].
        acts_on: Where it acts: on all of the mechanics as in the paper, or on the output mass.
        starts: Starts of the search.
        port: Also write the stack with the port that the mechanism couples to.
        report: HTML page to write.

    Example:
        psa design mechanism --stack PTBS200 --damping 0.7 -o mount.json
    """
    from psa_casadi.design.mechanism.mechanism import Limits, Wish
    from psa_casadi.report.page.designs import write_mechanism_page
    from psa_casadi.report.words.design_words import (
        mechanism_sentences,
        mechanism_table,
        pole_table,
    )

    inputs.outputs({"--output": output, "--port": port, "--report": report}, [model])
    chosen = inputs.model_or_stack(model, stack)
    wanted = inputs.attempt(lambda: _poles(poles))
    loss = inputs.attempt(lambda: _share(max_stroke_loss))
    limits = Limits(loss or 0.0, max_force, (min_mass, max_mass), (0.0, max_damping))
    if wanted is not None:
        inputs.attempt(lambda: Wish(damping, bandwidth, wanted, limits, starts))
    chosen, goals = inputs.ready(chosen), inputs.ready(wanted)
    with working("designing") as progress:
        progress(f"{starts} starts")
        design = psa.design_mechanism(
            chosen, damping=damping, bandwidth=bandwidth, poles=goals, limits=limits,
            acts_on=acts_on, starts=starts,
        )  # fmt: skip
    psa.save_model(psa.mechanism_model(design), output)
    if port is not None:
        psa.save_model(psa.port_model(chosen), port)
    if report is not None:
        write_mechanism_page(design, report, chosen, still=still)
    tables = mechanism_table(design), pole_table(design)
    show_results(mechanism_sentences(design), tables)
    show_written(output, port, report)


def _poles(text: str | None) -> tuple[complex, ...]:
    """Read poles in rad/s, such as -4e4+4e4j,-4e4-4e4j."""
    poles = []
    for part in (text or "").split(","):
        if not part.strip():
            continue
        try:
            poles.append(complex(part.replace(" ", "").replace("i", "j")))
        except ValueError as error:
            raise InputError(
                f"--poles: '{part.strip()}' is no pole; write -4e4+4e4j,-4e4-4e4j in rad/s."
            ) from error
    return tuple(poles)


def _share(text: str) -> float:
    """Read a share: 10% or 0.1."""
    percent = text.strip().endswith("%")
    try:
        value = float(text.strip().removesuffix("%"))
    except ValueError as error:
        raise InputError(f"--max-stroke-loss: '{text}' is no share; write 10% or 0.1.") from error
    return value / 100.0 if percent else value
