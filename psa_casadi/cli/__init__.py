"""The command `psa`; each subcommand is a small file that calls one function of the package."""

from psa_casadi.cli.app import main

__all__ = ["main"]
