"""A `psa` command in surroundings of its own: what it says, how it ends, what it leaves."""

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from tests.fuzz.target import CRASH, FOREIGN, HANG, LEFT_OVER, WRONG_EXIT, Found

_LIBC, _PARENT_ENDED = ctypes.CDLL(None), 1  # of Linux's prctl
PSA = (sys.executable, "-m", "psa_casadi.cli")
#: Root of the checkout, where the package is found from any directory.
ROOT = Path(__file__).resolve().parents[2]
_COMPILERS_OWN = Path(os.environ.get("PSA_CASADI_CACHE", Path.home() / ".cache/psa_casadi")) / "zig"
_FAULTS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGILL, signal.SIGFPE)


@dataclass(frozen=True)
class Ended:
    """How a command ended; `hung` where it had to be killed, `left` its processes that go on."""

    code: int
    out: str
    err: str
    hung: bool
    left: tuple[int, ...]


@dataclass(frozen=True)
class Around:
    """Surroundings of a command: changes of the environment (None removes), and how it starts.

    `first` runs in the process before the command; `streams` replace standard input, output and
    error; `program` is what runs in place of `psa`.
    """

    environment: Mapping[str, str | None] = field(default_factory=dict)
    first: Callable[[], None] | None = None
    streams: Mapping[str, int] = field(default_factory=dict)
    directory: Path | None = None
    program: Sequence[str] = PSA


def psa(
    arguments: Sequence[str | Path],
    folder: Path,
    around: Around = Around(),
    *,
    limit_s: float = 60.0,
    stop: tuple[int, float] | None = None,
) -> Ended:
    """Run a command with `folder/tmp` for what is temporary; `stop` is a signal and when [s]."""
    (folder / "tmp").mkdir(exist_ok=True)
    streams = {"stdin": subprocess.DEVNULL, **around.streams}
    with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
        running = subprocess.Popen(
            [*around.program, *map(str, arguments)],
            env=_environment(folder, around),
            cwd=around.directory or folder,
            start_new_session=True,
            preexec_fn=partial(_begin, around.first),  # noqa: PLW1509 - this process has one thread
            **{"stdout": out, "stderr": err, **streams},  # type: ignore[call-overload]
        )
        hung = _wait(running, limit_s, stop)
    left = tuple(_group(running.pid))
    for _ in range(20):  # what ends with its parent needs a moment
        if not left:
            break
        time.sleep(0.05)
        left = tuple(_group(running.pid))
    with contextlib.suppress(ProcessLookupError):
        os.killpg(running.pid, signal.SIGKILL)
    said, told = (
        (folder / n).read_text(encoding="utf-8", errors="replace") for n in ("out", "err")
    )
    return Ended(running.returncode, said, told, hung, left)


def _begin(first: Callable[[], None] | None) -> None:
    """Let the command end with the process that started it (Linux), and do what is to be first."""
    if sys.platform.startswith("linux"):
        _LIBC.prctl(_PARENT_ENDED, signal.SIGKILL, 0, 0, 0)
    if first is not None:
        first()


def _environment(folder: Path, around: Around) -> dict[str, str]:
    found: dict[str, str | None] = {
        **os.environ,
        "TMPDIR": str(folder / "tmp"),
        "PYTHONPATH": str(ROOT),
        "OPENBLAS_NUM_THREADS": "1",
        # what the compiler keeps for itself is not made anew for each empty cache
        "ZIG_GLOBAL_CACHE_DIR": str(_COMPILERS_OWN),
        **around.environment,
    }
    return {name: value for name, value in found.items() if value is not None}


def _wait(
    running: "subprocess.Popen[bytes]", limit_s: float, stop: tuple[int, float] | None
) -> bool:
    """Wait for the end; return whether there was none within the limit."""
    if stop is not None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            running.wait(stop[1])
        if running.returncode is None:
            running.send_signal(stop[0])
    try:
        running.wait(limit_s)
    except subprocess.TimeoutExpired:
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        return True
    return False


def _group(session: int) -> Iterator[int]:
    """Yield the processes of a session that still run; nothing where they cannot be listed."""
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, ValueError, IndexError):
            words = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            if int(words[3]) == session and words[0] != "Z":
                yield int(entry.name)


def misbehaved(
    ended: Ended, codes: Sequence[int], what: str, *, mute: bool = False
) -> Iterator[Found]:
    """Yield what is wrong with an end: exit code, traceback, blame of the package, no reason.

    A `mute` one has nowhere to say a reason.
    """
    if ended.hung:
        yield Found(HANG, f"{what}: no end within the limit")
        return
    if "Traceback" in ended.err or "Traceback" in ended.out:
        yield Found(FOREIGN, f"{what}: a traceback: {_last(ended.err)}")
    elif "fault of psa_casadi" in ended.err:
        yield Found(FOREIGN, f"{what}: it blames itself: {_last(ended.err)}")
    elif ended.code not in codes and -ended.code in _FAULTS:
        yield Found(CRASH, f"{what}: {signal.Signals(-ended.code).name}: {_last(ended.err)}")
    elif ended.code not in codes:
        yield Found(WRONG_EXIT, f"{what}: exit code {ended.code}: {_last(ended.err)}")
    elif 0 < ended.code < 128 and not mute and not ended.err.strip() and not ended.out.strip():
        yield Found(WRONG_EXIT, f"{what}: exit code {ended.code} without a word")
    if ended.left:
        yield Found(LEFT_OVER, f"{what}: {len(ended.left)} processes go on")


def _last(text: str) -> str:
    lines = text.strip().splitlines()
    return " ".join(lines[-1].split())[:300] if lines else "nothing is said"


def left_files(folder: Path, what: str) -> Iterator[Found]:
    """Yield what stands in the temporary folder."""
    with contextlib.suppress(OSError):
        names = sorted(os.listdir(folder / "tmp"))
        if names:
            yield Found(LEFT_OVER, f"{what}: {len(names)} left in TMPDIR: {', '.join(names[:3])}")
