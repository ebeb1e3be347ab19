"""A record of the exam: simulated on a finer step, sampled, and written as a file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.studies.exam.causes import (
    AMPLIFIER,
    AT_ONCE,
    CREEP,
    ELECTRICAL,
    MASSES,
    MOTION,
    READING,
    displacement,
    free_strain,
    stack_voltage,
    temperature,
    with_noise,
)
from tests.studies.exam.hysteresis import (
    bouc_wen,
    coleman_hodgdon,
    draw_density,
    duhem,
    prandtl_ishlinskii,
    preisach,
    relays,
)
from tests.studies.exam.record import Floats, Record, Run
from tests.studies.exam.voltages import draw_voltage

_GROWING = "growing thresholds"
#: All causes that a record may hide.
CAUSES = (
    *AMPLIFIER, *ELECTRICAL, *AT_ONCE, *CREEP, *MASSES, *MOTION, *READING, _GROWING,
)  # fmt: skip
#: The monitor shows a twentieth of the amplifier's output, with noise of this rms [V].
_MONITOR, _MONITOR_NOISE = 20.0, 5e-4


@dataclass(frozen=True)
class Played:
    """Samples (N,): times [s], command [V], reading without noise [um], columns by head."""

    times: Floats
    voltage: Floats
    clean: Floats
    columns: dict[str, Floats]


def play(record: Record) -> Played:
    """Simulate a record, without the noise of its sensor."""
    test = record.test
    step = 1 / test.rate / test.steps
    run = Run(record, np.arange(test.samples * test.steps, dtype=np.float64) * step, step)
    command = draw_voltage(run)
    output = run.changed(AMPLIFIER, command)
    u = stack_voltage(output, run)
    strain = free_strain(_hysteretic(u, run), u, run)
    clean = run.changed(READING, displacement(strain, run))
    columns = {}
    if test.monitor:
        columns["monitor_voltage [V]"] = output / _MONITOR
    if "temperature" in record.hidden:
        columns["temperature [degC]"] = temperature(run)
    every = slice(None, None, test.steps)
    return Played(
        run.times[every], command[every], clean[every], {h: c[every] for h, c in columns.items()}
    )


def _hysteretic(u: Floats, run: Run) -> Floats:
    """Return what the hysteresis of the stack makes of its voltage, after one full loop."""
    stack, test, rng = run.record.stack, run.record.test, run.record.draws(2)
    history = (0.0, test.limits[1], test.limits[0], float(u[0]))
    match stack.hysteresis:
        case "Bouc-Wen":
            return bouc_wen(u, history, _bouc_wen_values(run.record), run.step)
        case "Preisach":
            return preisach(u, history, draw_density(test.limits, rng))
        case "relays":
            return relays(u, history, test.limits, rng)
        case "Prandtl-Ishlinskii":
            (growth,) = run.record.hidden.get(_GROWING, (0.0,))
            return prandtl_ishlinskii(u, history, 0.7 * test.span, run.step, growth)
        case "Coleman-Hodgdon":
            return coleman_hodgdon(u, history, 0.6 * test.span)
        case "Duhem":
            return duhem(u, history, 0.6 * test.span)


def _bouc_wen_values(record: Record) -> tuple[float, float, float, float, float]:
    """A, beta, gamma, n and delta, from the height of the loop and the share of gamma."""
    usual = (-0.32, 0.055 * record.test.span, 0.15, 1.0, 0.0)
    A, height, share, n, delta = record.stack.bouc_wen or usual
    beta = abs(A) / height**n / (1 - share)
    return A, beta, share * beta, n, delta


def write(record: Record, path: Path) -> None:
    """Play a record and write it as CSV: time, voltage, displacement, further columns."""
    played = play(record)
    columns = dict(played.columns)
    if record.test.monitor:
        noise = record.draws(9).standard_normal(played.times.size)
        head = "monitor_voltage [V]"
        columns[head] = columns[head] + _MONITOR_NOISE * noise
    heads = ["time [s]", "voltage [V]", "displacement [um]", *columns]
    measured = with_noise(played.clean, record)
    voltage = np.round(played.voltage / 1e-4) * 1e-4
    table = np.stack([played.times, voltage, measured, *columns.values()], axis=1)
    formats = ["%.9g", "%.5f", "%.6f", *("%.6f" for _ in columns)]
    np.savetxt(path, table, delimiter=",", fmt=formats, header=",".join(heads), comments="")
