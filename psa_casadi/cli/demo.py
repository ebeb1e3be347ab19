"""`psa demo`: the whole story on a synthetic record that ships with the package."""

from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from pathlib import Path
from typing import Annotated

import typer

import psa_casadi as psa
from psa_casadi.cli.inputs import Inputs
from psa_casadi.cli.screen import DIAGNOSE, IDENTIFY, show, show_table, width, working
from psa_casadi.common.errors import InputError
from psa_casadi.common.files import atomic_write, make_folder

RECORD, _ORIGIN = "synthetic_record.csv", "synthetic"


def demo(
    directory: Annotated[Path | None, typer.Argument(show_default="psa_demo")] = None,
    *,
    output: Path | None = None,
    quiet: bool = False,
) -> None:
    """Identify, diagnose, extend, export and check a stack, on a synthetic record.

    Options:
        directory: Where to leave the files; it is created.
        output: The same as DIRECTORY.

    Example:
        psa demo my_demo
    """
    from psa_casadi.diagnosis.diagnose import diagnose
    from psa_casadi.diagnosis.probes import laws_of, screened_with
    from psa_casadi.export.fmu.platforms import make_compiler_ready
    from psa_casadi.identification.identify import identify
    from psa_casadi.identification.start.ordinary import starting_model
    from psa_casadi.report.words.catalogue import TABLES, say
    from psa_casadi.report.words.tables import check_table
    from psa_casadi.report.words.text import check_sentence
    from psa_casadi.simulation.side_by_side import compiled_ahead
    from psa_casadi.simulation.stepper import make_ready

    directory, paths = _prepared(Inputs(quiet=quiet), directory, output)
    record = psa.read_record(paths[RECORD], need_excitation=True)
    show(say("demo.begin"))
    start = starting_model([record])
    effects = [e for e in psa.EFFECTS.values() if not e.needs_column and not e.inputs]
    searched = reversed(screened_with(start, effects, laws_of(start, [record], effects)))
    with (
        working("identifying", IDENTIFY) as progress,
        compiled_ahead(searched, first=[make_compiler_ready]),
    ):
        psa.save_model(identify([record], progress=progress).model, paths["model.json"])
    with ThreadPoolExecutor(1) as others, working("diagnosing", DIAGNOSE) as progress:
        d = diagnose([record], progress=progress)
        exported = others.submit(psa.export_fmu, d.model, paths["extended.fmu"])
        others.submit(make_ready, d.model.plant())  # the check simulates with it
        psa.save_model(d.model, paths["extended.json"])
        atomic_write(paths["diagnosis.json"], d.to_json())
        extended = str(paths["extended.json"])
        psa.write_report(d, paths["report.html"], origin=_ORIGIN, model_file=extended)
        psa.save_figure(d, paths["diagnosis.png"], origin=_ORIGIN)
    text = psa.story(d, origin=_ORIGIN, width=width(), model_file=extended)
    show(f"\n{text}\n\n{say('demo.hidden')}\n")
    with working("exporting and checking the FMU"):
        exported.result()
        checked = psa.check_fmu(paths["extended.fmu"], d.model)
    show_table(check_table(checked))
    files = "\n".join(f"  {name:<20}  {meaning}" for name, meaning in TABLES["demo_file"].items())
    show(f"\n{check_sentence(checked)}\n\nleft in {directory}:\n{files}")
    if not checked.passed:
        raise typer.Exit(1)
    show(say("demo.next", report=paths["report.html"]))


def _prepared(
    inputs: Inputs, named: Path | None, output: Path | None
) -> tuple[Path, dict[str, Path]]:
    """Create the directory, check that every file can be written, copy the record to it."""
    from psa_casadi.report.words.catalogue import TABLES

    if named is not None and output is not None:
        raise InputError(f"{named} and -o {output} name two directories; leave one of them out.")
    directory = named or output or Path("psa_demo")
    make_folder(directory)
    paths = {name: directory / name for name in TABLES["demo_file"]}
    inputs.outputs(paths, [])
    inputs.check()
    packaged = resources.files("psa_casadi").joinpath("data", "demo.csv")
    atomic_write(paths[RECORD], packaged.read_bytes())
    return directory, paths
