"""A ball that bounces, as a supplier may write it with PythonFMU3."""

import math
from typing import Any

from pythonfmu3 import Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability


class Ball(Fmi3Slave):  # type: ignore[misc]
    """h'' = -g; at h = 0 the speed v becomes -e v. Every bounce is at its time."""

    def __init__(self, **words: Any) -> None:
        super().__init__(**words)
        self.time, self.h, self.v, self.g, self.e = 0.0, 1.0, 0.0, 9.81, 0.7
        output, moves = Fmi3Causality, Fmi3Variability.continuous
        fixed = {"causality": output.parameter, "variability": Fmi3Variability.tunable}
        self.register_variable(Float64("time", causality=output.independent, variability=moves))
        self.register_variable(Float64("h", causality=output.output, variability=moves))
        self.register_variable(Float64("g", start=9.81, **fixed))
        self.register_variable(Float64("e", start=0.7, **fixed))

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Follow parabolas from bounce to bounce."""
        left = step_size
        while True:
            falls = (self.v + math.sqrt(self.v**2 + 2 * self.g * self.h)) / self.g
            part = min(left, falls)
            self.h = max(0.0, self.h + self.v * part - 0.5 * self.g * part**2)
            self.v -= self.g * part
            left -= part
            if left <= 0.0:
                break
            self.h, self.v = 0.0, -self.e * self.v
            if self.v < 1e-3:
                self.h = self.v = 0.0
                break
        self.time = current_time + step_size
        return True
