"""Records with a column besides the displacement: monitor, charge, second sensor, load cell.

The stack is the one of `make.py` with one hidden effect; every further column has a separate scale,
zero and white noise. `amplifier` and `capacitance` are hidden here alone, as only such
columns show them.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from psa_casadi.records.record import Record
from tests.studies.plants.base import (
    DrivePath,
    Run,
    follow,
    force_to_displacement,
    hysteresis_force,
    simulate_base,
)
from tests.studies.plants.ceramic import bent as saturated
from tests.studies.plants.excitations import ExcitationKind, draw_excitation
from tests.studies.plants.mechanics import balance
from tests.studies.plants.sensor import bend as bent
from tests.studies.plants.stack import FloatArray, draw_stack
from tests.studies.plants.table import HIDDEN_EFFECTS

#: Noise of the displacement over its range, and of a further column over that column's.
NOISE, FURTHER_NOISE = 1e-3, 2e-3
#: How sharply a curve bends over.
SHARPNESS = 1.9


@dataclass(frozen=True)
class Truth:
    """What happens in truth at the samples (N,): displacement, its reading, voltage, load.

    SI units; `load` is the force on the tip, `fine_charge` (M,) what is on the electrodes between
    the samples as well.
    """

    run: Run
    displacement: FloatArray
    reading: FloatArray
    voltage: FloatArray
    load: FloatArray
    fine_charge: FloatArray

    def record(self, seed: int, *columns: str, samples: int | None = None) -> Record:
        """Return the record with noise, and with these further columns."""
        rng = np.random.default_rng(seed)
        current = np.gradient(self.fine_charge, self.run.fine_step)
        table = {
            "monitor_voltage": 0.01 * self.voltage + 0.003,
            "charge": self.fine_charge[:: self.run.sub_intervals] + 2e-6,
            "current": current[:: self.run.sub_intervals] + 1e-3,
            "displacement_2": 0.83 * self.displacement - 3e-6,
            "strain": 55.0 * self.displacement + 1e-5,
            "load_force": self.load,
        }
        read = self.reading + NOISE * np.ptp(self.reading) * rng.standard_normal(self.reading.size)
        noisy: Mapping[str, FloatArray] = {
            n: x + FURTHER_NOISE * (np.ptp(x) or 1.0) * rng.standard_normal(x.size)
            for n, x in table.items()
        }
        others: dict[str, Any] = {n: x for n, x in noisy.items() if n in columns}
        whole = Record(
            name="stack", time=self.run.times, voltage=self.run.command, displacement=read, **others
        )
        return whole if samples is None else whole.slice(0, samples)


def plain(seed: int, excitation: ExcitationKind = "rich") -> Truth:
    """Return a stack without any effect, and with a straight load of a twentieth of its stiffness.

    The base of all others.
    """
    rng = np.random.default_rng(seed)
    stack = draw_stack(rng)
    run = simulate_base(stack, *draw_excitation(rng, excitation, stack.u_rated))
    x, u = run.displacement, run.path.voltage[:: run.sub_intervals]
    load = -0.05 * x / stack.compliance
    return Truth(run, x, x, u, load, _charge(run))


def bent_sensor(truth: Truth, gain: float) -> Truth:
    """An S-shaped characteristic of the first displacement sensor."""
    x, span = truth.displacement, float(np.ptp(truth.displacement))
    centre = float(x.min()) + 0.4 * span
    return replace(truth, reading=x + gain * span * bent(x, centre, span, 1.9))


def stiffening_load(truth: Truth, gain: float) -> Truth:
    """A spring that hardens, in the place of the straight one."""
    x = balance(truth.displacement, 0.45 * float(np.ptp(truth.displacement)), gain)
    load = -(truth.displacement - x) / truth.run.stack.compliance
    return replace(truth, displacement=x, reading=x, load=load)


def soft_amplifier(truth: Truth, gain: float) -> Truth:
    """An amplifier whose output bends over as that stack's strain does, before the hysteresis."""
    run, scale = truth.run, truth.run.stack.u_rated / gain
    moved = follow(run, scale * saturated(run.fine_command / scale, SHARPNESS))
    x, u = moved.displacement, moved.path.voltage[:: run.sub_intervals]
    return replace(truth, displacement=x, reading=x, voltage=u, fine_charge=_charge(moved))


def saturating_stack(truth: Truth, gain: float) -> Truth:
    """Strain that saturates: `saturation_of_strain` with this sharpness."""
    added = HIDDEN_EFFECTS["saturation_of_strain"].contribution(truth.run, {"p": SHARPNESS}, gain)
    x = truth.displacement + added
    return replace(truth, displacement=x, reading=x)


def growing_capacitance(truth: Truth, gain: float) -> Truth:
    """A capacitance C exp(g u/U): R q' = v - u, one exponential step for each sub-interval."""
    run, stack = truth.run, truth.run.stack
    command, top = run.fine_command, stack.u_rated
    u = np.zeros(command.size)
    for k, ahead in enumerate(command[1:].tolist()):
        time = stack.drive_time * math.exp(gain * u[k] / top)
        u[k + 1] = ahead - (ahead - u[k]) * math.exp(-run.fine_step / time)
    path = DrivePath(run.path.time, u, run.path.time, u, np.arange(u.size))
    force = stack.k_l * u + hysteresis_force(stack, path)
    fine = force_to_displacement(stack, force, run.fine_step)
    charge = stack.c_p_el * top / gain * np.expm1(gain * u / top) + stack.k_l * fine
    x, voltage = (q[:: run.sub_intervals] for q in (fine, u))
    return replace(truth, displacement=x, reading=x, voltage=voltage, fine_charge=charge)


def _charge(run: Run) -> FloatArray:
    """Charge of the capacitance, and what a displacement frees by reciprocity: k_L x."""
    return run.stack.c_p_el * run.path.voltage + run.stack.k_l * run.fine_displacement
