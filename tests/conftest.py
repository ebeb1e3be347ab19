import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path

# before NumPy is loaded: several threads in each of the test processes get in each other's way
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
    os.environ.setdefault("PSA_CASADI_THREADS", "1")
# a model runs for a few hundredths of a second here, and compiles in half the time with this; the
# bits are the same (`test_exact`). zig's -Og means other checks in the code.
if shutil.which("cc") and "CC" not in os.environ:
    os.environ.setdefault("PSA_CASADI_CFLAGS", "-Og")
# hundreds of Python processes are started, and each would compile the package again
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

import pytest

from build_scripts.measured_data import measured_data_directory, must_be_present
from tests.check_here import rows_here

#: Groups of tests that share something long, the longest first.
LONG_GROUPS = ("platforms", "identification", "demo", "search", "browser")


def pytest_configure(config: pytest.Config) -> None:
    """Let a test file that is named run whole: the quick tier is of all files together."""
    sys.dont_write_bytecode = False
    if hasattr(config, "workerinput"):  # a process of pytest-xdist does as the first one
        return
    chosen = any(str(word).startswith("-m") for word in config.invocation_params.args)
    if not chosen and all(".py" in arg for arg in config.args):
        config.option.markexpr = ""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with what takes long, so that at the end no process waits for another.

    With pytest-xdist the quick tests of a file run in one process: what they share is made once.
    """
    items.sort(key=_turn)
    for item in items:
        alone = item.get_closest_marker("slow") or item.get_closest_marker("xdist_group")
        if alone is None:
            item.add_marker(pytest.mark.xdist_group(item.path.stem))


def _turn(item: pytest.Item) -> int:
    """Return when a test's turn comes: long groups, other groups, slow tests, quick ones."""
    group = item.get_closest_marker("xdist_group")
    if group is None:
        slow = item.get_closest_marker("slow") is not None
        return len(LONG_GROUPS) + (1 if slow else 2)
    return _place(LONG_GROUPS, group.args[0])


def _place(names: Sequence[str], name: str) -> int:
    return names.index(name) if name in names else len(names)


@pytest.fixture
def code_runs_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """`check_fmu` runs the code of FMUs, which must do no harm, in this process."""
    monkeypatch.setattr("psa_casadi.export.check.check.rows_apart", rows_here)


@pytest.fixture
def without_binary(monkeypatch: pytest.MonkeyPatch) -> None:
    """FMUs are written without their binary, for tests that read its other files."""
    monkeypatch.setattr("psa_casadi.export.fmu.archive.compile_library", lambda *_: b"no binary")


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
