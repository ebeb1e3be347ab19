"""The base once more, behind a changed command or a changed drive: what an effect before the
hysteresis adds.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.studies.plants.base import (
    DrivePath,
    Run,
    elastic_displacement,
    force_to_displacement,
    hysteresis_force,
    linear_drive,
)
from tests.studies.plants.effect import Parameters
from tests.studies.plants.stack import FloatArray


def follow(run: Run, command: FloatArray) -> Run:
    """The same stack driven by another command on the fine grid, (M,) [V], linear in between."""
    path: DrivePath = linear_drive(run.stack, run.path.time, command, run.fine_step)
    hysteresis = hysteresis_force(run.stack, path)
    fine = elastic_displacement(run.stack, command, run.fine_step)
    fine = fine + force_to_displacement(run.stack, hysteresis, run.fine_step)
    force = run.stack.k_l * path.voltage + hysteresis
    return replace(run, fine_command=command, path=path, force=force, fine_displacement=fine)


def moved_by(run: Run, command: FloatArray) -> FloatArray:
    """Displacement with another command minus that of the run, at the samples, (N,) [m]."""
    moved = follow(run, command).displacement - run.displacement
    return np.asarray(moved, dtype=np.float64)


def moved(
    driven: Callable[[Run, Parameters, float], Run],
) -> Callable[[Run, Parameters, float], FloatArray]:
    """What an effect of the drive adds at the samples, (N,) [m]: `driven` minus the run itself."""

    def contribution(run: Run, parameters: Parameters, gain: float) -> FloatArray:
        if gain == 0.0:
            return np.zeros_like(run.times)
        added = driven(run, parameters, gain).displacement - run.displacement
        return np.asarray(added, dtype=np.float64)

    return contribution
