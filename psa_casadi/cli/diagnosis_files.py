"""The files of `psa diagnose`, what an interrupt leaves of them, and what CI asks of a result."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import psa_casadi as psa
from psa_casadi.cli.failures import Case, Outputs
from psa_casadi.cli.inputs import Inputs, meant
from psa_casadi.common.errors import PsaError
from psa_casadi.common.files import atomic_write
from psa_casadi.design.experiment import experiment
from psa_casadi.diagnosis import result
from psa_casadi.diagnosis.search.state import one_of_each
from psa_casadi.identification.start.doubts import doubtful_unit
from psa_casadi.records import write_record
from psa_casadi.report.words.design_words import sentences
from psa_casadi.report.words.phrases import added, listing, number
from psa_casadi.report.words.verdict_words import (
    VERDICTS,
    of_range,
    since_reference,
    verdict_sentence,
)


def alternatives(d: result.Diagnosis, output: Path | None) -> list[tuple[result.Alternative, Path]]:
    """Return the models with another cause, each with its file next to the extended model's."""
    if output is None or not isinstance(d, result.StackDiagnosis):
        return []
    return [
        (a, output.with_name(f"{output.stem}_{a.instead}_for_{a.cause}.json"))
        for a in d.alternatives
    ]


def noted(d: result.Diagnosis, left_out: Sequence[str]) -> result.Diagnosis:
    """Say in the remarks which effects were not looked for."""
    if not left_out:
        return d
    names = ", ".join(dict.fromkeys(left_out))
    return replace(d, remarks=(*d.remarks, f"Not looked for, because of --leave-out: {names}."))


def models(d: result.Diagnosis, output: Path | None) -> list[str]:
    """Say what the model's file holds if nothing was added, and which files are next to it."""
    others = alternatives(d, output)
    lines = [f"written: {path}, with {a.instead} instead of {a.cause}" for a, path in others]
    if output is not None and not added(d):
        lines.append(f"nothing was added: {output} holds the base model")
    return lines


def unfinished(stop: result.DiagnosisInterrupted, files: Outputs) -> KeyboardInterrupt:
    """Write the best model so far; return the interrupt that reports it."""
    files.write("--output", lambda path: psa.save_model(stop.model, path))
    return files.cut_off(f"there is no verdict; {stop}", " (marked as interrupted)")


def finished(d: result.Diagnosis, files: Outputs) -> KeyboardInterrupt:
    """Write what takes no time of a finished diagnosis; return the interrupt that reports it."""
    write_models(d, files)
    return files.cut_off("the diagnosis was finished before")


def write_models(d: result.Diagnosis, files: Outputs) -> None:
    """Write the models, those with another cause too, and the verdict for machines."""
    files.write("--output", lambda path: psa.save_model(d.model, path))
    files.write("--json", lambda path: atomic_write(path, d.to_json()))
    for a, path in alternatives(d, files.named["--output"]):
        if path not in files.done:
            psa.save_model(a.model, path)
            files.done.append(path)


def write(d: result.Diagnosis, files: Outputs, origin: str, *, still: bool) -> None:
    """Write the wanted files, each whole or not at all."""
    write_models(d, files)
    extended = str(files.named["--output"]) if files.named["--output"] else None
    report = partial(psa.write_report, d, origin=origin, still=still, model_file=extended)
    files.write("--report", report)
    files.write("--figure", lambda path: psa.save_figure(d, path, origin=origin))


def with_next(
    d: result.Diagnosis, path: Path | None, progress: Callable[[str], None]
) -> result.Diagnosis:
    """Design and write the record that resolves an ambiguous verdict, and say so in the result."""
    if path is None or not isinstance(d, result.StackDiagnosis) or d.verdict != "ambiguous":
        return d
    contenders, same = one_of_each(d.contenders)
    if same and len(contenders) < 2:
        return d
    before = d.next_experiment
    try:
        design = experiment.resolving_experiment(d, progress=progress)
    except PsaError as error:
        reasons = (*before.reasons, f"No record could be designed: {error}")
        return replace(d, next_experiment=replace(before, reasons=reasons))
    each = sentences(design)
    if design.plays is None:  # it would not decide; the last sentence is what an amplifier needs
        reasons = (*before.reasons, *each[:-1], *same)
        return replace(d, next_experiment=replace(before, reasons=reasons))
    write_record(path, experiment.columns_to_play(design))
    reasons = (f"Apply {path} and diagnose all records together.", *each, *same)
    following = result.NextExperiment(str(path), tuple(design.chance), reasons, dict(design.chance))
    return replace(d, next_experiment=following)


def write_patch(d: result.Diagnosis, path: Path | None, progress: Callable[[str], None]) -> str:
    """Write the model with the unnamed correction; say why where there is none to write."""
    if path is None:
        return ""
    progress("fitting the unnamed correction")
    try:
        psa.save_model(psa.patched_model(d), path)
    except PsaError as error:
        return f"{path} was not written: {error}"
    return ""


def expected(
    inputs: Inputs, verdicts: str | None, max_error: str | None
) -> tuple[tuple[str, ...], float | None]:
    """Return the verdicts of which one must come out, and the largest held-out error [%]."""
    words = [re.sub(r"[\s-]+", "_", w.strip().lower()) for w in (verdicts or "").split(",")]
    wanted, there = tuple(dict.fromkeys(w for w in words if w)), f"there are {', '.join(VERDICTS)}."
    if verdicts is not None and not wanted:
        inputs.add(f"--expect names no verdict; {there}")
    for word in wanted:
        if word not in VERDICTS:
            inputs.add(f"--expect: '{word}' is no verdict; {meant(word, VERDICTS)}{there}")
    percentage = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*%\s*", max_error or "")
    largest = float(percentage[1]) if percentage else 0.0
    if max_error is not None and not largest > 0.0:
        inputs.add(
            f"--max-error is '{max_error}'; give a positive percentage of the range, as 0.5%."
        )
    return wanted, None if max_error is None else largest


def _reservation(d: result.Diagnosis) -> str:
    """Say why an adequate model passes no test: it is unconfirmed, has changed, or its unit is."""
    if d.doubt:
        return f"not confirmed: {d.doubt}."
    if moved := since_reference(d)["moved"]:
        return f"{moved} has changed since the reference."
    stack = isinstance(d, result.StackDiagnosis)
    unit = doubtful_unit([e.record for e in d.experiments]) if stack else ""
    return f"a unit is in doubt. {unit}" if unit else ""


def cases(d: result.Diagnosis, wanted: tuple[str, ...], max_error: float | None) -> list[Case]:
    """Return verdict and largest held-out error of the extended model as tests, failed or not."""
    wrong = f"The verdict is {d.verdict}; expected {listing(wanted, 'or')}."
    reserved = _reservation(d) if d.verdict == "adequate" else ""
    if reserved:
        wrong = f"The verdict is adequate, but {reserved}"
    failed = bool(wanted) and (d.verdict not in wanted or bool(reserved))
    verdict = Case("verdict", f"{d.verdict}: {verdict_sentence(d)}", wrong if failed else "")
    large, shares = "", of_range(d, extended=True)
    worst = max(shares, key=lambda output: shares[output])
    output = f" of {worst}" if len(shares) > 1 else ""
    text = f"{number(shares[worst])} % of the range{output}"
    if max_error is not None and not shares[worst] <= max_error:
        large = f"The extended model's held-out error is {text}; expected {max_error:g} % at most."
    return [verdict, Case("held-out error", f"{text} by the extended model", large)]
