"""The base once more, behind a changed command or a changed drive: what an effect before the
hysteresis adds.
"""

from dataclasses import replace

import numpy as np

from tests.plants.base import (
    DrivePath,
    Run,
    elastic_displacement,
    force_to_displacement,
    hysteresis_force,
    linear_drive,
    refine,
)
from tests.plants.stack import FloatArray


def fine_command(run: Run) -> FloatArray:
    """The command on the fine grid, (M,) [V]."""
    return refine(run.times, run.command, run.sub_intervals)[1]


def follow(run: Run, command: FloatArray) -> Run:
    """The same stack driven by another command on the fine grid, (M,) [V], linear in between."""
    path: DrivePath = linear_drive(run.stack, run.path.time, command, run.fine_step)
    hysteresis = hysteresis_force(run.stack, path)
    fine = elastic_displacement(run.stack, command, run.fine_step)
    fine = fine + force_to_displacement(run.stack, hysteresis, run.fine_step)
    force = run.stack.k_l * path.voltage + hysteresis
    return replace(run, path=path, force=force, fine_displacement=fine)


def moved_by(run: Run, command: FloatArray) -> FloatArray:
    """Displacement with another command minus that of the run, at the samples, (N,) [m]."""
    moved = follow(run, command).displacement - run.displacement
    return np.asarray(moved, dtype=np.float64)
