"""An executor whose processes need no guard around the main program and die one by one."""

import os
import pickle
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, Any, cast

from psa_casadi.common.children import Child, end_with_parent, kill, started_python
from psa_casadi.common.errors import MachineError
from psa_casadi.common.files import abandon, answer_requests_to_end

#: The linear algebra libraries have one thread in a process, this package too.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
_OURS = {**ONE_THREAD, "PSA_CASADI_THREADS": "1"}


class Processes:
    """An executor of `count` processes of this package, each with one thread.

    A call whose process is lost runs `again` once, in a new process.
    """

    def __init__(self, count: int, *, again: bool = False) -> None:
        self.count, self._again = count, again
        self._pool = ThreadPoolExecutor(count, thread_name_prefix="psa process")
        self._own, self._held, self._ended = threading.local(), ExitStack(), False

    def submit(self, function: Callable[[Any], Any], argument: Any, /) -> "Future[Any]":
        """Let the next free process call a function, which it can import, with an argument."""
        return self._pool.submit(self._called, function, argument)

    def end(self) -> None:
        """Kill the processes, and leave out what has not started."""
        self._ended = True
        self._held.close()
        self._pool.shutdown(cancel_futures=True)
        self._held.close()

    def _called(self, function: Callable[[Any], Any], argument: Any) -> Any:
        try:
            return self._called_once(function, argument)
        except MachineError:
            if self._ended or not self._again:
                raise
        return self._called_once(function, argument)

    def _called_once(self, function: Callable[[Any], Any], argument: Any) -> Any:
        child = cast("Child | None", getattr(self._own, "child", None))
        if child is None or child.poll() is not None:  # the process of this thread
            started = started_python("psa_casadi.common.processes", directory=None, **_OURS)
            self._own.child = child = self._held.enter_context(started)
            if self._ended:
                kill(child)
        try:
            pickle.dump((function, argument), cast("IO[bytes]", child.stdin))
            cast("IO[bytes]", child.stdin).flush()
            return pickle.load(cast("IO[bytes]", child.stdout))
        except (EOFError, OSError, pickle.UnpicklingError):
            del self._own.child
            code = child.wait()
            complaint = "" if child.stderr is None else child.stderr.read().decode(errors="replace")
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            raise MachineError(
                f"The process that worked on this ended ({how}): killed, out of memory, or"
                f" crashed. The next run tries it again. {complaint[-500:]}"
            ) from None


def memory_of_process(kind: str) -> int:
    """Return the memory of this process [bytes], of a kind of Linux such as VmData; else 0."""
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith(f"{kind}:"):
                return int(line.split()[1]) * 1024
    return 0


def main() -> None:
    """Call functions with arguments that come on standard input, pickled, until it ends."""
    end_with_parent()
    answer_requests_to_end()
    calls, results = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(silent, stream)  # what a library prints is no result
    try:
        while True:
            function, argument = pickle.load(calls)
            pickle.dump(function(argument), results)
            results.flush()
    except EOFError:
        abandon()


if __name__ == "__main__":
    main()
