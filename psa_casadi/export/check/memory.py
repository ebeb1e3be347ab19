"""The memory of a process as Linux counts and limits it: private data, touched or not."""

import os
import sys
from contextlib import suppress
from pathlib import Path


def data_size(pid: int) -> int:
    """Return the memory of a process that counts [bytes], 0 where the system does not tell."""
    with suppress(OSError, ValueError):
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmData:"):
                return int(line.split()[1]) * 1024
    return 0


def limit_data(more: int) -> None:
    """Let this process take so much more memory [bytes], and leave no core file.

    Does nothing on a system that has no such limits.
    """
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415 - there is none on Windows

    allowed = data_size(os.getpid()) + more
    for kind, wanted in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_DATA, allowed)):
        most = resource.getrlimit(kind)[1]
        size = wanted if most == resource.RLIM_INFINITY else min(wanted, most)
        with suppress(OSError, ValueError):
            resource.setrlimit(kind, (size, size))


def nearly_full(pid: int, share: float) -> bool:
    """Say whether a process uses more than a share of the memory that it may take."""
    if sys.platform != "linux":
        return False
    import resource  # noqa: PLC0415 - there is none on Windows

    used = data_size(pid)
    with suppress(OSError):
        allowed = resource.prlimit(pid, resource.RLIMIT_DATA)[0]
        return allowed != resource.RLIM_INFINITY and used > share * allowed
    return False
