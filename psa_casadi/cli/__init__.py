"""The command `psa`; each subcommand is a small file that calls one function of the package."""

import signal
import sys

__all__ = ["main"]

#: Exit code of a command that Ctrl-C has ended.
INTERRUPTED = 130


def main() -> None:
    """Run the command line; one that was interrupted skips the interpreter's finalisation."""
    try:
        from psa_casadi.cli.app import main as run

        run()
    except KeyboardInterrupt:
        sys.stderr.write("Interrupted: nothing was started.\n")
    except SystemExit as ended:
        if ended.code != INTERRUPTED:
            raise
    else:
        return
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # all is done; Python tidies up
    from psa_casadi.cli.failures import leave

    sys.stdout.flush()
    sys.stderr.flush()
    leave()
