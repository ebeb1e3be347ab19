"""Where the measured records lie that some tests and commands of the pages need."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def measured_data_directory() -> Path:
    """Return the directory of the measured records, which may not exist.

    It is $PSA_CASADI_DATA, else `shared/data` next to the checkout.
    """
    return Path(os.environ.get("PSA_CASADI_DATA") or ROOT.parent / "shared" / "data")


def must_be_present() -> bool:
    """Say whether missing records are a failure: they are in CI, elsewhere they are skipped."""
    return bool(os.environ.get("CI"))
