"""What is expensive and shared: the demonstration's files, and its record's diagnosis in Python."""

from dataclasses import dataclass
from pathlib import Path

import pytest

import psa_casadi as psa
from tests.contract.helpers import DATA, Ended, done


@dataclass(frozen=True)
class Demo:
    """What `psa demo` left in a folder, and how it ended."""

    folder: Path
    ended: Ended


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    folder = tmp_path_factory.mktemp("demo") / "new" / "psa_demo"
    return Demo(folder, done("demo", folder))


@pytest.fixture(scope="session")
def result() -> psa.StackDiagnosis:
    return psa.diagnose(DATA / "demo.csv")
