"""The command `psa`; each subcommand is a small file that calls one function of the package."""

import os
import signal
import sys
from typing import NoReturn

__all__ = ["main"]

#: Exit code of a command that Ctrl-C has ended.
INTERRUPTED = 130


def main() -> None:
    """Run the command line; one that was interrupted does not wait for Python's own tidying up."""
    try:
        from psa_casadi.cli.app import main as run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted: nothing was begun.\n")
        sys.stderr.flush()
        _leave()
    except SystemExit as ended:
        if ended.code == INTERRUPTED:
            sys.stdout.flush()
            sys.stderr.flush()
            _leave()
        raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done; Python tidies up


def _leave() -> NoReturn:
    """End at once, without temporary files and children."""
    from psa_casadi.scratch import abandon

    abandon()
    os._exit(INTERRUPTED)
