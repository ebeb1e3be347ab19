"""A triangle leaves two causes open; the designed record of the same length separates them.

A stack's gain grows with the field. A triangle cannot distinguish that from a bent sensor: every
loop is the same. Three further records of the same length and the same range of voltages are
simulated, with noise: a sine, a triangle again, and the one that `psa design experiment` designs,
which comes to its levels by different ways.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from psa_casadi.design.experiment.experiment import (
    Separated,
    columns_to_play,
    resolving_experiment,
    usual_records,
)
from psa_casadi.design.experiment.limits import Limits
from psa_casadi.design.experiment.search import Effort
from psa_casadi.diagnosis.diagnose import diagnose
from psa_casadi.diagnosis.result import StackDiagnosis
from psa_casadi.model.effects import EFFECTS
from psa_casadi.model.stacks import stack_model
from psa_casadi.records import Record, write_record
from psa_casadi.records.signals import Signals
from psa_casadi.simulation.simulate import simulate

EFFECT, RIVAL = "field_dependent_gain", "sensor_nonlinearity"
LIMITS = Limits(low=0.0, high=100.0, duration=2.0, samples=500)
#: Growth of the gain at rated voltage, noise of the sensor [m].
GROWTH, NOISE = 0.05, 58e-9


def main(folder: Path) -> dict[str, str]:
    """Measure a triangle, diagnose, design, play three records, diagnose each with the first."""
    usual = usual_records(LIMITS, LIMITS.steepest(None))
    first = measured(usual["triangle"], seed=1)
    effects = [EFFECTS[EFFECT], EFFECTS[RIVAL]]
    before = diagnose([first], effects=effects)
    design = resolving_experiment(before, limits=LIMITS, effort=Effort(draws=2, starts=1, steps=3))
    write_record(folder / "voltage.csv", columns_to_play(design))
    played = {n: measured(r, seed=2) for n, r in {**usual, "designed": design.record}.items()}
    after = {n: diagnose([first, r], effects=effects) for n, r in played.items()}
    _draw(folder / "separate_two_causes.png", design, played, after)
    return {"after the first triangle": named_causes(before)} | {
        f"with a {n} record besides": named_causes(d) for n, d in after.items()
    }


def measured(record: Signals, seed: int) -> Record:
    """Return what the device's sensor shows when a voltage is played to it."""
    voltage = record.columns["voltage"]
    model = stack_model("P-885.51").with_effect(EFFECTS[EFFECT], {"field_gain": GROWTH})
    x = simulate(model, record.time, voltage).outputs["displacement"]
    noise = NOISE * np.random.default_rng(seed).standard_normal(record.n)
    return Record(name=record.name, time=record.time, voltage=voltage, displacement=x + noise)


def named_causes(d: StackDiagnosis) -> str:
    """Return the causes of a diagnosis, with what cannot be distinguished from them."""
    names = [n for c in d.causes for n in (c.effect, *c.cannot_be_told_from)]
    return " or ".join(names) or d.verdict


def _draw(
    path: Path, design: Separated, played: dict[str, Record], after: dict[str, StackDiagnosis]
) -> None:
    figure = Figure(figsize=(8.0, 7.0), layout="constrained")
    rows = figure.subplots(len(played), 1, sharex=True, sharey=True)
    least = min(p.designed for p in design.pairs)
    growth = {n: min(p.usual[n] for p in design.pairs) for n in design.usual_chance}
    for axes, (name, record) in zip(rows, played.items(), strict=True):
        axes.plot(record.time, record.voltage, color="#0072b2", linewidth=1.2)
        grown = growth.get(name, least)
        words = named_causes(after[name]).replace("_", " ")
        axes.set_title(
            f"{name}: ln B grows by {grown:.2g} (predicted); diagnosed: {words}", fontsize=9
        )
        axes.set_ylabel("voltage [V]")
        axes.grid(color="#dddddd", linewidth=0.8)
        axes.margins(x=0.01)
    rows[-1].set_xlabel("time [s]")
    hidden = EFFECT.replace("_", " ")
    figure.suptitle(f"Records of the same length and amplitude; hidden: {hidden}")
    figure.savefig(path, dpi=110)
