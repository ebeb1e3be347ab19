"""What a search finds while it runs, as lines of JSON in a file that others may read meanwhile."""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psa_casadi.errors import InputError

if TYPE_CHECKING:
    from psa_casadi.diagnosis.task import Tried


@contextmanager
def events_to(path: Path | None) -> Iterator[Callable[["Tried"], None]]:
    """Yield a function that adds a line for a hypothesis to a file at once; to none without one.

    A line holds the fields of `Tried`; a number that is not finite is null. The file is begun anew.

    Raises:
        InputError: the file cannot be written to.
    """
    if path is None:
        yield lambda tried: None
        return
    try:
        stream = path.open("w", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot write ({error.strerror}); choose another name.") from None
    with stream:

        def tell(tried: "Tried") -> None:
            row = {name: _plain(value) for name, value in asdict(tried).items()}
            stream.write(json.dumps(row, allow_nan=False) + "\n")
            stream.flush()

        yield tell


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
