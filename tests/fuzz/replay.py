"""One saved input again: what it does, with the calls that it came through."""

from dataclasses import replace
from pathlib import Path

from psa_casadi.errors import InputError
from tests.fuzz.campaign import Amount, Tally, run
from tests.fuzz.table import TARGETS


def replay(path: Path) -> Tally:
    """Attack with the content of a file that a campaign saved; its name begins with the target's.

    Raises InputError where there is no such file, or its name says no target.
    """
    name = next((n for n in TARGETS if path.name.startswith(f"{n}-")), None)
    if name is None or not path.is_file():
        raise InputError(f"{path}: is no saved input; its name must begin with a target and '-'.")
    data = path.read_bytes()
    target = replace(TARGETS[name], make=lambda _: data)
    return run([target], 0, Amount(inputs={name: 1}), jobs=1)
