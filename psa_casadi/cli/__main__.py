"""`python -m psa_casadi.cli` is the command `psa`."""

from psa_casadi.cli import main

main()
