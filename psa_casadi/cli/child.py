"""The command `psa` as a child of another process, with which it ends."""

from psa_casadi.children import end_with_parent
from psa_casadi.cli import main

if __name__ == "__main__":
    end_with_parent()
    main()
