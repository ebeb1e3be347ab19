"""A population of stacks by the independent plant: spread of the devices, and hidden defects."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tests.plants.base import simulate_base
from tests.plants.make import write_csv
from tests.plants.stack import FloatArray, Stack, draw_stack

#: Samples of a record, time between them [s], noise over the stroke.
SAMPLES, STEP, NOISE = 600, 5e-3, 2e-4
#: Standard deviation of ln of a sound device's parameters.
SPREAD = 0.02
#: What is wrong with a device, and how large: a factor on what is named.
DEFECTS: dict[str, Callable[[Stack], Stack]] = {
    "weak (force per volt 0.94)": lambda s: replace(s, k_l=0.94 * s.k_l),
    "wide loop (hysteresis 1.08)": lambda s: _hysteresis(s, 1.08),
    "stiff (compliance 0.94)": lambda s: replace(
        s, k_p=s.k_p / 0.94, k_b=s.k_b / 0.94, m_p=s.m_p / 0.94, m_b=s.m_b / 0.94
    ),
    "sharp bend (n 1.08)": lambda s: replace(s, n=1.08 * s.n),
}


@dataclass(frozen=True)
class Device:
    """A device of the population and its defect, "" where it has none."""

    name: str
    defect: str


def write_devices(folder: Path, count: int, defects: int, seed: int = 20) -> tuple[Device, ...]:
    """Write a record for each device, and a table of jobs; the same seed gives the same bytes."""
    rng = np.random.default_rng(seed)
    usual = draw_stack(np.random.default_rng(7))
    times: FloatArray = STEP * np.arange(SAMPLES, dtype=np.float64)
    bad = set(rng.choice(count, defects, replace=False).tolist())
    kinds = list(DEFECTS)
    found, rows = [], ["device,batch,date,files"]
    for k in range(count):
        stack = _drawn(usual, rng)
        defect = kinds[len([b for b in bad if b < k]) % len(kinds)] if k in bad else ""
        stack = DEFECTS[defect](stack) if defect else stack
        run = simulate_base(stack, times, _voltage(times, usual.u_rated))
        noise = NOISE * usual.stroke * rng.standard_normal(SAMPLES)
        name = f"S{k:04d}"
        write_csv(folder / f"{name}.csv", times, run.command, run.displacement + noise)
        rows.append(f"{name},B{k * 10 // count},2026-{k * 12 // count + 1:02d}-15,{name}.csv")
        found.append(Device(name, defect))
    (folder / "jobs.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return tuple(found)


def _drawn(usual: Stack, rng: np.random.Generator) -> Stack:
    """Return a sound device: its own force, hysteresis, asymmetry and bend."""
    factors = np.exp(SPREAD * rng.standard_normal(4))
    stack = _hysteresis(usual, float(factors[1]))
    return replace(
        stack,
        k_l=usual.k_l * float(factors[0]),
        delta=stack.delta * float(factors[2]),
        n=usual.n * float(factors[3]) if usual.n > 1.1 else usual.n,
    )


def _hysteresis(s: Stack, factor: float) -> Stack:
    """Scale the hysteresis force; its reference force too, so that the loop keeps its shape."""
    a, b, g, h = (factor * x for x in (s.a, s.beta, s.gamma, s.h_ref))
    return replace(s, a=a, beta=b, gamma=g, h_ref=h)


def _voltage(times: FloatArray, span: float) -> FloatArray:
    """Return loops that shrink: every one turns at voltages of its own."""
    return np.asarray(0.5 * span * (1.0 - np.cos(4.0 * np.pi * times)) * np.exp(-0.25 * times))
