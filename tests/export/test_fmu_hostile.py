"""FMUs whose code exits, crashes, hangs, fills memory or writes where it should not: told apart."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from psa_casadi.cli.app import app
from psa_casadi.export.check.check import CheckRow, check_fmu
from tests.export.hostile_fmus import DEED, PLACE, hostile_fmu
from tests.tiers import slow, slow_but

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the code is for POSIX")

#: The check during which each moment comes.
DURING = {
    "load": "binary loads", "make": "co-simulation instantiates", "step": "life cycle",
    "leave": "process ends",
}  # fmt: skip
DEEDS = {
    "exit": "exit code 0 before",
    "_exit": "exit code 0 before",
    "exit3": "exit code 3 before the checks were done; the last it printed: licence not found",
    "abort": "the signal SIGABRT",
    "fault": "the signal SIGSEGV",
    "child": "exit code 0 before",
    "write": "disturbed the channel of the results: something else",
    "forge": "disturbed the channel of the results: something else",
    "close": "disturbed the channel of the results: it was closed",
}
MOMENTS = ("load", "make", "step")
#: Every deed at two moments, and in both versions, in turn; ends of all kinds at every moment.
CASES = [
    (2 + k % 2, MOMENTS[(k + late) % 3], deed) for k, deed in enumerate(DEEDS) for late in (0, 2)
]
QUICK = [(2, "load", "exit"), (2, "make", "exit"), (3, "step", "exit"), (2, "step", "fault"),
         (3, "step", "write"), (2, "step", "close")]  # fmt: skip


@pytest.fixture(autouse=True)
def _own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))


def _ended(
    tmp_path: Path, fmi: int, deed: str, monkeypatch: pytest.MonkeyPatch, **limits: Any
) -> tuple[CheckRow, list[str]]:
    """Return the last row, and the names of the rows before it; nothing may be left over."""
    monkeypatch.setenv(DEED, deed)
    path = hostile_fmu(tmp_path / "h.fmu", fmi)
    report = check_fmu(path, **{"timeout": 60.0, **limits})
    assert list((tmp_path / "temporary").iterdir()) == []
    assert not report.passed
    return report.rows[-1], [row.name for row in report.rows[:-1]]


@pytest.mark.parametrize(
    ("fmi", "moment", "deed"), slow_but(QUICK, dict.fromkeys((*QUICK, *CASES)))
)
def test_every_way_to_end_is_told_apart(
    fmi: int, moment: str, deed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, before = _ended(tmp_path, fmi, f"{moment}:{deed}", monkeypatch)
    assert (row.name, row.passed) == (DURING[moment], False)
    assert DEEDS[deed] in row.remark
    assert "units defined" in before, "rows that were finished before are kept"
    assert ("co-simulation instantiates" in before) == (moment == "step")


def test_the_command_fails_and_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ended with exit code 0, and without a word."""
    monkeypatch.setenv(DEED, "load:exit")
    path = hostile_fmu(tmp_path / "h.fmu", 2)
    done = CliRunner().invoke(app, ["check", str(path), "--timeout", "30", "--memory", "512"])
    assert done.exit_code == 1
    assert "binary loads" in done.stdout.splitlines()[-1]
    head, *lines = done.stdout.splitlines()
    remarks = " ".join(" ".join(line[head.index("remark") :] for line in lines).split())
    assert "the FMU ended its process with exit code 0 before the checks were done" in remarks
    assert "RUNS THE CODE" in CliRunner().invoke(app, ["check", "--help"]).stdout


@slow
@pytest.mark.parametrize("deed", ["abort", "exit3", "write"])
def test_a_bad_end_after_all_checks(
    deed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, before = _ended(tmp_path, 2, f"leave:{deed}", monkeypatch)
    assert row.name == "process ends"
    assert "directional derivatives" in before
    assert "before the checks were done" not in row.remark


@pytest.mark.parametrize("moment", slow_but(["step"], ["load", "make", "step", "leave"]))
def test_a_hang_ends_at_the_time_limit(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PLACE, str(tmp_path / "place"))
    row, _ = _ended(tmp_path, 2, f"{moment}:hang", monkeypatch, timeout=4.0)
    assert row.name == DURING[moment]
    assert (
        "did not come back within the time limit of 4 s of the whole check (--timeout sets it)"
        in row.remark
    )
    assert _gone(tmp_path / "place")


@slow
def test_a_process_of_the_fmu_is_ended_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PLACE, str(tmp_path / "place"))
    _ended(tmp_path, 2, "step:child", monkeypatch)
    assert _gone(tmp_path / "place")


def _gone(place: Path) -> bool:
    """Say whether the process that noted its number ends within a second."""
    number = int(place.read_text())
    for _ in range(50):
        try:
            os.kill(number, 0)
            state = Path(f"/proc/{number}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (ProcessLookupError, FileNotFoundError):
            return True
        if state == "Z":  # dead, and not yet fetched by whoever inherited it
            return True
        time.sleep(0.02)
    return False


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits memory")
@pytest.mark.parametrize("fmi", slow_but([2], [2, 3]))
def test_memory_ends_at_its_limit(
    fmi: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, _ = _ended(tmp_path, fmi, "step:memory", monkeypatch, memory=200 << 20)
    assert row.name == "life cycle"
    assert "reached the memory limit of 200 MiB (--memory sets it)" in row.remark


def test_what_is_printed_is_no_result_and_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path = hostile_fmu(tmp_path / "h.fmu", 2)
    quiet = [(row.name, row.passed) for row in check_fmu(path).rows]
    monkeypatch.setenv(DEED, "load:print")
    assert [(row.name, row.passed) for row in check_fmu(path).rows] == quiet
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("request_", slow_but([signal.SIGTERM], [signal.SIGTERM, signal.SIGINT]))
def test_a_request_to_end_leaves_nothing_behind(request_: signal.Signals, tmp_path: Path) -> None:
    path, place, folder = (tmp_path / name for name in ("h.fmu", "place", "temporary"))
    hostile_fmu(path, 2)
    with subprocess.Popen(
        [sys.executable, "-m", "psa_casadi.cli", "check", str(path)],
        env={**os.environ, DEED: "step:hang", PLACE: str(place), "TMPDIR": str(folder)},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    ) as process:  # fmt: skip
        while process.poll() is None and not (place.exists() and place.read_text()):
            time.sleep(0.02)
        assert any(folder.iterdir())
        process.send_signal(request_)
        assert process.wait(30) not in (0, 1, 2)
    assert list(folder.iterdir()) == []
    assert _gone(place)
