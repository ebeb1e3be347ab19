"""`psa identify`: the parameters of a stack, with intervals."""

from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import (
    ColumnsOption,
    EffectsOption,
    Form,
    HysteresisOption,
    Origin,
    OriginOption,
    Quiet,
    SampleTimeOption,
    StackOption,
    StartModelOption,
    StillOption,
    show,
    tell_written,
    width,
    working,
)
from psa_casadi.cli.steps import IDENTIFY

if TYPE_CHECKING:
    from psa_casadi.identification.identify import Identification
    from psa_casadi.identification.profile import Profile


class Method(StrEnum):
    """How the parameters are found."""

    PREDICTION_ERROR = "prediction-error"
    PAPER = "paper"


def identify(
    records: Annotated[
        list[Path],
        typer.Argument(
            help="Records of one device: CSV, Excel, MATLAB and other files.", show_default=False
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="MODEL.json to write.")
    ] = None,
    model: StartModelOption = None,
    stack: StackOption = None,
    stiffness: Annotated[
        float | None, typer.Option(help="Stiffness of the free stack [N/m]; fixes the force scale.")
    ] = None,
    hysteresis: HysteresisOption = None,
    method: Annotated[
        Method, typer.Option(help="How the parameters are found.")
    ] = Method.PREDICTION_ERROR,
    profile: Annotated[
        list[str] | None,
        typer.Option(help="Parameter whose profile likelihood is wanted; may be repeated."),
    ] = None,
    json: Annotated[
        Path | None, typer.Option(help="JSON file of parameters and records to write.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="HTML page of the fit to write.")] = None,
    still: StillOption = False,
    columns: ColumnsOption = None,
    sample_time: SampleTimeOption = None,
    origin: OriginOption = Origin.MEASURED,
    effects: EffectsOption = None,
    quiet: Quiet = False,
) -> None:
    """Fit the model of a stack to records; show which parameters the data determine."""
    from psa_casadi.cli.inputs import Given
    from psa_casadi.identification.identify import identify as run
    from psa_casadi.identification.paper import identify_by_paper as by_paper
    from psa_casadi.report.words.advice_words import profile_sentences
    from psa_casadi.report.words.text import identification_text

    given = Given(effects, quiet=quiet)
    if method is Method.PAPER and profile:
        given.add("--method paper has no likelihood; leave --profile or --method out.")
    if method is Method.PAPER and (model, stack) != (None, None):
        given.add("--method paper starts from no model; leave --model, --stack or --method out.")
    if method is Method.PAPER and hysteresis not in (None, Form.BOUC_WEN):
        given.add("--method paper finds Bouc-Wen parameters; leave --hysteresis or --method out.")
    given.stiffness(stiffness)
    given.outputs({"--output": output, "--json": json, "--report": report}, [*records, model])
    measured = given.records(records, columns=columns, sample_time=sample_time)
    start = given.model_or_stack(model, stack, needed=False)
    given.check()
    with working("identifying", quiet, IDENTIFY) as progress:
        if method is Method.PAPER:
            found = by_paper(measured, stiffness=stiffness, progress=progress)
        else:
            found = run(
                measured,
                model=start,
                stiffness=stiffness,
                hysteresis=hysteresis.value if hysteresis else None,
                progress=progress,
            )
        profiles = _finish(
            found, output, (json, report, still), profile or (), origin.value, progress
        )
    show(identification_text(found, origin=origin.value, width=width()), quiet)
    for found_profile in profiles:
        show("\n" + "\n".join(profile_sentences(found_profile)), quiet)
    left_out = [n for n in profile or () if n not in found.determinacy.names]
    if left_out:
        show(
            f"\nNo profile of {', '.join(left_out)}: not searched in this fit; the parameters"
            f" searched are {', '.join(found.determinacy.names)}.",
            quiet,
        )
    tell_written(output, json, report, quiet=quiet)


def _finish(
    found: "Identification",
    output: Path | None,
    more: tuple[Path | None, Path | None, bool],
    wanted: Sequence[str],
    origin: str,
    progress: Callable[[str], None],
) -> "list[Profile]":
    """Write the files and return the profiles; at an interrupt the model is kept, which it says.

    `more` are the JSON file, the page, and whether that is still.
    """
    from psa_casadi.cli.failures import kept
    from psa_casadi.files import atomic_write
    from psa_casadi.identification.profile import profile
    from psa_casadi.model.model_file import save_model
    from psa_casadi.report.documents.files import identification_file
    from psa_casadi.report.page.results import write_fit_report
    from psa_casadi.strict_json import json_text

    json, report, still = more
    done: list[Path] = []
    try:
        if output is not None:
            save_model(found.model, output)
            done.append(output)
        names = [n for n in wanted if n in found.determinacy.names and not found.interrupted]
        profiles = [profile(found.fit, found.experiments, n, progress=progress) for n in names]
        if json is not None:
            atomic_write(json, json_text(identification_file(found, profiles)))
            done.append(json)
        if report is not None and not found.interrupted:
            progress("writing the report")
            write_fit_report(found, report, origin=origin, profiles=profiles, still=still)
        ended = found.interrupted
    except KeyboardInterrupt:
        if output is not None and output not in done:
            save_model(found.model, output)
            done.append(output)
        ended = True
    if not ended:
        return profiles
    cut = found.fit.interrupted
    what = "the search was cut off" if cut else "the fit was finished before"
    mark = " (marked as interrupted)" if cut else ""
    missing = [p for p in (output, json, report) if p not in done]
    raise KeyboardInterrupt(kept(what, done, missing, mark))
