"""The benchmark `fuzz`: damaged inputs, kills and hostile surroundings, counted; none may fail."""

import signal
from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.failures import guarded
from psa_casadi.cli.screen import Quiet, show, working
from psa_casadi.errors import InputError
from tests.studies.benchmarks.table import Outcome, Progress
from tests.studies.fuzz.campaign import Amount, Tally, replay
from tests.studies.fuzz.campaign import run as attack
from tests.studies.fuzz.table import TARGETS, chosen_targets, tables

_SECONDS, _QUICK_SECONDS = 60.0, 10.0


def run(progress: Progress, quick: bool) -> Outcome:
    """Attack everything for a minute, or for ten seconds."""
    amount = Amount(seconds=_QUICK_SECONDS if quick else _SECONDS)
    return Outcome(tables(attack(chosen_targets(()), 1, amount, progress=progress)))


def fuzz(
    *,
    seconds: Annotated[
        float, typer.Option(help="How long all targets are attacked together [s].")
    ] = _SECONDS,
    inputs: Annotated[
        int | None, typer.Option(help="Inputs of each target, in place of a time.")
    ] = None,
    first: Annotated[int, typer.Option("--from", help="Number of the first input.")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the inputs.")] = 1,
    only: Annotated[
        str | None,
        typer.Option(help="Targets or rooms, such as readers,kills; by default all."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(help="Processes side by side; by default one for each core.")
    ] = None,
    keep: Annotated[Path, typer.Option(help="Folder for the inputs that fail.")] = Path(
        "fuzz_failures"
    ),
    again: Annotated[
        Path | None, typer.Option("--replay", help="A saved input to attack with once more.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Attack the package with damaged inputs; exit code 1 if anything fails."""
    if again is not None:
        tally = replay(again, TARGETS)
        for distinct in tally.distinct.values():
            show(distinct.first.detail, quiet)
    else:
        tally = _campaign(seconds, inputs, first, seed, only, jobs, keep, quiet)
    for titled in tables(tally):
        show(f"\n{titled}", quiet)
    if tally.failures:
        raise typer.Exit(1)


def _campaign(
    seconds: float, inputs: int | None, first: int, seed: int, only: str | None, jobs: int | None,
    keep: Path, quiet: bool,
) -> Tally:  # fmt: skip
    names = [n.strip() for n in (only or "").split(",") if n.strip()]
    targets = chosen_targets(names)
    if inputs is not None and inputs < 1:
        raise InputError(f"--inputs is {inputs}; give how many, at least 1.")
    each = None if inputs is None else dict.fromkeys([t.name for t in targets], inputs)
    amount = Amount(seconds if each is None else float("inf"), each, first)
    for which in (signal.SIGINT, signal.SIGTERM):  # both end with a table, also in the background
        signal.signal(which, signal.default_int_handler)
    with working("attacking", quiet) as progress:
        return attack(targets, seed, amount, jobs=jobs, keep=keep, progress=progress)


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
app.command(epilog="Example: python -m tests.studies fuzz --seconds 3600 --only readers,files")(
    guarded(fuzz)
)
