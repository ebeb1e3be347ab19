"""A process that works on one device after another: tasks come on standard input, pickled.

It ends when the process that started it does, and when its input is closed.
"""

import os
import pickle
import queue
import struct
import sys
import threading
from typing import BinaryIO

from psa_casadi.children import end_with_parent
from psa_casadi.devices.device import work_on
from psa_casadi.files import abandon, answer_requests_to_end

LENGTH = struct.Struct("<Q")


def send(stream: BinaryIO, content: object) -> None:
    """Write an object with its length before it."""
    data = pickle.dumps(content)
    stream.write(LENGTH.pack(len(data)) + data)
    stream.flush()


def receive(stream: BinaryIO) -> object:
    """Return the next object of a stream, which a process of our own wrote. Raises EOFError."""
    (length,) = LENGTH.unpack(_exactly(stream, LENGTH.size))
    return pickle.loads(_exactly(stream, length))


def _exactly(stream: BinaryIO, count: int) -> bytes:
    parts = []
    while count:
        part = stream.read(count)
        if not part:
            raise EOFError
        parts.append(part)
        count -= len(part)
    return b"".join(parts)


def _listen(tasks: "queue.SimpleQueue[object]") -> None:
    """Hand on what is to be done; end the process, working or not, with its input."""
    try:
        while True:
            tasks.put(receive(sys.stdin.buffer))
    except EOFError:
        abandon()
        os._exit(0)


def main() -> None:
    """Work until the input ends."""
    end_with_parent()
    answer_requests_to_end()
    results = os.fdopen(os.dup(1), "wb")
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)  # what a library prints is no result
    send(results, "ready")
    os.dup2(silent, 2)
    tasks: queue.SimpleQueue[object] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(tasks,), daemon=True).start()
    while True:
        send(results, work_on(tasks.get()))  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
