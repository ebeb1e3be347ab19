"""`psa diagnose`: what the simulation gets wrong, the cause, the extended model, the gain."""

import time as clock
from collections.abc import Callable, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.completion import names
from psa_casadi.cli.expected import JunitOption, expected, judge
from psa_casadi.cli.screen import (
    ColumnsOption,
    EffectsOption,
    HysteresisOption,
    Origin,
    OriginOption,
    Quiet,
    SampleTimeOption,
    StackOption,
    StartModelOption,
    StillOption,
    show,
    show_table,
    tell_written,
    width,
    working,
)
from psa_casadi.cli.steps import DIAGNOSE

if TYPE_CHECKING:
    from psa_casadi.cli.inputs import Given
    from psa_casadi.diagnosis.result import Diagnosis
    from psa_casadi.simulation.timings import Timings


def diagnose(
    records: Annotated[
        list[Path],
        typer.Argument(
            help="Records of one device: CSV, Excel, MATLAB and other files.", show_default=False
        ),
    ],
    holdout: Annotated[
        list[Path] | None,
        typer.Option(
            help="Record kept for judging only (repeat the option for several); without it, a"
            " quarter of every record, in blocks."
        ),
    ] = None,
    model: StartModelOption = None,
    stack: StackOption = None,
    stiffness: Annotated[
        float | None, typer.Option(help="Stiffness of the free stack [N/m]; fixes the force scale.")
    ] = None,
    hysteresis: HysteresisOption = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="MODEL.json of the extended model.")
    ] = None,
    patch: Annotated[
        Path | None,
        typer.Option(
            help="MODEL.json of the extended model with the unnamed correction, where one helps."
        ),
    ] = None,
    json: Annotated[Path | None, typer.Option(help="DIAGNOSIS.json to write.")] = None,
    report: Annotated[Path | None, typer.Option(help="HTML page to write.")] = None,
    figure: Annotated[Path | None, typer.Option(help="PNG picture to write.")] = None,
    following: Annotated[
        Path | None,
        typer.Option(
            "--next",
            help="VOLTAGE.csv to write if the verdict is ambiguous and a further record would"
            " decide; by default next to the JSON file or the page.",
        ),
    ] = None,
    timings: Annotated[
        bool,
        typer.Option(
            "--timings", help="Print what each stage took: time, processor time, simulations."
        ),
    ] = False,
    leave_out: Annotated[
        list[str] | None,
        typer.Option(
            "--leave-out",
            help="Effect that is not to be looked for, as one that cannot be there; repeat the"
            " option for several.",
            autocompletion=names("effects"),
        ),
    ] = None,
    events: Annotated[
        Path | None,
        typer.Option(
            "--events",
            help="File that gets a line of JSON for every fit of the search while it runs: its"
            " causes, evidence, score and errors.",
        ),
    ] = None,
    expect: Annotated[
        str | None,
        typer.Option(
            help="Verdicts of which one must come out, with commas between, else exit code 1:"
            " adequate, cause_named, partly_explained, ambiguous, unexplained, not_driven.",
            autocompletion=names("verdicts"),
        ),
    ] = None,
    max_error: Annotated[
        str | None,
        typer.Option(
            help="Largest held-out error of the extended model, in % of the range, as 0.5%, else"
            " exit code 1."
        ),
    ] = None,
    junit: JunitOption = None,
    still: StillOption = False,
    columns: ColumnsOption = None,
    sample_time: SampleTimeOption = None,
    origin: OriginOption = Origin.MEASURED,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Find what the base model gets wrong, name the cause, extend the model, measure the gain.

    The exit code is 0 for every verdict; with --expect or --max-error it is 1 where the result is
    not as they say.
    """
    from psa_casadi.simulation.timings import stage, timed

    outputs = {
        "--output": output, "--patch": patch, "--json": json, "--report": report,
        "--figure": figure,
    }  # fmt: skip
    began = clock.perf_counter()
    with timed() as spent:
        with stage("loading"):
            from psa_casadi.cli import diagnosis_files as files
            from psa_casadi.cli.events import events_to
            from psa_casadi.cli.inputs import Given
            from psa_casadi.diagnosis.diagnose import diagnose as run
            from psa_casadi.diagnosis.result import DiagnosisInterrupted
            from psa_casadi.report.words.text import story
        with stage("reading"):
            given, held = Given(effects, quiet=quiet), holdout or []
            given.stiffness(stiffness)
            beside = {"--next": following, "--events": events, "--junit": junit}
            given.outputs({**outputs, **beside}, [*records, *held, model])
            _keep_apart(given, output, model)
            found = given.records(records, held_out=held, columns=columns, sample_time=sample_time)
            start = given.model_or_stack(model, stack, needed=False)
            table, wanted = given.searched(leave_out or ()), expected(given, expect, max_error)
            given.check()
        count = given.fitted
        with working("diagnosing", quiet, DIAGNOSE) as progress, events_to(events) as watch:
            try:
                d = run(
                    found[:count],
                    holdout=found[count:],
                    model=start,
                    stiffness=stiffness,
                    hysteresis=hysteresis.value if hysteresis else None,
                    effects=table,
                    progress=progress,
                    watch=watch,
                )
                d = files.noted(d, leave_out or ())
            except DiagnosisInterrupted as stop:
                raise KeyboardInterrupt(files.keep_unfinished(stop, outputs)) from None
            place = following or _beside(json or report)
            d, unpatched = _finish(d, place, outputs, (origin.value, still), progress)
        with stage("writing"):
            path = None if output is None else str(output)
            told = story(d, origin=origin.value, width=width(), model_file=path)
    show(told, quiet)
    _tell_files(d, outputs, unpatched, quiet)
    if timings:
        _tell_timings(spent, quiet)
    judge("diagnose", ", ".join(p.name for p in records), wanted.cases(d), junit, began, tells=True)


def _tell_timings(spent: "Timings", quiet: bool) -> None:
    from psa_casadi.report.words.tables import timings_table

    show("", quiet)
    show_table(timings_table(spent.stages), quiet)
    show(f"\nprocessor time with the start of Python: {clock.process_time():.2f} s", quiet)


def _tell_files(
    d: "Diagnosis", outputs: Mapping[str, Path | None], unpatched: str, quiet: bool
) -> None:
    """Name the files that were written, and say why a patch is missing."""
    from psa_casadi.cli import diagnosis_files as files

    told_of = [None if o == "--patch" and unpatched else p for o, p in outputs.items()]
    tell_written(*told_of, d.next_experiment.voltage_csv, quiet=quiet)
    for line in files.models(d, outputs["--output"]):
        show(line, quiet)
    if unpatched:
        show(unpatched, quiet)


def _finish(
    d: "Diagnosis",
    following: Path | None,
    outputs: Mapping[str, Path | None],
    page: tuple[str, bool],
    progress: Callable[[str], None],
) -> "tuple[Diagnosis, str]":
    """Design what follows and write all files; return the diagnosis and why a patch is missing.

    `page` says what the page calls the records, and whether it is still.
    """
    from psa_casadi.cli import diagnosis_files as files
    from psa_casadi.simulation.timings import stage

    written: list[Path] = []
    origin, still = page
    try:
        with stage("next experiment"):
            d = files.with_next(d, following, progress)
        progress("writing")
        with stage("writing"):
            files.write(d, {**outputs, "--patch": None}, origin, written, still=still)
        with stage("unnamed correction"):
            return d, files.write_patch(d, outputs["--patch"], progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(files.keep(d, outputs, origin, written)) from None


def _keep_apart(given: "Given", output: Path | None, model: Path | None) -> None:
    """Demand that no model written beside the output is the one that is read."""
    if output is None or model is None or model.resolve().parent != output.resolve().parent:
        return
    if fnmatch(model.name, f"{output.stem}_*_for_*.json"):
        given.add(f"{model}: a model beside {output} could overwrite it; give -o another name.")


def _beside(path: Path | None) -> Path | None:
    """Return where the next voltage goes if no place is named."""
    return path.with_name(f"{path.stem}_next.csv") if path is not None else None
