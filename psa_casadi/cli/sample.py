"""`psa sample`: whole posteriors of a stack's parameters."""

from pathlib import Path
from typing import Annotated

import typer

from psa_casadi.cli.screen import (
    ColumnsOption,
    EffectsOption,
    Origin,
    OriginOption,
    Quiet,
    SampleTimeOption,
    StackOption,
    show,
    tell_written,
    width,
    working,
)


def sample(
    records: Annotated[
        list[Path],
        typer.Argument(
            help="Records of one device: CSV, Excel, MATLAB and other files.", show_default=False
        ),
    ],
    model: Annotated[
        Path | None,
        typer.Option(help="MODEL.json whose values the chains start near.", show_default=False),
    ] = None,
    stack: StackOption = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="netCDF file of the draws to write, as ArviZ has it."),
    ] = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            help="Parameter to sample; may be repeated. By default those that the model was fitted"
            " in.",
            show_default=False,
        ),
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(
            help="Prior of a parameter, NAME=CENTRE:WIDTH in SI units, as k_L=7.3:0.1; the width is"
            " that of the logarithm where a parameter spans decades, else in ordinary changes. May"
            " be repeated.",
            show_default=False,
        ),
    ] = None,
    chains: Annotated[int, typer.Option(min=1, help="Number of chains.")] = 4,
    draws: Annotated[int, typer.Option(min=4, help="Draws of each chain that are kept.")] = 1000,
    tune: Annotated[
        int, typer.Option(min=1, help="Draws before these, to adapt step and metric.")
    ] = 500,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all that is random.")] = 0,
    json: Annotated[Path | None, typer.Option(help="JSON file of the figures to write.")] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Picture of prior and posterior to write, PNG.")
    ] = None,
    columns: ColumnsOption = None,
    sample_time: SampleTimeOption = None,
    origin: OriginOption = Origin.MEASURED,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Draw the parameters of a stack from their posterior, given records (extra sample).

    The No-U-Turn sampler on exact gradients; priors are weak unless --prior says more.
    """
    from psa_casadi.cli.inputs import Given
    from psa_casadi.files import atomic_path, atomic_write
    from psa_casadi.posterior.sample import sample as run
    from psa_casadi.report.documents.files import posterior_file
    from psa_casadi.report.plots.figures import DPI, posterior_figure
    from psa_casadi.report.words.text import posterior_text
    from psa_casadi.strict_json import json_text

    given = Given(effects, quiet=quiet)
    if (model, stack) == (None, None) and len(records) > 1 and records[0].suffix == ".json":
        model, *records = records  # as it was written before there was --model here
    given.outputs({"--output": output, "--json": json, "--figure": figure}, [model, *records])
    centres, widths = given.priors(prior or ())
    measured = given.records(records, columns=columns, sample_time=sample_time)
    start = given.model_or_stack(model, stack)
    given.check()
    if start is None:
        return
    with working("sampling", quiet) as progress:
        found = run(
            start,
            measured,
            free=free,
            prior=centres,
            widths=widths,
            chains=chains,
            draws=draws,
            tune=tune,
            seed=seed,
            progress=progress,
        )
        if output is not None:
            progress("writing the draws")
            found.save(output)
        if json is not None:
            atomic_write(json, json_text(posterior_file(found)))
        if figure is not None:
            with atomic_path(figure) as temporary:
                posterior_figure(found).savefig(temporary, format="png", dpi=DPI)
    show(posterior_text(found, origin=origin.value, width=width()), quiet)
    tell_written(output, json, figure, quiet=quiet)
