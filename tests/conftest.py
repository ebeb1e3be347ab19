from pathlib import Path

import pytest

from build_scripts.measured_data import measured_data_directory, must_be_present


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """Directory of the measured records; without them the test is skipped, in CI it fails."""
    directory = measured_data_directory()
    if not directory.is_dir():
        reason = f"no measured records in {directory}: set PSA_CASADI_DATA to their directory"
        if must_be_present():
            pytest.fail(reason)
        pytest.skip(reason)
    return directory
