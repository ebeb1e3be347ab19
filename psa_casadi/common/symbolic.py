"""Expressions are made by one thread at a time, and read instruction by instruction.

CasADi lets other threads run while it works, and counts who holds a node of an expression without a
lock: two threads that make expressions at once may end the process.
"""

from collections.abc import Callable, Iterator
from functools import wraps
from threading import RLock
from typing import Any, ParamSpec, TypeVar

import casadi as ca

P = ParamSpec("P")
R = TypeVar("R")

_ONE = RLock()


def in_turn(work: Callable[P, R]) -> Callable[P, R]:
    """Return work on expressions that waits until no other thread is at such work."""

    @wraps(work)
    def alone(*inputs: P.args, **words: P.kwargs) -> R:
        with _ONE:
            return work(*inputs, **words)

    return alone


def instructions(function: ca.Function) -> Iterator[tuple[int, list[Any], list[int]]]:
    """Yield operation, inputs and outputs of each instruction of a function of SX.

    The input of a constant (`OP_CONST`) is its value.
    """
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        constant = operation == ca.OP_CONST
        inputs = [function.instruction_constant(k)] if constant else function.instruction_input(k)
        yield operation, inputs, function.instruction_output(k)
