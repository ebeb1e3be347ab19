"""The table of subcommands."""

import shlex
import sys
from typing import Annotated

import typer

from psa_casadi.cli.batch import batch
from psa_casadi.cli.check import check
from psa_casadi.cli.compare import compare
from psa_casadi.cli.datasets import datasets
from psa_casadi.cli.demo import demo
from psa_casadi.cli.design_experiment import experiment
from psa_casadi.cli.design_input import input_
from psa_casadi.cli.design_mechanism import mechanism
from psa_casadi.cli.diagnose import diagnose
from psa_casadi.cli.effects import effects
from psa_casadi.cli.examples import examples
from psa_casadi.cli.export_c import c
from psa_casadi.cli.export_fmu import fmu
from psa_casadi.cli.export_modelica import modelica
from psa_casadi.cli.export_ssp import ssp
from psa_casadi.cli.failures import guarded
from psa_casadi.cli.identify import identify
from psa_casadi.cli.sample import sample
from psa_casadi.cli.simulate import simulate
from psa_casadi.cli.stacks import stacks
from psa_casadi.cli.surroundings import prepare
from psa_casadi.cli.web import web
from psa_casadi.command_line import typed
from psa_casadi.version import __version__

app = typer.Typer(
    name="psa",
    help="Models of piezoelectric stack actuators: identify, diagnose what is missing, export.",
    epilog="Start with: psa demo",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
export = typer.Typer(help="Write a model in a format that other tools read.", no_args_is_help=True)
design = typer.Typer(
    help="Design the next experiment, a voltage that follows a path, or a mounting.",
    no_args_is_help=True,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"psa_casadi {__version__}")
        raise typer.Exit


@app.callback()
def _main(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and stop."
        ),
    ] = False,
) -> None:
    """Models of piezoelectric stack actuators: identify, diagnose what is missing, export."""


app.command(epilog="Example: psa demo my_demo")(guarded(demo))
app.command(epilog="Example: psa identify slow.csv fast.csv -o model.json --report fit.html")(
    guarded(identify)
)
app.command(
    epilog="Example: psa sample model.json record.csv -o posterior.nc --figure posterior.png"
)(guarded(sample))
app.command(epilog="Example: psa simulate --model model.json --input planned.csv -o motion.csv")(
    guarded(simulate)
)
app.command(
    epilog="Example: psa diagnose a.csv --holdout b.csv -o extended.json --report report.html"
)(guarded(diagnose))
app.command(epilog="Example: psa batch records -o results --report population.html")(guarded(batch))
app.command(epilog="Example: psa compare before.json after.json -o compare.html")(guarded(compare))
app.command(epilog="Example: psa effects slow_creep")(guarded(effects))
app.command(epilog="Example: psa stacks P-885.51")(guarded(stacks))
app.add_typer(export, name="export")
export.command(epilog="Example: psa export fmu --model extended.json -o stack.fmu")(guarded(fmu))
export.command(epilog="Example: psa export modelica --model extended.json -o PiezoStack.mo")(
    guarded(modelica)
)
export.command(epilog="Example: psa export c --stack P-885.51 --step 10us -o code")(guarded(c))
export.command(epilog="Example: psa export ssp --stack P-885.51 -o stage.ssp")(guarded(ssp))
app.add_typer(design, name="design")
design.command(
    epilog="Example: psa design experiment --stack P-885.51 --duration 2"
    " --separate field_dependent_gain rate_independent_asymmetry -o voltage.csv"
)(guarded(experiment))
design.command(epilog="Example: psa design mechanism --stack PTBS200 --damping 0.7 -o mount.json")(
    guarded(mechanism)
)
design.command(
    "input",
    epilog="Example: psa design input --stack P-885.51 --move 2 10 --min-voltage -20"
    " --max-voltage 120 -o move.csv",
)(guarded(input_))
app.command(epilog="Example: psa check stack.fmu --model extended.json")(guarded(check))
app.command(epilog="Example: psa web extended.json -o page.html")(guarded(web))
app.command(epilog="Example: psa examples van_der_pol -o van_der_pol")(guarded(examples))
app.command(epilog="Example: psa datasets micromanipulator -o records")(guarded(datasets))


def main() -> None:
    """Run the command line."""
    prepare()
    typed.set(shlex.join(["psa", *sys.argv[1:]]))
    try:
        guarded(app)(prog_name="psa")
    except typer.Exit as end:  # of what fails outside the commands, such as writing the help
        sys.exit(end.exit_code)
