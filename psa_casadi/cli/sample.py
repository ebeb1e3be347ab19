"""`psa sample`: whole posteriors of a model's parameters."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

import psa_casadi as psa
from psa_casadi.cli.inputs import Fitting, Inputs, own_model
from psa_casadi.cli.options import Origin, Reading, StackName
from psa_casadi.cli.screen import show, show_written, width, working
from psa_casadi.common.files import atomic_write


def sample(
    records: list[Path],
    *,
    model: Path | None = None,
    stack: StackName = None,
    output: Path | None = None,
    prior: list[str] | None = None,
    chains: Annotated[int, typer.Option(min=1)] = 4,
    draws: Annotated[int, typer.Option(min=4)] = 1000,
    tune: Annotated[int, typer.Option(min=1)] = 500,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    json: Path | None = None,
    figure: Path | None = None,
    report: Path | None = None,
    reading: Reading,
    fitting: Fitting,
    origin: Origin = "measured",
    inputs: Inputs,
) -> None:
    """Draw the parameters of a model from their posterior for these records (extra sample).

    The No-U-Turn sampler on exact gradients; priors are weak unless --prior sets them.

    Options:
        model: MODEL.json whose values the chains start near, or your model.
        output: netCDF file of the draws to write, as ArviZ has it.
        free: Parameter to sample; may be repeated. By default those that the model was fitted in,
            for your model all that may be fitted.
        prior: Prior of a parameter, NAME=CENTRE:WIDTH in SI units, as k_L=7.3:0.1; the width is
            that of the logarithm where a parameter spans decades, else in ordinary changes. May be
            repeated.
        chains: Number of chains.
        draws: Draws of each chain that are kept.
        tune: Draws before these, to adapt step and metric.
        seed: Seed of all that is random.
        json: JSON file of the figures to write.
        figure: Picture of prior and posterior to write, PNG, SVG or PDF as its name ends.
        report: HTML page to write.

    Example:
        psa sample record.csv --model model.json -o posterior.nc --figure posterior.png
    """
    from psa_casadi.common.strict_json import json_text
    from psa_casadi.documents.files import posterior_file
    from psa_casadi.report.plots.figures import posterior_figure, write_figure
    from psa_casadi.report.words.text import posterior_text

    if (model, stack) == (None, None) and len(records) > 1 and records[0].suffix == ".json":
        model, *records = records  # as it was written before there was --model here
    files = {"--output": output, "--json": json, "--figure": figure, "--report": report}
    inputs.outputs(files, [model, *records])
    form = "NAME=CENTRE:WIDTH, such as k_L=7.3:0.1"
    priors = inputs.named("--prior", prior, form, (2,))
    centres, widths = ({n: pair[k] for n, pair in priors.items()} for k in (0, 1))
    start = own_model(inputs, model, fitting if fitting.fmu else replace(fitting, free=None))
    measured: Sequence[psa.Record | psa.Signals]
    if start is not None:
        inputs.refuse({"--stack": stack})
        measured = inputs.signals(start, records, reading)
    else:
        measured = inputs.records(records, reading)
        start = inputs.model_or_stack(model, stack)
    start = inputs.ready(start)
    with working("sampling") as progress:
        result = psa.sample(
            start, measured, prior=centres, widths=widths, chains=chains, draws=draws, tune=tune,
            seed=seed, progress=progress, **fitting.words,
        )  # fmt: skip
        if output is not None:
            progress("writing the draws")
            result.save(output)
        if json is not None:
            atomic_write(json, json_text(posterior_file(result)))
        if figure is not None:
            write_figure(posterior_figure(result), figure)
        if report is not None:
            psa.report(result, report)
    show(posterior_text(result, origin=origin, width=width()))
    show_written(*files.values())
