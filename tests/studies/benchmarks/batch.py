"""`psa batch` on a population with hidden defects: how many are detected, and false alarms."""

import tempfile
from collections.abc import Callable, Mapping, Set
from dataclasses import replace
from pathlib import Path

import numpy as np

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.population.population import population
from tests.studies.benchmarks.table import Outcome, Progress, TitledTable, share
from tests.studies.plants.base import simulate_base
from tests.studies.plants.make import write_csv
from tests.studies.plants.stack import Stack, draw_stack

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


def write_devices(folder: Path, count: int, defects: int, seed: int = 20) -> dict[str, str]:
    """Write a record for each device, and a table of jobs; return the defects by name, "" for none.

    Sound devices differ in force, hysteresis, asymmetry and bend. The voltage has loops that
    shrink, so that each turns at other voltages. The same seed gives the same bytes.
    """
    folder.mkdir()
    rng, usual = np.random.default_rng(seed), draw_stack(np.random.default_rng(7))
    times: FloatArray = STEP * np.arange(SAMPLES, dtype=np.float64)
    swing = (1.0 - np.cos(4.0 * np.pi * times)) * np.exp(-0.25 * times)
    bad = dict(zip(sorted(rng.choice(count, defects, replace=False).tolist()),
                   list(DEFECTS) * count, strict=False))  # fmt: skip
    texts, rows = {}, ["device,batch,date,files"]
    for k in range(count):
        force, wide, skew, bend = np.exp(SPREAD * rng.standard_normal(4)).tolist()
        stack = _hysteresis(usual, wide)
        stack = replace(
            stack, k_l=usual.k_l * force, delta=stack.delta * skew,
            n=usual.n * bend if usual.n > 1.1 else usual.n,
        )  # fmt: skip
        name, defect = f"S{k:04d}", bad.get(k, "")
        stack = DEFECTS[defect](stack) if defect else stack
        run = simulate_base(stack, times, np.asarray(0.5 * usual.u_rated * swing))
        noise = NOISE * usual.stroke * rng.standard_normal(SAMPLES)
        write_csv(folder / f"{name}.csv", times, run.command, run.displacement + noise)
        rows.append(f"{name},B{k * 10 // count},2026-{k * 12 // count + 1:02d}-15,{name}.csv")
        texts[name] = defect
    (folder / "jobs.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    return texts


def _hysteresis(s: Stack, factor: float) -> Stack:
    """Scale the hysteresis force; its reference force too, so that the loop keeps its shape."""
    a, b, g, h = (factor * x for x in (s.a, s.beta, s.gamma, s.h_ref))
    return replace(s, a=a, beta=b, gamma=g, h_ref=h)


#: Devices, of which one in twenty has a defect.
DEVICES, QUICK = 100, 24


def run(progress: Progress, quick: bool, size: int = DEVICES) -> Outcome:
    """Diagnose `size` devices as a batch; the outliers should be those with a defect."""
    count = QUICK if quick else size
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        progress("making the devices")
        devices = write_devices(folder / "records", count, max(4, count // 20))
        whole = psa.batch(folder / "records", folder / "results", progress=progress)
        fleet = population(whole.findings)
        return Outcome([_detection(devices, {o.device for o in fleet.outliers})])


def _detection(devices: Mapping[str, str], outliers: Set[str]) -> TitledTable:
    """Return how many devices with a defect are outliers, and how many sound ones."""
    groups = {"none (false alarms)": "", **{kind: kind for kind in DEFECTS}}
    rows = [{"defect": "any", "detected": share(n in outliers for n, d in devices.items() if d)}]
    for name, kind in groups.items():
        detected = share(n in outliers for n, d in devices.items() if d == kind)
        rows.append({"defect": name, "detected": detected})
    note = "Detected: p below 0.05, adjusted by Benjamini and Hochberg over devices and parameters."
    return TitledTable(f"Defects among {len(devices)} devices", rows, note)
