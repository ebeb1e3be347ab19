"""`psa diagnose`: what the simulation gets wrong, the cause, the extended model, the gain."""

import time as clock
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatch
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

import psa_casadi as psa
from psa_casadi.cli.failures import Outputs, judge
from psa_casadi.cli.inputs import Fitting, Inputs, meant, own_model
from psa_casadi.cli.options import Hysteresis, Origin, Reading, StackName, names
from psa_casadi.cli.screen import (
    DIAGNOSE,
    events_to,
    show,
    show_results,
    show_written,
    width,
    working,
)


def diagnose(
    records: list[Path],
    *,
    holdout: list[Path] | None = None,
    reference: list[Path] | None = None,
    model: Path | None = None,
    stack: StackName = None,
    stiffness: float | None = None,
    hysteresis: Hysteresis = None,
    output: Path | None = None,
    patch: Path | None = None,
    json: Path | None = None,
    report: Path | None = None,
    figure: Path | None = None,
    next_: Path | None = None,
    timings: bool = False,
    leave_out: Annotated[list[str] | None, typer.Option(autocompletion=names("effects"))] = None,
    events: Path | None = None,
    expect: Annotated[str | None, typer.Option(autocompletion=names("verdicts"))] = None,
    max_error: str | None = None,
    junit: Path | None = None,
    still: bool = False,
    reading: Reading,
    fitting: Fitting,
    origin: Origin = "measured",
    inputs: Inputs,
) -> None:
    """Find what the base model gets wrong, name the cause, extend the model, measure the gain.

    The exit code is 0 for every verdict; with --expect or --max-error it is 1 where the result is
    not as specified. For your model, --model FILE.py:FUNCTION or an FMU, it searches the
    effects at its inputs, rates and outputs.

    Options:
        model: MODEL.json whose values the fits start from, or your model.
        holdout: Record kept for judging only (repeat the option for several); without it, a quarter
            of every record, in blocks.
        reference: Record of the same device when it was healthy (repeat the option for several):
            what has changed since is named.
        output: MODEL.json of the extended model.
        patch: MODEL.json of the extended model with the unnamed correction, where one helps.
        json: DIAGNOSIS.json to write.
        report: HTML page to write.
        figure: Picture to write, PNG, SVG or PDF as its name ends.
        next_: VOLTAGE.csv to write if the verdict is ambiguous and a further record would decide;
            by default next to the JSON file or the page.
        timings: Print what each stage took: time, processor time, simulations.
        leave_out: Effect that is not to be looked for, as one that cannot be there; repeat the
            option for several. For your model, the first letters of such effects' names.
        events: File that gets a line of JSON for every fit of the search while it runs: its causes,
            evidence, score and errors.
        expect: Verdicts of which one must come out, with commas between, else exit code 1:
            adequate, cause_named, partly_explained, ambiguous, unexplained, not_driven. One that
            held-out samples cannot confirm is not adequate.
        max_error: Largest held-out error of the extended model, in % of the range, as 0.5%, else
            exit code 1.

    Example:
        psa diagnose a.csv --holdout b.csv -o extended.json --report report.html
    """
    from psa_casadi.simulation.timings import stage, timed

    outputs = {
        "--output": output, "--patch": patch, "--json": json, "--report": report,
        "--figure": figure,
    }  # fmt: skip
    began, left_out = clock.perf_counter(), leave_out or []
    paths = records, holdout or [], reference or []
    any_model = own_model(inputs, model, fitting)
    with timed() as spent:
        with stage("loading"):
            from psa_casadi.cli import diagnosis_files as files
            from psa_casadi.diagnosis.result import DiagnosisInterrupted
            from psa_casadi.report.words.tables import timings_table
        with stage("reading"):
            _demand_model_name(inputs, output)
            further = {"--next": next_, "--events": events, "--junit": junit}
            inputs.outputs(outputs | further, [*chain(*paths), model, fitting.fmu])
            if any_model is None:
                start, form = (model, stack), (stiffness, hysteresis)
                run = _of_stack(inputs, reading, paths, start, form, left_out)
                _keep_apart(inputs, output, model)
            else:
                run = _of_any(
                    inputs, reading, paths, any_model, fitting, left_out, {
                        "--reference": reference, "--next": next_, "--stack": stack,
                        "--stiffness": stiffness, "--hysteresis": hysteresis,
                    },
                )  # fmt: skip
            wanted = files.expected(inputs, expect, max_error)
            inputs.check()
        with working("diagnosing", DIAGNOSE) as progress, events_to(events) as watch:
            try:
                d = files.noted(run(progress=progress, watch=watch), left_out)
            except DiagnosisInterrupted as stop:
                raise files.unfinished(stop, Outputs(outputs)) from None
            place = next_ or next_voltage(json or report)
            d, unpatched = _finish(d, place, outputs, (origin, still), progress)
        with stage("writing"):
            path = str(output) if output else None
            text = psa.story(d, origin=origin, width=width(), model_file=path)
    show(text)
    _show_files(d, outputs, unpatched)
    if timings:
        show_results((), [timings_table(spent.stages)])
        show(f"\nprocessor time with the start of Python: {clock.process_time():.2f} s")
    subject = ", ".join(p.name for p in records)
    judge("diagnose", subject, files.cases(d, *wanted), junit, began, show_failures=True)


