"""A command that is ended leaves nothing behind: no folder, no half file, no compiler."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from psa_casadi.scratch import PREFIX
from tests.record_files import HEADER, write

posix = pytest.mark.skipif(sys.platform == "win32", reason="shells and signals of POSIX")
PSA = [sys.executable, "-m", "psa_casadi.cli"]

#: A compiler that has a child of its own and never ends.
NEVER_ENDS = ["#!/bin/sh", "sleep 100 &", 'echo $! > "$COMPILING"', "wait"]


@contextmanager
def compiling(folder: Path) -> Iterator["tuple[subprocess.Popen[str], int]"]:
    """Yield a command that waits for its compiler, and the process of the compiler's child."""
    t = np.linspace(0.0, 1.0, 200)
    rows = [f"{a:.4f},{50 * np.sin(6 * a):.6f},{np.sin(6 * a - 0.1):.6f}" for a in t]
    record = write(folder / "record.csv", HEADER, *rows)
    slow = write(folder / "never_ends", *NEVER_ENDS)
    slow.chmod(0o700)
    told = folder / "pid"
    (folder / "tmp").mkdir()
    changes = {"CC": str(slow), "COMPILING": str(told), "TMPDIR": str(folder / "tmp"),
               "PSA_CASADI_CACHE": str(folder / "cache")}  # fmt: skip
    command = subprocess.Popen(
        [*PSA, "identify", str(record), "-o", str(folder / "m.json"), "-q"],
        env={**os.environ, **changes}, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        for _ in range(3000):
            if told.exists() and told.read_text().endswith("\n"):
                break
            time.sleep(0.01)
        yield command, int(told.read_text())
    finally:
        command.kill()
        command.communicate()


def runs(pid: int) -> bool:
    state = Path(f"/proc/{pid}/stat")
    try:
        os.kill(pid, 0)
        return not (state.exists() and state.read_text().rsplit(")", 1)[1].split()[0] == "Z")
    except (ProcessLookupError, FileNotFoundError):
        return False


def left_over(folder: Path) -> list[Path]:
    return [*folder.rglob(f"{PREFIX}*"), *(folder / "tmp").iterdir(), *folder.glob("m.json")]


@posix
@pytest.mark.parametrize("name", ["SIGTERM", pytest.param("SIGHUP", marks=pytest.mark.slow)])
def test_a_command_that_is_told_to_end_leaves_nothing(name: str, tmp_path: Path) -> None:
    number = getattr(signal, name)
    # nohup leaves SIGHUP ignored, and a command started so keeps running: not what is tested here.
    inherited = signal.signal(number, signal.SIG_DFL)
    with compiling(tmp_path) as (command, child):
        signal.signal(number, inherited)
        assert left_over(tmp_path)
        command.send_signal(number)
        assert command.wait(10) == 128 + number
        assert not left_over(tmp_path)
        for _ in range(100):
            if not runs(child):
                break
            time.sleep(0.01)
        assert not runs(child)
