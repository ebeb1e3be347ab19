"""`psa design experiment`: the next record to measure, for parameters or to tell effects apart."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.completion import names
from psa_casadi.cli.screen import (
    ColumnsOption,
    EffectsOption,
    ModelOption,
    Quiet,
    SampleTimeOption,
    StackOption,
    StillOption,
    show,
    show_table,
    tell_written,
    working,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from psa_casadi.design.experiment.criteria import Rival
    from psa_casadi.design.experiment.experiment import Informative, Separated
    from psa_casadi.model.compose import Model


class Family(StrEnum):
    """Families of voltages."""

    ANY = "any"
    FREE = "free"
    TRIANGLES = "triangles"
    STEPS = "steps"
    MULTISINE = "multisine"


class Optimality(StrEnum):
    """What is made small of the parameters' confidence region."""

    D = "D"
    E = "E"
    A = "A"


def experiment(
    more: Annotated[
        list[str] | None,
        typer.Argument(
            help="Further effects to separate.",
            show_default=False,
            metavar="EFFECT",
            autocompletion=names("effects"),
        ),
    ] = None,
    model: ModelOption = None,
    stack: StackOption = None,
    record: Annotated[
        list[Path] | None,
        typer.Option(
            "--record",
            help="Record already measured (repeat for several); the rivals are fitted"
            " to it, and the design has its voltages and length.",
        ),
    ] = None,
    separate: Annotated[
        list[str] | None,
        typer.Option(
            "--separate",
            help="Effect to separate from the others that are named.",
            autocompletion=names("effects"),
        ),
    ] = None,
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            "--parameter",
            help="Parameter to determine (repeat for several); all that"
            " records of loops determine where none is named.",
        ),
    ] = None,
    optimality: Annotated[
        Optimality, typer.Option(help="Volume, worst direction or mean square of the intervals.")
    ] = Optimality.D,
    family: Annotated[Family, typer.Option(help="Family of voltages.")] = Family.ANY,
    low: Annotated[float | None, typer.Option(help="Lowest voltage [V].")] = None,
    high: Annotated[float | None, typer.Option(help="Highest voltage [V].")] = None,
    duration: Annotated[float | None, typer.Option(help="Length of the record [s].")] = None,
    samples: Annotated[int | None, typer.Option(help="Number of samples.")] = None,
    rate: Annotated[float | None, typer.Option(help="Largest rate [V/s].")] = None,
    current: Annotated[float | None, typer.Option(help="Largest current [A].")] = None,
    bandwidth: Annotated[float | None, typer.Option(help="Bandwidth [Hz].")] = None,
    noise: Annotated[
        float | None, typer.Option(help="Noise of the sensor, rms [nm]; 0.1 % of the stroke.")
    ] = None,
    correlation: Annotated[
        float, typer.Option(help="Correlation of the noise in neighbouring samples.")
    ] = 0.0,
    starts: Annotated[int, typer.Option(help="Voltages that are improved, at most.")] = 2,
    seed: Annotated[int, typer.Option(help="Seed of the drawn voltages.")] = 1,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="CSV with the voltage to apply.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="HTML page to write.")] = None,
    still: StillOption = False,
    columns: ColumnsOption = None,
    sample_time: SampleTimeOption = None,
    own: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Design the record to measure next: best for parameters, or to separate effects.

    With --separate the rivals are fitted to the records given, else they have ordinary sizes.
    """
    from psa_casadi.cli import design_given
    from psa_casadi.cli.inputs import Given
    from psa_casadi.design.experiment.search import Effort

    given = Given(own, quiet=quiet)
    given.outputs({"--output": output, "--report": report}, [model, *(record or [])])
    effects = design_given.effects(given, [*(separate or []), *(more or [])], parameter or [])
    chosen = given.model_or_stack(model, stack)
    records = given.records(record, columns=columns, sample_time=sample_time) if record else []
    design_given.check_noise(given, noise, correlation, starts)
    wanted = {
        "low": low, "high": high, "duration": duration, "samples": samples,
        "rate": rate, "current": current, "bandwidth": bandwidth,
    }  # fmt: skip
    limits = None
    if records or not record:
        limits = given.attempt(lambda: design_given.limits(records, chosen, wanted))
    given.check()
    if chosen is None or limits is None:
        return
    level = design_given.noise(chosen, limits, noise, correlation)
    plan = design_given.Plan(limits, level, family.value, Effort(starts=starts, seed=seed))
    design: Informative | Separated
    with working("designing an experiment", quiet) as progress:
        if effects:
            design, rivals = design_given.separating(chosen, effects, records, plan, progress)
        else:
            design, rivals = design_given.informative(
                chosen, parameter or [], optimality.value, plan, progress
            )
        _write(design, chosen, rivals, output, (report, still))
    _tell(design, chosen, quiet)
    tell_written(output, report, quiet=quiet)


def _write(
    design: "Informative | Separated",
    model: "Model",
    rivals: "Sequence[Rival]",
    output: Path | None,
    page: tuple[Path | None, bool],
) -> None:
    from psa_casadi.records import write_record
    from psa_casadi.report.page.designs import write_experiment_page
    from psa_casadi.report.page.live import live_design
    from psa_casadi.simulation.simulate import simulate

    time, voltage = design.record.time, design.record.voltage
    if output is not None:
        write_record(output, {"time [s]": time, "voltage [V]": voltage})
    report, still = page
    if report is None:
        return
    live = None
    if not still:
        live = live_design(model, (time, voltage, simulate(model, time, voltage).displacement))
    responses = {r.name: r.predict(design.record, r.truth) for r in rivals}
    write_experiment_page(report, design, model, responses, live)


def _tell(design: "Informative | Separated", model: "Model", quiet: bool) -> None:
    from psa_casadi.report.words.design_words import design_tables, sentences

    for sentence in sentences(design, model.values.get("C_p")):
        show(sentence, quiet)
    for shown in design_tables(design, model):
        show(f"\n{shown.title}\n", quiet)
        show_table(shown.table, quiet)