def _demand_model_name(inputs: Inputs, output: Path | None) -> None:
    if output is not None and output.suffix.lower() in (".fmu", ".ssp", ".ssv"):
        inputs.add(f"{output}: --output is a MODEL.json, which `psa export` takes on; name it so.")


#: Records to diagnose, to hold out, and of the healthy device.
_Paths = tuple[Sequence[Path], Sequence[Path], Sequence[Path]]


def _of_stack(
    inputs: Inputs, reading: Reading, paths: _Paths, start: tuple[Path | None, str | None],
    form: tuple[float | None, Hysteresis], left_out: Sequence[str],
) -> "Callable[..., psa.Diagnosis]":  # fmt: skip
    """Read the records of a stack; return a function of `progress` and `watch` that diagnoses them.

    `start` is the model or the stack that the fits start from, `form` stiffness and hysteresis.
    """
    from psa_casadi.diagnosis.diagnose import diagnose as run

    effects, (stiffness, hysteresis) = _searched(inputs, left_out), form
    inputs.stiffness(stiffness)
    new, held, healthy = paths
    read = inputs.records([*new, *healthy], reading, held)
    first, last = len(new), inputs.fitted
    return partial(
        run, read[:first], reference=read[first:last], holdout=read[last:],
        model=inputs.model_or_stack(*start, needed=False), stiffness=stiffness,
        hysteresis=hysteresis, effects=effects,
    )  # fmt: skip


def _of_any(
    inputs: Inputs, reading: Reading, paths: _Paths, model: "psa.Model", fitting: Fitting,
    left_out: Sequence[str], others: Mapping[str, object],
) -> "Callable[..., psa.Diagnosis]":  # fmt: skip
    """Read the records of a model that is no stack; return a function as `_of_stack` does.

    `others` are options that must be empty.
    """
    inputs.refuse(others)
    measured, held = (inputs.signals(model, part, reading) for part in paths[:2])
    return partial(
        psa.diagnose, model, measured, holdout=held, leave_out=left_out,
        effects=inputs.effects_of_any_model(), **fitting.words,
    )  # fmt: skip


def _finish(
    d: "psa.Diagnosis",
    following: Path | None,
    outputs: Mapping[str, Path | None],
    page: tuple[str, bool],
    progress: Callable[[str], None],
) -> "tuple[psa.Diagnosis, str]":
    """Design what follows and write all files; return the diagnosis and why a patch is missing.

    `page` is the origin of the records, and whether the page is still.
    """
    from psa_casadi.cli import diagnosis_files as files
    from psa_casadi.simulation.timings import stage

    written, (origin, still) = Outputs(outputs), page
    try:
        with stage("next experiment"):
            d = files.with_next(d, following, progress)
        progress("writing")
        with stage("writing"):
            files.write(d, written, origin, still=still)
        with stage("unnamed correction"):
            return d, files.write_patch(d, outputs["--patch"], progress)
    except KeyboardInterrupt:
        raise files.finished(d, written) from None


def _keep_apart(inputs: Inputs, output: Path | None, model: Path | None) -> None:
    """Demand that no model written next to the output is the one that is read."""
    if output is None or model is None or model.resolve().parent != output.resolve().parent:
        return
    if fnmatch(model.name, f"{output.stem}_*_for_*.json"):
        inputs.add(f"{model}: a model next to {output} could overwrite it; give -o another name.")


def _searched(inputs: Inputs, left_out: Sequence[str]) -> "tuple[psa.Component, ...]":
    """Return the effects to search, without those that --leave-out names."""
    from psa_casadi.model.user_effects import known_effects

    known = known_effects(inputs.user_effects)
    for name in dict.fromkeys(n for n in left_out if n not in known):
        inputs.add(
            f"--leave-out: there is no effect '{name}'; {meant(name, known)}`psa effects` lists"
            " them."
        )
    return tuple(c for n, c in known.items() if n not in left_out)


def _show_files(d: "psa.Diagnosis", outputs: Mapping[str, Path | None], unpatched: str) -> None:
    """Name the files that were written, and say why a patch is missing."""
    from psa_casadi.cli import diagnosis_files as files

    written = [None if o == "--patch" and unpatched else p for o, p in outputs.items()]
    following = d.next_experiment.voltage_csv if isinstance(d, psa.StackDiagnosis) else None
    show_written(*written, following)
    for line in [*files.models(d, outputs["--output"]), *([unpatched] if unpatched else [])]:
        show(line)


def next_voltage(path: Path | None) -> Path | None:
    """Return the file of the next voltage next to a file of the diagnosis."""
    return path.with_name(f"{path.stem}_next.csv") if path is not None else None
