"""How a command ends when something is wrong: 2 for the user's input, 1 for everything else."""

import functools
import os
from collections.abc import Callable
from typing import ParamSpec

import typer

from psa_casadi.cli import INTERRUPTED
from psa_casadi.cli.interrupts import interrupts
from psa_casadi.cli.screen import tell
from psa_casadi.cli.surroundings import refused_by_the_machine, silence
from psa_casadi.errors import InputError, MachineError, PsaError
from psa_casadi.files import written

P = ParamSpec("P")

#: Set in the environment, this variable lets a failure end with its traceback.
DEBUG = "PSA_CASADI_DEBUG"
#: What is told of an interrupt before there was any result.
NOTHING_KEPT = "there was no result yet, so nothing was kept."


def guarded(command: Callable[P, None]) -> Callable[P, None]:
    """Return the command with its errors told in sentences, without a traceback.

    Exit code 2: what the user gave cannot be used; every mistake is listed. Exit code 1: a failure
    that is not the user's. 130: interrupted; what was kept is told.
    """

    @functools.wraps(command)
    def run(*args: P.args, **options: P.kwargs) -> None:
        before = len(written())
        try:
            with interrupts():
                command(*args, **options)
        except (typer.Exit, typer.Abort):
            raise
        except BrokenPipeError as error:
            silence()
            raise typer.Exit(1) from error
        except KeyboardInterrupt as stop:
            there = ", ".join(dict.fromkeys(str(p) for p in written()[before:]))
            told = str(stop) or (f"written before: {there}." if there else NOTHING_KEPT)
            tell(f"Interrupted: {told}")
            raise typer.Exit(INTERRUPTED) from None
        except InputError as error:
            if os.environ.get(DEBUG):
                raise
            _tell_problems(error.problems)
            raise typer.Exit(2) from error
        except Exception as error:
            if os.environ.get(DEBUG):
                raise
            _tell_failure(error)
            raise typer.Exit(1) from error

    return run


def _tell_problems(problems: tuple[str, ...]) -> None:
    if len(problems) == 1:
        tell(f"Error: {problems[0]}")
        return
    count = sum(not p.startswith("... and") for p in problems)
    tell(f"Error: {count} problems with what was given:")
    for problem in problems:
        tell(f"  - {problem}")


def _tell_failure(error: Exception) -> None:
    if isinstance(error, (PsaError, MachineError)):
        tell(f"Failed: {error}")
        return
    refused = refused_by_the_machine(error)
    if refused is not None:
        tell(f"Failed: {refused}")
        return
    tell(
        f"Failed: an unexpected {type(error).__name__} ({error}). This is a fault of psa_casadi,"
        f" not of the input; set {DEBUG}=1 to see where it happened, and report it."
    )
