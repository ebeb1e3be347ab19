"""What CI asks of a command: that a result is as expected, and a file of it as tests."""

import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

import psa_casadi as psa
from psa_casadi.cli.inputs import Given, meant
from psa_casadi.cli.screen import tell
from psa_casadi.files import atomic_write

if TYPE_CHECKING:
    from psa_casadi.report.documents.junit import Case


def expected(
    given: Given, verdicts: str | None, max_error: str | None
) -> tuple[tuple[str, ...], float | None]:
    """Return the verdicts of which one must come out, and the largest held-out error [%]."""
    from psa_casadi.report.words.verdict_words import VERDICTS

    words = [re.sub(r"[\s-]+", "_", w.strip().lower()) for w in (verdicts or "").split(",")]
    wanted, there = tuple(dict.fromkeys(w for w in words if w)), f"there are {', '.join(VERDICTS)}."
    if verdicts is not None and not wanted:
        given.add(f"--expect names no verdict; {there}")
    for word in wanted:
        if word not in VERDICTS:
            given.add(f"--expect: '{word}' is no verdict; {meant(word, VERDICTS)}{there}")
    found = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*%\s*", max_error or "")
    largest = float(found[1]) if found else 0.0
    if max_error is not None and not largest > 0.0:
        given.add(
            f"--max-error is '{max_error}'; give a positive percentage of the range, as 0.5%."
        )
    return wanted, None if max_error is None else largest


def cases(d: "psa.Diagnosis", verdicts: tuple[str, ...], max_error: float | None) -> "list[Case]":
    """Return verdict and held-out error of the extended model as tests, failed or passed."""
    from psa_casadi.report.documents.junit import Case
    from psa_casadi.report.words.phrases import listing, number
    from psa_casadi.report.words.verdict_words import verdict_sentence

    wrong = large = ""
    if verdicts and d.verdict not in verdicts:
        wrong = f"The verdict is {d.verdict}; expected {listing(verdicts, 'or')}."
    error = d.extended_errors.holdout_nrmse_percent
    shown = f"{number(error)} % of the range"
    if max_error is not None and not error <= max_error:
        large = f"The extended model's held-out error is {shown}; expected {max_error:g} % at most."
    return [
        Case("verdict", f"{d.verdict}: {verdict_sentence(d)}", wrong),
        Case("held-out error", f"{shown} by the extended model", large),
    ]


def judge(
    command: str,
    subject: str,
    cases: "Sequence[Case]",
    junit: Path | None,
    began: float,
    *,
    tells: bool = False,
) -> None:
    """Write what was found of a subject as tests, if a file is named; end with 1 if one failed.

    `began` is when the command did, of `time.perf_counter`; with `tells` each failure is told.
    """
    from psa_casadi.report.documents.junit import junit_text

    if junit is not None:
        atomic_write(junit, junit_text(command, subject, cases, time.perf_counter() - began))
    failures = [case.failure for case in cases if case.failure]
    for failure in failures if tells else ():
        tell(f"Not as expected: {failure}")
    if failures:
        raise typer.Exit(1)
