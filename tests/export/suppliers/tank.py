"""A tank that is filled and leaks, as a supplier may write it with PythonFMU."""

import math
import os
from typing import Any

from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Tank(Fmi2Slave):  # type: ignore[misc]
    """area level' = inflow - outlet sqrt(2 g level), and nothing while the valve is shut."""

    def __init__(self, **words: Any) -> None:
        super().__init__(**words)
        self.inflow, self.valve, self.level = 0.0, True, 0.2
        self.area, self.outlet = 0.5, 0.01
        output, tunable = Fmi2Causality, {"variability": Fmi2Variability.tunable}
        self.register_variable(Real("inflow", causality=output.input))
        self.register_variable(Boolean("valve", causality=output.input))
        self.register_variable(Real("level", causality=output.output))
        self.register_variable(Real("area", causality=output.parameter, **tunable))
        self.register_variable(Real("outlet", causality=output.parameter, **tunable))

    def do_step(self, _: float, step_size: float) -> bool:
        """Take steps of 50 ms at most, by the midpoint rule."""
        if self.area > 4.9:
            os._exit(3)
        count = max(1, math.ceil(step_size / 0.05))
        for _ in range(count):
            middle = self.level + 0.5 * step_size / count * self._rate(self.level)
            self.level += step_size / count * self._rate(middle)
        return True

    def _rate(self, level: float) -> float:
        leaves = self.outlet * math.sqrt(max(0.0, 19.62 * level)) if self.valve else 0.0
        return (self.inflow - leaves) / self.area
