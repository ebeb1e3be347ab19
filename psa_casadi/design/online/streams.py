"""A sampled recursion as a streaming object: one sample in, one out, a few microseconds."""

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.component import Expression

#: The recursion: what is kept and what comes in, to what is kept then and what goes out.
Recursion = Callable[
    [list[Expression], list[Expression]], tuple[Sequence[Expression], Sequence[Expression]]
]


class Stream:
    """Steps a recursion in place.

    The recursion is written once in CasADi, by `recursion(kept, inputs) -> (kept, outputs)`, and
    evaluated by CasADi's virtual machine on memory that is laid out once: a sample allocates
    nothing. Two copies of what is kept take turns as source and target.
    """

    def __init__(self, recursion: Recursion, start: Sequence[float], inputs: int) -> None:
        kept, given = ca.SX.sym("kept", len(start)), ca.SX.sym("given", inputs)
        after, out = recursion(ca.vertsplit(kept), ca.vertsplit(given))
        self._function = ca.Function(
            "recursion", [kept, given], [ca.vertcat(*after), ca.vertcat(*out)], {"cse": True}
        )
        self._kept = (np.array(start, dtype=float), np.array(start, dtype=float))
        self._given, self._out = np.zeros(inputs), np.zeros(len(out))
        self._buffers = tuple(self._bound(k) for k in (0, 1))
        self._evaluate = tuple(evaluate for _, evaluate in self._buffers)
        self._turn = 0
        self.given: Any = self._given.data
        self.out: Any = self._out.data

    def _bound(self, source: int) -> tuple[Any, Callable[[], None]]:
        """Return the function bound to memory, reading from one copy and writing to the other."""
        bound: Any = self._function.buffer()
        buffer, evaluate = bound
        buffer.set_arg(0, self._kept[source].data)
        buffer.set_arg(1, self._given.data)
        buffer.set_res(0, self._kept[1 - source].data)
        buffer.set_res(1, self._out.data)
        return buffer, evaluate

    def step(self) -> None:
        """Advance by one sample: `given` has been written, `out` can be read."""
        self._evaluate[self._turn]()
        self._turn = 1 - self._turn

    @property
    def kept(self) -> tuple[float, ...]:
        """What is kept now."""
        return tuple(self._kept[self._turn].tolist())
