"""What a call says of content that may be wrong."""

from collections.abc import Callable

from psa_casadi.errors import InputError


def sentences(call: Callable[[], object]) -> tuple[str, ...]:
    """Return the sentences with which a call refuses what it is given, none where it does not."""
    try:
        call()
    except InputError as error:
        return error.problems
    return ()
