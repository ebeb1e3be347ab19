"""`psa diagnose`: what the simulation gets wrong, the cause, the extended model, the gain."""

import time as clock
from collections.abc import Callable, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import (
    ColumnsOption,
    EffectsOption,
    HysteresisOption,
    Origin,
    OriginOption,
    Quiet,
    SampleTimeOption,
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
    model: Annotated[
        Path | None, typer.Option(help="MODEL.json whose values the base fit starts from.")
    ] = None,
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
    still: StillOption = False,
    columns: ColumnsOption = None,
    sample_time: SampleTimeOption = None,
    origin: OriginOption = Origin.MEASURED,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Find what the base model gets wrong, name the cause, extend the model, measure the gain.

    The exit code is 0 for every verdict.
    """
    from psa_casadi.simulation.timings import stage, timed

    outputs = {
        "--output": output,
        "--patch": patch,
        "--json": json,
        "--report": report,
        "--figure": figure,
    }
    with timed() as spent:
        with stage("loading"):
            from psa_casadi.cli import diagnosis_files as files
            from psa_casadi.cli.events import events_to
            from psa_casadi.cli.inputs import Given
            from psa_casadi.diagnosis.diagnose import diagnose as run
            from psa_casadi.diagnosis.result import DiagnosisInterrupted
            from psa_casadi.report.words.text import story
            from psa_casadi.report.words.timings import timings_table
        with stage("reading"):
            given, held = Given(effects), holdout or []
            given.stiffness(stiffness)
            beside = {"--next": following, "--events": events}
            given.outputs({**outputs, **beside}, [*records, *held, model])
            _keep_apart(given, output, model)
            found = given.records(records, held_out=held, columns=columns, sample_time=sample_time)
            start, table = given.model(model), given.searched(leave_out or ())
            given.check()
        count = len(records)
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
            told = story(d, origin=origin.value, width=width())
    show(told, quiet)
    _tell_files(d, outputs, unpatched, quiet)
    if timings:
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
            d = _with_next(d, following, progress)
        progress("writing")
        with stage("writing"):
            files.write(d, {**outputs, "--patch": None}, origin, written, still=still)
        with stage("unnamed correction"):
            return d, _write_patch(d, outputs["--patch"], progress)
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


def _with_next(d: "Diagnosis", path: Path | None, progress: Callable[[str], None]) -> "Diagnosis":
    """Design and write the record that resolves an ambiguous verdict, and say so in the result."""
    if path is None or d.verdict != "ambiguous":
        return d
    from dataclasses import replace

    from psa_casadi.design.experiment.experiment import resolving_experiment
    from psa_casadi.diagnosis.result import NextExperiment
    from psa_casadi.diagnosis.search.contenders import one_of_each
    from psa_casadi.errors import PsaError
    from psa_casadi.report.page.experiment_part import sentences, write_voltage

    told, same = one_of_each(d.contenders, d.experiments)
    if same and len(told) < 2:
        return d
    try:
        design = resolving_experiment(d, progress=progress)
    except PsaError as error:
        why = f"{d.next_experiment.why} No record could be designed: {error}"
        return replace(d, next_experiment=replace(d.next_experiment, why=why))
    each = sentences(design, d.model.values.get("C_p"))
    if design.plays is None:  # not worth a record; the last sentence is what an amplifier needs
        why = " ".join((d.next_experiment.why, *each[:-1], same)).rstrip()
        return replace(d, next_experiment=replace(d.next_experiment, why=why))
    write_voltage(path, design.record)
    why = " ".join((f"Apply {path} and diagnose all records together.", *each, same)).rstrip()
    following = NextExperiment(str(path), design.names, why, dict(design.chance))
    return replace(d, next_experiment=following)


def _write_patch(d: "Diagnosis", path: Path | None, progress: Callable[[str], None]) -> str:
    """Write the model with the unnamed correction; say why where there is none to write."""
    if path is None:
        return ""
    import psa_casadi as psa
    from psa_casadi.errors import PsaError

    progress("fitting the unnamed correction")
    try:
        psa.save_model(psa.patched_model(d), path)
    except PsaError as error:
        return f"{path} was not written: {error}"
    return ""
