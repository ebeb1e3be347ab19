"""`psa compare`: devices side by side, or a whole population, as one page."""

from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.batch import tell_lost
from psa_casadi.cli.screen import EffectsOption, Quiet, show, tell_written, working


def compare(
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Two files or more of psa diagnose --json, psa identify --json or -o, or folders"
            " of devices; or the one folder of results of psa batch.",
            show_default=False,
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="HTML page to write.")] = Path(
        "compare.html"
    ),
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Write a page that shows two or more devices side by side, or a population of many.

    A model and a diagnosis of the same records are one device. The page needs no network.
    """
    from psa_casadi.cli.inputs import Given
    from psa_casadi.devices.batch import read_results
    from psa_casadi.population.population import population
    from psa_casadi.report.documents.findings import read_findings
    from psa_casadi.report.page.devices import write_comparison, write_population
    from psa_casadi.report.words.population_words import difference_sentence, population_sentences

    given = Given(effects)
    given.outputs({"--output": output}, files)
    given.check()
    with working("comparing", quiet):
        if len(files) == 1 and files[0].is_dir():
            found, lost = read_results(files[0], given.effects)
            tell_lost(lost, output, quiet)
            shown = population(found)
            write_population(shown, output, without=lost)
            told = population_sentences(shown)
        else:
            findings = read_findings(files, given.effects)
            write_comparison(findings, output)
            told = (difference_sentence(findings),)
    for sentence in told:
        show(sentence, quiet)
    tell_written(output, quiet=quiet)
