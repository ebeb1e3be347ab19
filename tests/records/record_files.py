"""Records in files, what is read of them, and the messages on those that are not read."""

import os
import re
import shlex
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from psa_casadi.common.errors import InputError
from psa_casadi.records import Record, read_record
from psa_casadi.records.read import apart
from psa_casadi.records.read.samples import Outcome

HEADER = "time [s],voltage [V],displacement [um]"
ROWS = [f"{k / 1000},{k % 7},{k % 7 / 10}" for k in range(20)]
#: A time [s], a voltage [V] and a displacement [um] of 20 samples that have few digits.
T, V, X = np.arange(20) * 1e-3, np.arange(20) % 7 + 0.5, np.arange(20) % 7 / 10 + 0.25
_OFFERED = re.compile(r"((?:--columns|--sample-time) .*?) \(with your|(--columns table=\S+?)[.,]? ")


def write(path: Path, *lines: str, end: str = "\n", encoding: str = "utf-8") -> Path:
    """Write lines of text."""
    path.write_bytes((end.join(lines) + end).encode(encoding))
    return path


def text(*head: str, columns: Sequence[Any] = (T, V, X), mark: str = ",", point: str = ".") -> str:
    """Return a table with these lines above its rows; text cells are written unchanged."""
    rows = (
        (c if isinstance(c, str) else f"{c:.9g}".replace(".", point) for c in row)
        for row in zip(*columns, strict=True)
    )
    return "\n".join([*head, *map(mark.join, rows), ""])


def kept(path: Path, content: str | bytes) -> Path:
    """Write a file."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def table(path: Path, *head: str, **form: Any) -> Path:
    """Write a table with these lines above its rows."""
    return kept(path, text(*head, **form))


def assert_is(
    record: Record, t: ArrayLike, v: ArrayLike, x: ArrayLike | None, accuracy: float = 1e-12
) -> None:
    """Demand the columns of a record in SI units; its time may begin anywhere."""
    instants, time = np.asarray(t, float), record.time
    np.testing.assert_allclose(time - time[0], instants - instants[0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(record.voltage, np.asarray(v, float), rtol=accuracy)
    moved = np.asarray(record.displacement, float)
    np.testing.assert_allclose(moved, np.asarray(x, float), rtol=accuracy)


def problems_of(path: Path, **options: Any) -> tuple[str, ...]:
    """Return the sentences with which a file is refused; each starts with its name."""
    with pytest.raises(InputError) as caught:
        read_record(path, **options)
    begin = (*str(path).split("+"), str(path), "--columns", "... and")
    assert all(p.startswith(begin) for p in caught.value.problems), caught.value
    return caught.value.problems


def refused(path: Path, **options: Any) -> str:
    """Return the message on a file that is refused."""
    return "\n".join(problems_of(path, **options))


def offered(statement: str) -> dict[str, Any]:
    """Return the options that a message offers once, as the command line would take them."""
    every = {a or b for a, b in _OFFERED.findall(statement + " ")}
    result = every - {"--columns table=all"}
    assert len(result) < 2, statement
    words = shlex.split(result.pop()) if result else []
    requested: dict[str, Any] = {}
    if "--columns" in words:
        requested["columns"] = words[words.index("--columns") + 1]
    if "--sample-time" in words:
        requested["sample_time"] = float(words[words.index("--sample-time") + 1])
    return requested


def read_by_fork(task: apart.FileTask) -> Outcome:
    """Return what a fork of this process reads of a file: a library may crash or hang it."""
    answer = Path(task.path).with_suffix(".json")
    child = os.fork()
    if not child:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, 5.0)
        answer.write_text(apart.to_json(apart.read_here(task)))
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        return Outcome((f"{task.path}: is damaged.",))
    return apart.from_json(answer.read_text())


def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the rest of a test read binary files in this process."""
    monkeypatch.setattr(apart, "read_apart", apart.read_here)
