"""`psa batch` and `psa compare`: many devices, each fitted or diagnosed, and side by side."""

from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated, Literal

import typer

import psa_casadi as psa
from psa_casadi.cli.inputs import PAGE, Fitting, Inputs, own_model
from psa_casadi.cli.options import Hysteresis, Reading
from psa_casadi.cli.screen import show, show_results, show_written, working

#: Devices without a result that are listed one by one.
_MOST_TOLD = 10


def batch(
    records: Path,
    *,
    output: Path,
    work: Literal["identify", "diagnose"] = "identify",
    report: Path | None = None,
    workers: Annotated[int | None, typer.Option(min=1)] = None,
    dask: str | None = None,
    model: Path | None = None,
    stiffness: float | None = None,
    hysteresis: Hysteresis = None,
    reading: Reading,
    fitting: Fitting,
    inputs: Inputs,
) -> None:
    """Identify or diagnose many devices, each by itself, on all cores or a cluster.

    A device that fails is a result; the others go on. The same command goes on where a run was cut
    off. The exit code is 0 if there is a device with a result.

    Options:
        records: Folder with a folder or a file of records for each device, or a table of jobs
            (jobs.csv: device, batch, date, files).
        output: Folder for the results; it is made if needed.
        work: What is done with every device.
        report: HTML page of the population to write.
        workers: Devices at a time; by default one for each core.
        dask: Address of a Dask scheduler that hands the devices out, such as tcp://HOST:8786, or
            local for a cluster on this machine (extra dask).
        model: MODEL.json whose values every fit starts from, or your model.

    Example:
        psa batch records -o results --report population.html
    """
    from psa_casadi.devices.executors import dask_client
    from psa_casadi.devices.jobs import jobs_given
    from psa_casadi.population.population import population
    from psa_casadi.report.words.population_words import missed_sentences

    inputs.stiffness(stiffness)
    any_model = own_model(inputs, model, fitting)
    if any_model is None:
        inputs.columns(reading.columns)
        inputs.model(model)
    inputs.outputs({"--report": report}, [model])
    jobs = inputs.attempt(lambda: jobs_given(records))
    inputs.check()
    text = model.read_text(encoding="utf-8-sig") if model and any_model is None else None
    options = psa.Options(
        work=work, model=any_model or text, stiffness=stiffness, hysteresis=hysteresis,
        columns=reading.columns, sample_time=reading.sample_time,
        modules=tuple(inputs.effects or ()), words=fitting.words,
    )  # fmt: skip
    whole = None
    with ExitStack() as held, working("batch") as progress:
        client = held.enter_context(dask_client(dask, workers)) if dask else None
        done = psa.batch(
            jobs or (), output, options=options, executor=client, workers=workers,
            progress=progress,
        )  # fmt: skip
        with suppress(psa.InputError):  # too few devices determine a parameter
            whole = population(done.findings) if report is not None else None
    rows = [(d, (d.device, d.status, " ".join(d.problems))) for d in done.devices]
    if report is not None and whole is not None:
        psa.write_population(whole, report, without=[row for d, row in rows if d.problems])
    counts = ", ".join(f"{n} {status}" for status, n in done.counts.items())
    kept = f"; {done.kept} of them were there before" if done.kept else ""
    show(f"{len(done.devices)} devices: {counts}{kept}.")
    show_lost([row for d, row in rows if d.status != "done"], done.files[0])
    for sentence in missed_sentences(done.findings):
        show(sentence)
    show_written(*done.files, report if whole else None)
    if report is not None and whole is None:
        show(f"{report} was not written: fewer than four devices determine a parameter.")
    if not done.findings:
        raise typer.Exit(1)


def show_lost(lost: Sequence[tuple[str, str, str]], where: Path) -> None:
    """Name devices without a result: how their work ended, and why; `where` has them all."""
    for device, status, why in lost[:_MOST_TOLD]:
        show(f"  {device}: {status}: {why}")
    if len(lost) > _MOST_TOLD:
        show(f"  ... and {len(lost) - _MOST_TOLD} more; {where} has them all.")


def compare(files: list[Path], *, output: Path = Path("compare.html"), inputs: Inputs) -> None:
    """Compare two or more devices side by side, or a population of many; write the page of that.

    A model and a diagnosis of the same records are one device. The page needs no network.

    Options:
        files: Two files or more of psa diagnose --json, psa identify --json or -o, or folders of
            devices; or the one folder of results of psa batch.
        output: HTML page to write.

    Example:
        psa compare before.json after.json -o compare.html
    """
    from psa_casadi.devices.batch import read_results
    from psa_casadi.population.population import population
    from psa_casadi.report.words.population_words import population_sentences
    from psa_casadi.report.words.tables import Table

    tables: tuple[Table, ...] = ()
    inputs.outputs({"--output": output}, files, PAGE)
    inputs.check()
    with working("comparing"):
        if len(files) == 1 and files[0].is_dir():
            findings, lost = read_results(files[0], inputs.user_effects)
            show_lost(lost, output)
            whole = population(findings)
            psa.write_population(whole, output, without=lost)
            texts = population_sentences(whole)
        else:
            compared = psa.compare(*files, effects=inputs.user_effects)
            compared.report(output)
            texts, tables = (compared.sentence,), compared.tables
    show_results(texts, tables)
    show_written(output)
