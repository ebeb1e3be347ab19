"""`python -m tests.studies causes`: write the data set, answer it, and compare two methods."""

import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Literal

import typer

from psa_casadi.cli.failures import guarded
from psa_casadi.cli.screen import Quiet, show_table, working
from psa_casadi.errors import InputError
from psa_casadi.report.words.tables import Table
from tests.studies.benchmarks.causes import score
from tests.studies.benchmarks.causes.data import write
from tests.studies.benchmarks.causes.methods import by_psa, by_sindy, write_answer
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable

SEED, CASES, QUICK = 20261126, 60, 10
#: Who answers.
METHODS = {"psa": by_psa, "sindy": by_sindy}
Which = Literal["psa", "sindy"]


def run(progress: Progress, quick: bool) -> Outcome:
    """Write the data set, answer it by both methods, and return their figures."""
    with tempfile.TemporaryDirectory() as temporary:
        data, count = Path(temporary) / "data", QUICK if quick else CASES
        write(data, SEED, count, progress, jobs=2)
        columns = {}
        for method in METHODS:
            answers = Path(temporary) / method
            answer_all(data, answers, method, 2, progress)
            columns[method] = score.score(data, answers)["figures"]
    rows = [(k, *(score.shown(c[k]) for c in columns.values())) for k in columns["psa"]]
    table = Table(("figure", *METHODS), tuple(rows))
    return Outcome((TitledTable(f"Hidden causes, {count} cases of seed {SEED}", table),))


def answer_all(
    data: Path, answers: Path, method: str, jobs: int, progress: Callable[[str], None]
) -> None:
    """Answer every case of a data set; a case that has an answer is left as it is."""
    names = sorted(p.name for p in (data / "cases").iterdir())
    todo = [n for n in names if not (answers / f"{n}.json").exists()]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        for content in pool.map(METHODS[method], [data] * len(todo), todo):
            write_answer(answers, content)
            progress(f"case {content['case']}: {content['causes'] or 'nothing named'}")


def write_command(
    folder: Annotated[Path, typer.Argument(help="Folder to write, new or empty.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the cases.")] = SEED,
    cases: Annotated[int, typer.Option(min=1, help="Number of cases.")] = CASES,
    jobs: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = 2,
    quiet: Quiet = False,
) -> None:
    """Write the data set: records, base model, possible causes, the truth apart, the score."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder} is not empty; give a new folder for the data set.")
    with working("writing the data set", quiet) as progress:
        write(folder, seed, cases, progress, jobs)


def answer_command(
    folder: Annotated[Path, typer.Argument(help="Folder of the data set.")],
    answers: Annotated[Path, typer.Argument(help="Folder for the answers.")],
    method: Annotated[Which, typer.Option(help="psa diagnose, or PySINDy.")] = "psa",
    jobs: Annotated[int, typer.Option(min=1, help="Processes side by side.")] = 2,
    quiet: Quiet = False,
) -> None:
    """Answer the data set by psa diagnose, or by PySINDy (pip install pysindy)."""
    if not (folder / "data.json").is_file():
        raise InputError(f"{folder} has no data.json; write a data set there first.")
    with working("answering", quiet) as progress:
        answer_all(folder, answers, method, jobs, progress)


def table_command(
    quick: Annotated[bool, typer.Option("--quick", help="Ten cases.")] = False,
    quiet: Quiet = False,
) -> None:
    """Write the data set to a temporary folder, answer it both ways, and print the figures."""
    with working("benchmark causes", quiet) as progress:
        outcome = run(progress, quick)
    show_table(outcome.tables[0].table)


app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)
app.command("write")(guarded(write_command))
app.command("answer")(guarded(answer_command))
app.command("table")(guarded(table_command))
