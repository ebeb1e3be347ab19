"""`psa compare`: devices side by side, or a whole population, as one page."""

from pathlib import Path

import psa_casadi as psa
from psa_casadi.cli.batch import tell_lost
from psa_casadi.cli.inputs import Given
from psa_casadi.cli.screen import show_results, tell_written, working


def compare(files: list[Path], *, output: Path = Path("compare.html"), given: Given) -> None:
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
    given.outputs({"--output": output}, files, page="--output")
    given.check()
    with working("comparing", given.quiet):
        if len(files) == 1 and files[0].is_dir():
            found, lost = read_results(files[0], given.own)
            tell_lost(lost, output, given.quiet)
            shown = population(found)
            psa.write_population(shown, output, without=lost)
            told = population_sentences(shown)
        else:
            compared = psa.compare(*files, effects=given.own)
            compared.report(output)
            told, tables = (compared.sentence,), compared.tables
    show_results(told, tables, given.quiet)
    tell_written(output, quiet=given.quiet)
