"""The cases: records by name and seed, and what is right to say of them."""

import tomllib
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.studies.exam.marks import Group, Question
from tests.studies.exam.record import Floats
from tests.studies.second_exam.lab import FOREIGN, record, wave
from tests.studies.second_exam.plants import HYST, SUB, Plant, electric, simulate

#: The rows of `cases.toml` by name.
TABLE: dict[str, dict[str, Any]] = tomllib.loads(
    Path(__file__).with_name("cases.toml").read_text("utf-8")
)
#: Halves by the first letter of a name: methods are tuned on the one and reported on the other.
HALVES = {"tune": "t", "report": "r"}
_GROUPS: dict[str, Group] = {"single": "one", "two": "two", "three": "three", "foreign": "foreign"}


@dataclass(frozen=True)
class Played:
    """Samples (n,): stamps [s], voltage [V], reading with noise and without [um]; the stack."""

    times: Floats
    voltage: Floats
    reading: Floats
    clean: Floats
    plant: Plant


def question(name: str) -> Question:
    """Return what is right to say of a case."""
    row = TABLE[name]
    right = tuple(frozenset(names) for names in row.get("right", ()))
    other = "hyst" in row["stack"]
    return Question(_GROUPS.get(name.split("_")[1], "clean"), right, other, row.get("noise", ""))


def play(name: str, seed: int) -> Played:
    """Simulate a case; noise, random voltages and 5 % of the stack are drawn from the seed."""
    row, rng = TABLE[name], np.random.default_rng([seed, zlib.crc32(name.encode())])
    n, dt = row["samples"], 1 / row["rate"]
    p, t = _plant(row, rng), np.arange(n) * dt
    v = wave(row["wave"], t, rng)
    u = np.round(p.lo + 0.5 * (v + 1) * (p.hi - p.lo), 4)
    fine, full = simulate(p, u, dt, rng, FOREIGN[row["extra"]] if "extra" in row else None)
    y, stamp = record(fine, full, t, row["noise_um"], row.get("noise", "white"), rng)
    keep = np.ones(n, bool)
    for place, number in row.get("dropped", ()):  # the time axis closes up
        keep[int(place * n) : int(place * n) + number] = False
    return Played(stamp[: keep.sum()], u[keep], y[keep], full[::SUB][keep], p)


def _plant(row: dict[str, Any], rng: np.random.Generator) -> Plant:
    """Return the stack of a row: its range, stroke, loop and resonances vary by 5 %."""
    stack = {"f2": 3.2 * row["stack"]["f1"]} | row["stack"]
    p, s = Plant(**stack, hidden=row.get("hidden", {})), rng.uniform(0.95, 1.05, 4).tolist()
    return replace(
        p, hi=p.lo + (p.hi - p.lo) * round(s[0], 2), stroke=p.stroke * s[1],
        f1=p.f1 * s[2], f2=p.f2 * s[2], width=p.width * s[3],
    )  # fmt: skip


def write(name: str, seed: int, path: Path) -> None:
    """Play a case and write it as CSV: time, voltage, displacement."""
    p = play(name, seed)
    np.savetxt(
        path, np.column_stack([p.times, p.voltage, p.reading]), fmt=("%.9g", "%.4f", "%.6f"),
        delimiter=",", header="time [s],voltage [V],displacement [um]", comments="",
    )  # fmt: skip


def size_um(name: str, seed: int) -> float:
    """Return the rms of what is hidden, after gain and offset of the healthy stack [um].

    Of another hysteresis than Bouc-Wen's, what the best of 16 loops of Bouc-Wen leaves.
    """
    row, p = TABLE[name], play(name, seed)
    dt = 1 / row["rate"]
    well = simulate(replace(p.plant, hidden={}), p.voltage, dt, np.random.default_rng(0))[1][::SUB]
    size = _rest(p.clean, well)
    if p.plant.hyst == "bouc_wen":
        return size
    v = 2 * (p.voltage - p.plant.lo) / (p.plant.hi - p.plant.lo) - 1
    free = electric(v, np.arange(len(v)) * dt, p.plant, {})
    loops = [
        HYST["bouc_wen"](v, ell, n, beta)
        for ell in (0.15, 0.3, 0.6, 1.0) for n in (1, 2) for beta in (0.5, 0.9)
    ]  # fmt: skip
    return float(np.hypot(size, 0.5 * p.plant.stroke * min(_rest(free, v, z) for z in loops)))


def _rest(y: Floats, *columns: Floats) -> float:
    """Return the rms that y leaves after the best combination of columns and a constant."""
    m = np.column_stack([*columns, np.ones(len(y))])
    return float(np.std(y - m @ np.linalg.lstsq(m, y, rcond=None)[0]))
