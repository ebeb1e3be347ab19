"""Sampled blocks as streaming objects: one sample in, one out, a few microseconds."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from psa_casadi.component import Component
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model, compose

#: A displacement beyond so many strokes of the stack is no wish in metres.
_STROKES = 10.0


class Block:
    """A component that has sampled states only, stepped in place.

    Its equations are evaluated by CasADi's virtual machine on memory that is laid out once: a
    sample allocates nothing. Two copies of what is kept take turns as source and target. Inputs
    (`given`) and outputs (`out`) are in the order in which the component declares them. `values`
    may hold more than its parameters. A pickled block goes on where it was.

    Raises InputError for a value that is out of bounds.
    """

    def __init__(self, component: Component, values: Mapping[str, float]) -> None:
        own = {p.name: values[p.name] for p in component.parameters}
        model = compose([component], own, name=component.name, description=component.description)
        self._begin(model, [state.start for state in component.sampled])

    @property
    def model(self) -> Model:
        """The block as a model, to be exported as C, FMU or Modelica; it begins at its start."""
        return self._model

    @property
    def kept(self) -> dict[str, float]:
        """What is kept now, by the names of the sampled states."""
        names = self._model.sampled_names
        return dict(zip(names, self._kept[self._turn].tolist(), strict=True))

    def _begin(self, model: Model, kept: Sequence[float]) -> None:
        self._model, s = model, model.structure
        after, out = ca.substitute([s.znext, s.y], [s.p], [ca.DM(model.parameter_vector())])
        out = ca.substitute(out, s.z, after)
        self._function = ca.Function("recursion", [s.z, s.u], [after, out], {"cse": True})
        self._kept = (np.array(kept, dtype=float), np.array(kept, dtype=float))
        given, shown = np.zeros(s.u.numel()), np.zeros(s.y.numel())
        self._given: Any = given.data
        self._out: Any = shown.data
        self._buffers = tuple(self._bound(k) for k in (0, 1))
        self._evaluate = tuple(evaluate for _, evaluate in self._buffers)
        self._turn = 0

    def _bound(self, source: int) -> tuple[Any, Callable[[], None]]:
        """Return the function bound to memory, reading from one copy and writing to the other."""
        bound: Any = self._function.buffer()
        buffer, evaluate = bound
        buffer.set_arg(0, self._kept[source].data)
        buffer.set_arg(1, self._given)
        buffer.set_res(0, self._kept[1 - source].data)
        buffer.set_res(1, self._out)
        return buffer, evaluate

    def _advance(self) -> float:
        """Advance by one sample, for which `_given` has been written; return the first output."""
        self._evaluate[self._turn]()
        self._turn = 1 - self._turn
        return float(self._out[0])

    def __getstate__(self) -> dict[str, Any]:
        return {"model": self._model, "kept": self.kept}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._begin(state["model"], list(state["kept"].values()))


class Following(Block):
    """A block whose first input is a wanted displacement [m], and whose first output a voltage."""

    def _begin(self, model: Model, kept: Sequence[float]) -> None:
        super()._begin(model, kept)
        p = model.values
        self._per_volt = p["k_L"] / p["stiffness"]
        self._stroke = abs(self._per_volt) * p["u_rated"]

    def _follow(self, wanted: float) -> float:
        """Advance to a wanted displacement [m].

        Raises InputError, and stays where it is, where that is no number or beyond ten strokes.
        """
        if not abs(wanted) <= _STROKES * self._stroke:
            raise InputError(
                f"The wanted displacement is {wanted:g} m, of a stack whose stroke is"
                f" {1e6 * self._stroke:.3g} um; give metres, such as {0.5 * self._stroke:.2g}. For"
                " volts of a linear stack call step_voltage."
            )
        self._given[0] = wanted
        return self._advance()
