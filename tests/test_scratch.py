"""What a process makes for itself goes with it, however it ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from psa_casadi import scratch
from psa_casadi.files import atomic_write
from psa_casadi.scratch import abandon, run_child, sweep, temporary_file, temporary_folder

posix = pytest.mark.skipif(sys.platform == "win32", reason="signals and locks of POSIX")

#: Makes a folder and a half-written file in a place, tells so, and waits to be killed.
HOLDS = """
import pathlib, sys, time
from psa_casadi.scratch import temporary_file, temporary_folder
place = pathlib.Path(sys.argv[1])
with temporary_folder(place) as folder, temporary_file(place, "model.json") as file:
    (folder / "inner").mkdir()
    (folder / "inner" / "a.o").write_text("half")
    file.write_text("half")
    print("ready", flush=True)
    time.sleep(60)
"""


def holder(place: Path) -> "subprocess.Popen[str]":
    child = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(place)], stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    assert child.stdout.readline() == "ready\n"
    return child


def swept_again(place: Path) -> list[str]:
    scratch._SWEPT.discard(place)
    sweep(place)
    return sorted(os.listdir(place))


@posix
def test_what_a_killed_process_left_goes_and_what_a_live_one_holds_stays(tmp_path: Path) -> None:
    dead, alive = holder(tmp_path), holder(tmp_path)
    (tmp_path / "model.json").write_text("old")
    dead.kill()
    dead.communicate()
    assert len(os.listdir(tmp_path)) == 5
    kept = swept_again(tmp_path)
    assert len(kept) == 3
    assert swept_again(tmp_path) == kept
    alive.kill()
    alive.communicate()
    scratch._SWEPT.discard(tmp_path)
    atomic_write(tmp_path / "other.json", "new")
    assert sorted(os.listdir(tmp_path)) == ["model.json", "other.json"]
    assert (tmp_path / "model.json").read_text() == "old"


@posix
def test_a_process_never_sweeps_its_own(tmp_path: Path) -> None:
    with temporary_folder(tmp_path) as folder, temporary_file(tmp_path, "x.fmu") as file:
        assert folder.stat().st_mode & 0o777 == 0o700
        assert file.suffix == ".fmu"
        assert swept_again(tmp_path) == sorted([folder.name, file.name])
    assert not os.listdir(tmp_path)


def test_a_link_that_looks_like_a_leftover_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "precious").mkdir()
    (tmp_path / f"{scratch.PREFIX}12345678").symlink_to(tmp_path / "precious")
    assert len(swept_again(tmp_path)) == 2


def test_without_locks_only_what_is_old_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scratch, "_lock", lambda path: None)
    old, new = (tmp_path / f"{scratch.PREFIX}{name}" for name in ("old", "new"))
    old.mkdir()
    new.mkdir()
    week = time.time() - 8 * 86400
    os.utime(old, (week, week))
    assert swept_again(tmp_path) == [new.name]


@posix
def test_a_folder_that_a_sweeper_took_before_it_was_locked_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock = scratch._lock
    taken: list[Path] = []

    def slow(path: Path) -> int | None:
        if not taken:
            taken.append(path)
            path.rmdir()
        return lock(path)

    monkeypatch.setattr(scratch, "_lock", slow)
    with temporary_folder(tmp_path) as folder:
        assert folder.is_dir()
        assert folder != taken[0]


@posix
def test_a_child_that_is_not_waited_for_dies_with_its_children(tmp_path: Path) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupted)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.2)
        with pytest.raises(KeyboardInterrupt):
            run_child(
                ["sh", "-c", "sleep 60 & echo $! > pid; wait"],
                directory=tmp_path,
                environment=os.environ,
            )
    finally:
        signal.signal(signal.SIGALRM, before)
    assert ended(int((tmp_path / "pid").read_text()))


def ended(pid: int) -> bool:
    """Whether a process ends within two seconds."""
    for _ in range(200):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        state = Path(f"/proc/{pid}/stat")
        if state.exists() and state.read_text().rsplit(")", 1)[1].split()[0] == "Z":
            return True
        time.sleep(0.01)
    return False


def test_to_abandon_removes_everything_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scratch, "_MADE", set())
    with temporary_folder(tmp_path) as folder, temporary_file(tmp_path, "a.csv") as file:
        (folder / "deep" / "deeper").mkdir(parents=True)
        file.write_text("half")
        abandon()
        assert not os.listdir(tmp_path)
    assert not scratch._MADE


@posix
def test_any_command_sweeps_what_a_killed_one_left_in_the_cache(tmp_path: Path) -> None:
    room = tmp_path / "cache" / "models"
    room.mkdir(parents=True)
    dead = holder(room)
    dead.kill()
    dead.communicate()
    assert os.listdir(room)
    subprocess.run(
        [sys.executable, "-m", "psa_casadi.cli", "--version"],
        env={**os.environ, "PSA_CASADI_CACHE": str(tmp_path / "cache")},
        check=True,
        stdout=subprocess.DEVNULL,
    )
    assert os.listdir(room) == []
