"""`python -m tests.studies causes`: write the data set, answer it, and compare two methods."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import typer

from psa_casadi import InputError
from psa_casadi.cli.failures import guarded
from psa_casadi.cli.screen import Quiet, set_quiet, show_table, working
from tests.studies.benchmarks.causes import score
from tests.studies.benchmarks.causes.data import write
from tests.studies.benchmarks.causes.methods import METHODS, write_answer
from tests.studies.benchmarks.table import TitledTable, on_all_cores

SEED, CASES, QUICK = 20261126, 60, 10
Folder = Annotated[Path, typer.Argument(help="Folder of the data set, to write a new one.")]
Jobs = Annotated[int, typer.Option(min=1, help="Processes side by side.")]

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


def answer_all(
    data: Path, answers: Path, method: str, jobs: int, progress: Callable[[str], None]
) -> None:
    """Answer every case of a data set; a case that has an answer is skipped."""
    names = sorted(p.name for p in (data / "cases").iterdir())
    todo = [(answers, data, n) for n in names if not (answers / f"{n}.json").exists()]
    on_all_cores(write_answer, [(method, *job) for job in todo], progress, workers=jobs)


@app.command("write")
@guarded
def write_command(
    folder: Folder,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the cases.")] = SEED,
    cases: Annotated[int, typer.Option(min=1, help="Number of cases.")] = CASES,
    jobs: Jobs = 2,
    quiet: Quiet = False,
) -> None:
    """Write the data set: records, base model, possible causes, the truth apart, the score."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} is not empty; give a new folder for the data set.")
    set_quiet(quiet)
    with working("writing the data set") as progress:
        write(folder, seed, cases, progress, jobs)


@app.command("answer")
@guarded
def answer_command(
    folder: Folder,
    answers: Annotated[Path, typer.Argument(help="Folder for the answers.")],
    method: Annotated[
        Literal["psa", "sindy"], typer.Option(help="psa diagnose, or PySINDy.")
    ] = "psa",
    jobs: Jobs = 2,
    quiet: Quiet = False,
) -> None:
    """Answer the data set by psa diagnose, or by PySINDy (pip install pysindy)."""
    if not (folder / "data.json").is_file():
        raise InputError(f"{folder} has no data.json; write a data set there first.")
    set_quiet(quiet)
    with working("answering") as progress:
        answer_all(folder, answers, method, jobs, progress)


@app.command("table")
@guarded
def table_command(
    quick: Annotated[bool, typer.Option("--quick", help="Ten cases.")] = False,
    cases: Annotated[int | None, typer.Option(min=1, help="Number of cases.")] = None,
    quiet: Quiet = False,
) -> None:
    """Write the data set to a temporary folder, answer it both ways, and print the figures."""
    set_quiet(quiet)
    count = cases or (QUICK if quick else CASES)
    with tempfile.TemporaryDirectory() as name, working("benchmark causes") as progress:
        data, rows = Path(name) / "data", dict[str, dict[str, str]]()
        write(data, SEED, count, progress, jobs=2)
        for method in METHODS:
            answer_all(data, Path(name) / method, method, 2, progress)
            for figure, value in score.score(data, Path(name) / method)["figures"].items():
                rows.setdefault(figure, {"figure": figure})[method] = score.formatted(value)
    set_quiet(False)  # the table is the result
    show_table(TitledTable("Hidden causes", list(rows.values())).table)
