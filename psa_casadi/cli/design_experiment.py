"""`psa design experiment`: the next record to measure, for parameters or to tell effects apart."""

from pathlib import Path
from typing import Annotated, Literal

import typer

import psa_casadi as psa
from psa_casadi.cli.inputs import Given
from psa_casadi.cli.options import Reading, StackName, names
from psa_casadi.cli.screen import show, show_table, tell_written, working


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
    low: float | None = None,
    high: float | None = None,
    duration: float | None = None,
    samples: int | None = None,
    rate: float | None = None,
    current: float | None = None,
    bandwidth: float | None = None,
    noise: float | None = None,
    correlation: float = 0.0,
    starts: int = 2,
    seed: int = 1,
    output: Path | None = None,
    report: Path | None = None,
    still: bool = False,
    reading: Reading,
    given: Given,
) -> None:
    """Design the record to measure next: best for parameters, or to separate effects.

    With --separate the rivals are fitted to the records given, else they have ordinary sizes.

    Options:
        more: Further effects to separate.
        record: Record already measured (repeat for several); the rivals are fitted to it, and the
            design has its voltages and length.
        separate: Effect to separate from the others that are named.
        parameter: Parameter to determine (repeat for several); all that records of loops determine
            where none is named.
        optimality: Volume, worst direction or mean square of the intervals.
        family: Family of voltages.
        low: Lowest voltage [V].
        high: Highest voltage [V].
        duration: Length of the record [s].
        samples: Number of samples.
        rate: Largest rate [V/s].
        current: Largest current [A].
        bandwidth: Bandwidth [Hz].
        noise: Noise of the sensor, rms [nm]; 0.1 % of the stroke.
        correlation: Correlation of the noise in neighbouring samples.
        starts: Voltages that are improved, at most.
        seed: Seed of the drawn voltages.
        output: CSV with the voltage to apply.
        report: HTML page to write.
    """
    from psa_casadi.cli import design_experiment_runs as runs
    from psa_casadi.design.experiment.search import Effort
    from psa_casadi.report.words.design_words import design_tables, sentences

    given.outputs({"--output": output, "--report": report}, [model, *(record or [])])
    effects = runs.effects_of(given, [*(separate or []), *(more or [])], parameter or [])
    chosen = given.model_or_stack(model, stack)
    records = given.records(record, reading) if record else []
    if noise is not None and not noise > 0.0:
        given.add(f"--noise is {noise:g} nm; give the positive rms of the sensor's noise.")
    if not 0.0 <= correlation < 1.0:
        given.add(f"--correlation is {correlation:g}; give a number from 0 to below 1.")
    if starts < 1:
        given.add(f"--starts is {starts}; give 1 or more.")
    wanted = {
        "low": low, "high": high, "duration": duration, "samples": samples,
        "rate": rate, "current": current, "bandwidth": bandwidth,
    }  # fmt: skip
    limits = None
    if records or not record:
        limits = given.attempt(lambda: runs.limits_given(records, chosen, wanted))
    given.check()
    if chosen is None or limits is None:
        return
    with working("designing an experiment", given.quiet) as progress:
        design, rivals = runs.designed(
            chosen, effects, records, parameters=parameter or [], optimality=optimality,
            limits=limits, noise=runs.noise_of(chosen, limits, noise, correlation),
            family=family, effort=Effort(starts=starts, seed=seed), progress=progress,
        )  # fmt: skip
        if output is not None:
            columns = {"time [s]": design.record.time, "voltage [V]": design.record.voltage}
            psa.write_record(output, columns)
        if report is not None:
            runs.write_page(report, design, chosen, rivals, still)
    for sentence in sentences(design, chosen.values.get("C_p")):
        show(sentence, given.quiet)
    for shown in design_tables(design, chosen):
        show(f"\n{shown.title}\n", given.quiet)
        show_table(shown.table, given.quiet)
    tell_written(output, report, quiet=given.quiet)
