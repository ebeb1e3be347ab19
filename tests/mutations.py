"""The messages of a call on content that may be wrong."""

from collections.abc import Callable

from psa_casadi.common.errors import InputError


def sentences(call: Callable[[], object]) -> tuple[str, ...]:
    """Return the sentences with which a call refuses its arguments, none if it accepts them."""
    try:
        call()
    except InputError as error:
        return error.problems
    return ()
