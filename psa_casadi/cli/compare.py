"""`psa compare`: devices side by side, or a whole population, as one page."""

from pathlib import Path

import psa_casadi as psa
from psa_casadi.cli.batch import tell_lost
from psa_casadi.cli.inputs import Given
from psa_casadi.cli.screen import show_results, tell_written, working


def compare(files: list[Path], *, output: Path = Path("compare.html"), inputs: Given) -> None:
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
    inputs.outputs({"--output": output}, files, page="--output")
    inputs.check()
    with working("comparing", inputs.quiet):
        if len(files) == 1 and files[0].is_dir():
            result, lost = read_results(files[0], inputs.own)
            tell_lost(lost, output, inputs.quiet)
            displayed = population(result)
            psa.write_population(displayed, output, without=lost)
            texts = population_sentences(displayed)
        else:
            compared = psa.compare(*files, effects=inputs.own)
            compared.report(output)
            texts, tables = (compared.sentence,), compared.tables
    show_results(texts, tables, inputs.quiet)
    tell_written(output, quiet=inputs.quiet)
