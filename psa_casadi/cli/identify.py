"""`psa identify`: the parameters of a stack, with intervals."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import psa_casadi as psa
from psa_casadi.cli.failures import Outputs
from psa_casadi.cli.inputs import Fitting, Inputs, own_model
from psa_casadi.cli.options import Hysteresis, Origin, Reading, StackName
from psa_casadi.cli.screen import IDENTIFY, print_message, show, show_written, width, working
from psa_casadi.common.files import atomic_write

if TYPE_CHECKING:
    from psa_casadi.identification.profile import Profile


def identify(
    records: list[Path],
    *,
    output: Path | None = None,
    model: Path | None = None,
    stack: StackName = None,
    stiffness: float | None = None,
    hysteresis: Hysteresis = None,
    method: Literal["prediction-error", "paper"] = "prediction-error",
    profile: list[str] | None = None,
    json: Path | None = None,
    report: Path | None = None,
    still: bool = False,
    reading: Reading,
    fitting: Fitting,
    origin: Origin = "measured",
    inputs: Inputs,
) -> None:
    """Fit the model of a stack to records; show which parameters the data determine.

    For your model, --model FILE.py:FUNCTION or an FMU, it fits the parameters that are
    free; columns are matched by the names of its inputs and outputs.

    Options:
        model: MODEL.json whose values the fits start from, or your model.
        output: MODEL.json to write; of an FMU also NAME.fmu, the FMU with these start values, or
            NAME.ssv, a parameter set of SSP.
        method: How the parameters are fitted.
        profile: Parameter whose profile likelihood is wanted; may be repeated.
        json: JSON file of parameters and records to write.
        report: HTML page of the fit to write.

    Example:
        psa identify slow.csv fast.csv -o model.json --report fit.html
    """
    from psa_casadi.identification.identify import StackIdentification
    from psa_casadi.identification.identify import identify as of_stack
    from psa_casadi.identification.paper import identify_by_paper
    from psa_casadi.report.words.notes import profile_sentences
    from psa_casadi.report.words.text import identification_text

    any_model = own_model(inputs, model, fitting)
    outputs = {"--output": output, "--json": json, "--report": report}
    inputs.outputs(outputs, [*records, model, fitting.fmu])
    if any_model is not None:
        of_stacks = {"--stack": stack, "--stiffness": stiffness, "--hysteresis": hysteresis}
        inputs.refuse({**of_stacks, "--method": method == "paper", "--profile": profile})
        signals = inputs.signals(any_model, records, reading)
        work: Callable[..., psa.Identification] = partial(
            psa.identify, any_model, signals, **fitting.words
        )
    else:
        inputs.stiffness(stiffness)
        measured = inputs.records(records, reading)
        start = inputs.model_or_stack(model, stack, needed=False)
        if method == "paper":
            _refuse_beside_paper(inputs, (model, stack), hysteresis, profile)
            work = partial(identify_by_paper, measured, stiffness=stiffness)
        else:
            work = partial(
                of_stack, measured, model=start, stiffness=stiffness, hysteresis=hysteresis
            )
    inputs.check()
    with working("identifying", IDENTIFY) as progress:
        result = work(progress=progress)
        profiles = _finish(result, outputs, profile or (), (origin, still), progress)
    text = repr(result)
    if isinstance(result, StackIdentification):
        text = identification_text(result, origin=origin, width=width())
    show(text)
    for likelihood in profiles:
        show("\n" + "\n".join(profile_sentences(likelihood)))
    if left_out := [n for n in profile or () if n not in result.determinacy.names]:
        show(
            f"\nNo profile of {', '.join(left_out)}: not searched in this fit; the parameters"
            f" searched are {', '.join(result.determinacy.names)}."
        )
    show_written(*outputs.values())


def _refuse_beside_paper(
    inputs: Inputs, starts: tuple[object, object], hysteresis: str | None, profile: list[str] | None
) -> None:
    """Note the options that the paper's method does not take."""
    if profile:
        inputs.add("--method paper has no likelihood; leave --profile or --method out.")
    if starts != (None, None):
        inputs.add("--method paper starts from no model; leave --model, --stack or --method out.")
    if hysteresis not in (None, "bouc-wen"):
        inputs.add("--method paper finds Bouc-Wen parameters; leave --hysteresis or --method out.")


def _save(model: "psa.Model", output: Path) -> None:
    """Write MODEL.json, or start values for what is run elsewhere."""
    if output.suffix.lower() not in (".fmu", ".ssv"):
        psa.save_model(model, output)
        return
    for sentence in psa.save_start_values(model, output):
        print_message(f"Note: {sentence}")


def _finish(
    identification: "psa.Identification",
    outputs: dict[str, Path | None],
    wanted: Sequence[str],
    page: tuple[str, bool],
    progress: Callable[[str], None],
) -> "list[Profile]":
    """Write the files and return the profiles; an interrupt keeps the model and names it.

    `page` is the origin of the records, and whether the page is still.
    """
    from psa_casadi.common.strict_json import json_text
    from psa_casadi.documents.files import identification_file
    from psa_casadi.identification.profile import profile

    files, ended = Outputs(outputs), identification.interrupted
    save = partial(files.write, "--output", partial(_save, identification.model))
    try:
        save()
        names = () if ended else identification.determinacy.names
        fit = identification.fit
        profiles = [profile(fit, n, progress=progress) for n in wanted if n in names]
        content = partial(identification_file, identification, profiles)
        files.write("--json", lambda path: atomic_write(path, json_text(content())))
        if outputs["--report"] is not None and not ended:
            progress("writing the report")
            options: dict[str, Any] = {"origin": page[0], "still": page[1], "profiles": profiles}
            write = partial(psa.write_fit_report, identification, **options)
            files.write("--report", write)
    except KeyboardInterrupt:
        save()
        ended = True
    if not ended:
        return profiles
    if identification.fit.interrupted:
        raise files.cut_off("the search was cut off", " (marked as interrupted)")
    raise files.cut_off("the fit was finished before")
