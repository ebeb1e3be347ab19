"""What CI asks of a command: that a result is as expected, and a file of it as tests."""

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from psa_casadi.cli.screen import tell

if TYPE_CHECKING:
    from psa_casadi.cli.inputs import Given
    from psa_casadi.diagnosis.result import Diagnosis
    from psa_casadi.report.documents.junit import Case

JunitOption = Annotated[
    Path | None, typer.Option(help="JUnit XML to write, which CI servers show as tests.")
]


@dataclass(frozen=True)
class Expected:
    """Verdicts of which one must come out, and the largest held-out error [% of the range]."""

    verdicts: tuple[str, ...] = ()
    max_error: float | None = None

    def cases(self, d: "Diagnosis") -> "list[Case]":
        """Return verdict and held-out error of the extended model as tests, failed or passed."""
        from psa_casadi.report.documents.junit import Case
        from psa_casadi.report.words.phrases import listing, number
        from psa_casadi.report.words.verdict_words import verdict_sentence

        wrong = self.verdicts and d.verdict not in self.verdicts
        wanted = listing(self.verdicts, "or")
        error = d.extended_errors.holdout_nrmse_percent
        shown = f"{number(error)} % of the range"
        large = self.max_error is not None and not error <= self.max_error
        return [
            Case(
                "verdict",
                f"{d.verdict}: {verdict_sentence(d)}",
                f"The verdict is {d.verdict}; expected {wanted}." if wrong else "",
            ),
            Case(
                "held-out error",
                f"{shown} by the extended model",
                f"The extended model's held-out error is {shown}; expected {self.max_error:g} % at"
                " most."
                if large
                else "",
            ),
        ]


def expected(given: "Given", verdicts: str | None, max_error: str | None) -> Expected:
    """Return what the options demand; all mistakes are noted."""
    from psa_casadi.cli.inputs import meant
    from psa_casadi.report.words.verdict_words import VERDICTS

    words = [re.sub(r"[\s-]+", "_", w.strip().lower()) for w in (verdicts or "").split(",")]
    wanted = tuple(dict.fromkeys(w for w in words if w))
    if verdicts is not None and not wanted:
        given.add(f"--expect names no verdict; there are {', '.join(VERDICTS)}.")
    for word in wanted:
        if word not in VERDICTS:
            given.add(
                f"--expect: '{word}' is no verdict; {meant(word, VERDICTS)}there are"
                f" {', '.join(VERDICTS)}."
            )
    return Expected(wanted, None if max_error is None else _percent(given, max_error))


def _percent(given: "Given", text: str) -> float | None:
    found = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*%\s*", text)
    if found is None or not float(found[1]) > 0.0:
        given.add(f"--max-error is '{text}'; give a positive percentage of the range, as 0.5%.")
        return None
    return float(found[1])


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
    from psa_casadi.files import atomic_write
    from psa_casadi.report.documents.junit import junit_text

    if junit is not None:
        atomic_write(junit, junit_text(command, subject, cases, time.perf_counter() - began))
    failures = [case.failure for case in cases if case.failure]
    for failure in failures if tells else ():
        tell(f"Not as expected: {failure}")
    if failures:
        raise typer.Exit(1)
