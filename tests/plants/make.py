"""Synthetic records with one hidden effect, or none, and the truth behind them.

    python -m tests.plants.make demo OUT.csv
    python -m tests.plants.make EFFECT SEED OUT.csv

EFFECT is a name of tests/plants/table.py, or none.
"""

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from tests.plants.base import Run, simulate_base
from tests.plants.effect import HiddenEffect
from tests.plants.excitation import draw_voltage
from tests.plants.stack import FloatArray, Stack, draw_stack
from tests.plants.table import HIDDEN_EFFECTS
from tests.plants.visibility import base_directions, visible_ratio

HEADER = "time [s],voltage [V],displacement [um]"
RATIO = (1.5, 4.0)
"""Visible ratio (tests/plants/visibility.py) that is drawn at strength 1."""
SEARCH = 12
"""Sub-intervals while a gain is searched; the record itself has the full number."""
DEMO_EFFECT, DEMO_SEED = "slow_creep", 2015


@dataclass(frozen=True)
class Truth:
    """What is behind a record.

    effect: the hidden effect or None; foreign: True where the project's table has no such effect.
    gain and parameters: the effect's own, SI. stack: the base. sigma, quantum: noise and count of
    the sensor [m]. visible: rms of what the base cannot absorb over sigma. times, voltage,
    displacement, base_displacement: (N,) clean [s, V, m], the last without the effect.
    gain_limited: the gain wanted was beyond the effect's plausible range and was clipped.
    """

    effect: str | None
    foreign: bool
    gain: float
    parameters: Mapping[str, float]
    stack: Stack
    sigma: float
    quantum: float
    visible: float
    gain_limited: bool
    times: FloatArray
    voltage: FloatArray
    displacement: FloatArray
    base_displacement: FloatArray


def make_record(effect: str | None, seed: int, path: Path, strength: float = 1.0) -> Truth:
    """Write a synthetic record as CSV and return the truth; the same seed gives the same bytes.

    effect: a name of `HIDDEN_EFFECTS` or None. strength scales the drawn visible ratio (1.5 to 4);
    0 removes the effect. The same seed gives the same stack, voltage and noise with every effect.
    """
    if effect is not None and effect not in HIDDEN_EFFECTS:
        raise KeyError(f"No hidden effect is called {effect}; there are {sorted(HIDDEN_EFFECTS)}.")
    base_rng, effect_rng, noise_rng = (
        np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3)
    )
    stack = draw_stack(base_rng)
    run = simulate_base(stack, *draw_voltage(base_rng, stack.u_rated))
    sigma = float(np.ptp(run.displacement)) * float(noise_rng.uniform(0.001, 0.002))
    quantum = sigma * float(noise_rng.uniform(0.25, 0.5))
    truth = _hide(effect, run, effect_rng, strength, sigma, quantum)
    noisy = truth.displacement + sigma * noise_rng.standard_normal(run.times.size)
    write_csv(path, run.times, run.command, quantum * np.round(noisy / quantum) + 0.0)
    return truth


def _hide(
    effect: str | None,
    run: Run,
    rng: np.random.Generator,
    strength: float,
    sigma: float,
    quantum: float,
) -> Truth:
    added = np.zeros_like(run.times)
    gain, visible, limited = 0.0, 0.0, False
    parameters: dict[str, float] = {}
    hidden = None if effect is None else HIDDEN_EFFECTS[effect]
    if hidden is not None:
        parameters = hidden.draw(rng, run)
        wanted = strength * float(rng.uniform(*RATIO))
        directions = base_directions(run)
        gain, limited = find_gain(hidden, run, parameters, directions, wanted * sigma)
        added = hidden.contribution(run, parameters, gain)
        visible = visible_ratio(directions, added, sigma)
    return Truth(
        effect=effect,
        foreign=hidden is not None and hidden.foreign,
        gain=gain,
        parameters=parameters,
        stack=run.stack,
        sigma=sigma,
        quantum=quantum,
        visible=visible,
        gain_limited=limited,
        times=run.times,
        voltage=run.command,
        displacement=run.displacement + added,
        base_displacement=run.displacement,
    )


def find_gain(
    hidden: HiddenEffect,
    run: Run,
    parameters: Mapping[str, float],
    directions: FloatArray,
    wanted: float,
) -> tuple[float, bool]:
    """Gain at which the part that the base cannot absorb has the rms `wanted` [m], and whether it
    was clipped.
    """
    if wanted <= 0.0:
        return 0.0, False

    trial = run if hidden.linear else simulate_base(run.stack, run.times, run.command, SEARCH)

    def excess(log_gain: float) -> float:
        added = hidden.contribution(trial, parameters, math.exp(log_gain))
        return math.log(max(visible_ratio(directions, added, wanted), 1e-9))

    low, high = (math.log(edge) for edge in hidden.plausible)
    if hidden.linear:
        log_gain = low - excess(low)
        return math.exp(min(max(log_gain, low), high)), not low <= log_gain <= high
    if excess(low) >= 0.0 or excess(high) <= 0.0:
        return math.exp(low if excess(low) >= 0.0 else high), True
    return math.exp(float(brentq(excess, low, high, xtol=0.02))), False


def write_csv(path: Path, times: FloatArray, voltage: FloatArray, displacement: FloatArray) -> None:
    """Write a record: times to 1 us, voltage to 1 mV, displacement [m] in um to 1 pm."""
    rows = [
        f"{t:.6f},{v:.3f},{x * 1e6:.6f}"
        for t, v, x in zip(times.tolist(), voltage.tolist(), displacement.tolist(), strict=True)
    ]
    path.write_text("\n".join([HEADER, *rows]) + "\n", encoding="utf-8")


def make_demo(path: Path) -> Truth:
    """The demonstration's record: a stack that creeps."""
    return make_record(DEMO_EFFECT, DEMO_SEED, path)


def main(arguments: list[str]) -> int:
    """Run from the command line; 0 done, 2 wrong usage."""
    if len(arguments) == 2 and arguments[0] == "demo":
        make_demo(Path(arguments[1]))
        return 0
    known = {*HIDDEN_EFFECTS, "none"}
    if len(arguments) == 3 and arguments[0] in known and arguments[1].isdigit():
        effect = None if arguments[0] == "none" else arguments[0]
        make_record(effect, int(arguments[1]), Path(arguments[2]))
        return 0
    sys.stderr.write(__doc__ or "")
    return 2


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
