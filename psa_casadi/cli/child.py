"""The command `psa` as a child of another process, with which it ends."""

from psa_casadi.cli import main
from psa_casadi.common.children import end_with_parent

if __name__ == "__main__":
    end_with_parent()
    main()
