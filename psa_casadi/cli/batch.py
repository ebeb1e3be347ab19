"""`psa batch`: many devices, each identified or diagnosed, results one by one."""

from collections.abc import Sequence
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import (
    ColumnsOption,
    EffectsOption,
    HysteresisOption,
    Quiet,
    SampleTimeOption,
    show,
    tell_written,
    working,
)

if TYPE_CHECKING:
    from psa_casadi.devices.batch import BatchRun

#: Devices without a result that are told one by one.
_MOST_TOLD = 10


class Work(StrEnum):
    """What is done with every device."""

    IDENTIFY = "identify"
    DIAGNOSE = "diagnose"


def batch(
    records: Annotated[
        Path,
        typer.Argument(
            help="Folder with a folder or a file of records for each device, or a table of jobs"
            " (jobs.csv: device, batch, date, files).",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the results; it is made if needed.")
    ],
    work: Annotated[Work, typer.Option(help="What is done with every device.")] = Work.IDENTIFY,
    report: Annotated[
        Path | None, typer.Option(help="HTML page of the population to write.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Devices at a time; by default one for each core."),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            help="Address of a Dask scheduler that hands the devices out, such as tcp://HOST:8786,"
            " or local for a cluster on this machine (extra dask).",
            show_default=False,
        ),
    ] = None,
    model: Annotated[
        Path | None, typer.Option(help="MODEL.json whose values every fit starts from.")
    ] = None,
    stiffness: Annotated[
        float | None, typer.Option(help="Stiffness of the free stack [N/m]; fixes the force scale.")
    ] = None,
    hysteresis: HysteresisOption = None,
    columns: ColumnsOption = None,
    sample_time: SampleTimeOption = None,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Identify or diagnose many devices, each by itself, on all cores or a cluster.

    A device that fails is a result; the others go on. The same command goes on where a run was cut
    off. The exit code is 0 if there is a device with a result.
    """
    from psa_casadi.cli.inputs import Given
    from psa_casadi.devices.batch import batch as run
    from psa_casadi.devices.executors import dask_client
    from psa_casadi.devices.jobs import Options, jobs_given

    given = Given(effects)
    given.stiffness(stiffness)
    given.columns(columns)
    given.outputs({"--report": report}, [model])
    given.model(model)
    jobs = given.attempt(lambda: jobs_given(records))
    given.check()
    options = Options(
        work=work.value,
        model=model.read_text(encoding="utf-8-sig") if model else None,
        stiffness=stiffness,
        hysteresis=hysteresis.value if hysteresis else None,
        columns=columns,
        sample_time=sample_time,
        modules=tuple(effects or ()),
    )
    with ExitStack() as held, working("batch", quiet) as progress:
        client = held.enter_context(dask_client(dask, workers)) if dask else None
        done = run(
            jobs or (),
            output,
            options=options,
            executor=client,
            workers=workers,
            progress=progress,
        )
        page = _page(done, report)
    _tell(done, quiet)
    tell_written(*done.files, page, quiet=quiet)
    if report is not None and page is None:
        show(f"{report} was not written: fewer than four devices tell a parameter.", quiet)
    if not done.findings:
        raise typer.Exit(1)


def _page(done: "BatchRun", report: Path | None) -> Path | None:
    """Write the population's page where it is asked for and there is a population."""
    if report is None:
        return None
    from psa_casadi.errors import InputError
    from psa_casadi.population.population import population
    from psa_casadi.report.page.devices import write_population

    try:
        found = population(done.findings)
    except InputError:
        return None
    lost = [(d.device, d.status, " ".join(d.problems)) for d in done.devices if d.problems]
    write_population(found, report, without=lost)
    return report


def _tell(done: "BatchRun", quiet: bool) -> None:
    counts = ", ".join(f"{n} {status}" for status, n in done.counts.items())
    kept = f"; {done.kept} of them were there before" if done.kept else ""
    show(f"{len(done.devices)} devices: {counts}{kept}.", quiet)
    lost = [(d.device, d.status, " ".join(d.problems)) for d in done.devices if d.status != "done"]
    tell_lost(lost, done.files[0], quiet)


def tell_lost(lost: Sequence[tuple[str, str, str]], where: Path, quiet: bool) -> None:
    """Name devices without a result: how their work ended, and why; `where` has them all."""
    for device, status, why in lost[:_MOST_TOLD]:
        show(f"  {device}: {status}: {why}", quiet)
    if len(lost) > _MOST_TOLD:
        show(f"  ... and {len(lost) - _MOST_TOLD} more; {where} has them all.", quiet)
