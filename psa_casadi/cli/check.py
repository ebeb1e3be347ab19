"""`psa check`: is an FMU valid, does it behave, does it agree with its model."""

import time
from pathlib import Path
from typing import Annotated

import typer

import psa_casadi as psa
from psa_casadi.cli.failures import Case, judge
from psa_casadi.cli.inputs import Inputs
from psa_casadi.cli.options import Reading, StackName
from psa_casadi.cli.screen import print_message, show, show_table, show_written, working
from psa_casadi.common.files import atomic_write


def check(
    fmu: Path,
    *,
    model: Path | None = None,
    stack: StackName = None,
    evidence: bool = False,
    record: list[Path] | None = None,
    columns: str | None = None,
    portable: bool = False,
    foreign: bool = False,
    json: Path | None = None,
    junit: Path | None = None,
    timeout: Annotated[float, typer.Option(min=0.1, max=1e6)] = 600.0,
    memory: Annotated[int, typer.Option(min=64)] = 4096,
    inputs: Inputs,
) -> None:
    """Check an FMU of FMI 2 or 3: description, calls, trajectories; exit code 1 if one fails.

    It is compared with the model that --model or --stack names, else with the one that it carries.
    One that another tool made is checked by the standard: a row fails where a clause is violated.

    This RUNS THE CODE of the FMU, as every simulation with it does. A separate
    process, with limits of time and memory, keeps its faults from the table.
    It is no sandbox: the code can read and write your files and use the
    network. Check an FMU that you do not trust in a container.

    Options:
        fmu: FMU to check.
        evidence: Play the run that the FMU carries as evidence, and compare it.
        record: Record that the model comes from (may be repeated): is its error as stated?
        foreign: Check it by the standard alone, as one that another tool made.
        portable: Its binary for Linux must load on old systems too: GNU libc 2.17.
        json: JSON file of all checks to write.
        timeout: Seconds that the whole check may take.
        memory: Memory that the FMU's code may take [MiB]; limited on Linux only.

    Example:
        psa check stack.fmu --model extended.json
    """
    from psa_casadi.common.strict_json import json_text
    from psa_casadi.documents.files import check_file
    from psa_casadi.report.words.tables import check_table
    from psa_casadi.report.words.text import check_sentence

    began = time.perf_counter()
    inputs.outputs({"--json": json, "--junit": junit}, [fmu, model])
    if not fmu.is_file():
        what = "is a directory" if fmu.is_dir() else "there is no such file"
        inputs.add(f"{fmu}: {what}; name an FMU.")
    chosen = inputs.model_or_stack(model, stack, any_model=True, needed=False)
    records = inputs.records(record, Reading(columns=columns)) if record else ()
    inputs.check()
    with working("checking"):
        report = psa.check_fmu(
            fmu, chosen, effects=inputs.user_effects, timeout=timeout, memory=memory << 20,
            evidence=evidence, records=records, portable=portable, foreign=foreign or None,
        )  # fmt: skip
    show_table(check_table(report))
    show(f"\n{check_sentence(report)}")
    if inputs.quiet and not report.passed:
        print_message(check_sentence(report))
    if json is not None:
        atomic_write(json, json_text(check_file(report)))
        show_written(json)
    judge("check", fmu.name, check_cases(report), junit, began)


def check_cases(report: "psa.CheckReport") -> list[Case]:
    """Return every check of an FMU as a test."""
    from psa_casadi.report.words.tables import check_table

    table, cases = check_table(report), []
    for r, texts in zip(report.rows, table.rows, strict=True):
        row = dict(zip(table.head, texts, strict=True))
        figures = f"found {row['found']}, allowed {row['allowed']}" if "found" in row else ""
        sentence = ": ".join(filter(None, (figures or row["clause"], row["remark"])))
        cases.append(Case(row["check"], sentence, "" if r.passed else sentence))
    return cases
