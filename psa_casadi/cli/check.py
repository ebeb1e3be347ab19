"""`psa check`: is an FMU valid, does it behave, does it agree with its model."""

import time
from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.expected import JunitOption, judge
from psa_casadi.cli.screen import (
    ColumnsOption,
    EffectsOption,
    ModelOption,
    Quiet,
    StackOption,
    show,
    show_table,
    tell_written,
    working,
)


def check(
    fmu: Annotated[Path, typer.Argument(help="FMU to check.", show_default=False)],
    model: ModelOption = None,
    stack: StackOption = None,
    evidence: Annotated[
        bool,
        typer.Option(
            "--evidence", help="Play the run that the FMU carries as evidence, and compare it."
        ),
    ] = False,
    record: Annotated[
        list[Path] | None,
        typer.Option(
            help="Record that the model comes from (may be repeated): is its error as stated?"
        ),
    ] = None,
    columns: ColumnsOption = None,
    portable: Annotated[
        bool,
        typer.Option(
            "--portable", help="Its binary for Linux must load on old systems too: GNU libc 2.17."
        ),
    ] = False,
    json: Annotated[Path | None, typer.Option(help="JSON file of all checks to write.")] = None,
    junit: JunitOption = None,
    effects: EffectsOption = None,
    timeout: Annotated[
        float, typer.Option(help="Seconds that the whole check may take.", min=0.1, max=1e6)
    ] = 600.0,
    memory: Annotated[
        int,
        typer.Option(
            help="Memory that the FMU's code may take [MiB]; limited on Linux only.", min=64
        ),
    ] = 4096,
    quiet: Quiet = False,
) -> None:
    """Check an FMU of FMI 2 or 3: description, calls, trajectories; exit code 1 if one fails.

    It is compared with the model that --model or --stack names, else with the one that it carries.

    This RUNS THE CODE of the FMU, as every simulation with it does. A process
    of its own, with limits of time and memory, keeps its faults from the table.
    It is no sandbox: the code can read and write your files and use the
    network. Check an FMU that you do not trust in a container.
    """
    from psa_casadi.cli.inputs import Given
    from psa_casadi.export.check.check import check_fmu
    from psa_casadi.files import atomic_write
    from psa_casadi.report.documents.files import check_file
    from psa_casadi.report.documents.junit import check_cases
    from psa_casadi.report.words.tables import check_table
    from psa_casadi.report.words.text import check_sentence
    from psa_casadi.strict_json import json_text

    given, began = Given(effects), time.perf_counter()
    given.outputs({"--json": json, "--junit": junit}, [fmu, model])
    if not fmu.is_file():
        what = "is a directory" if fmu.is_dir() else "there is no such file"
        given.add(f"{fmu}: {what}; name an FMU that `psa export fmu` wrote.")
    chosen = given.model_or_stack(model, stack, any_model=True, needed=False)
    records = given.records(record, columns=columns) if record else ()
    given.check()
    with working("checking", quiet):
        report = check_fmu(
            fmu,
            chosen,
            effects=given.effects,
            timeout=timeout,
            memory=memory << 20,
            evidence=evidence,
            records=records,
            portable=portable,
        )
    show_table(check_table(report), quiet)
    show(f"\n{check_sentence(report)}", quiet)
    if json is not None:
        atomic_write(json, json_text(check_file(report)))
        tell_written(json, quiet=quiet)
    judge("check", fmu.name, check_cases(report), junit, began)
