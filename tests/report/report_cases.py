"""Diagnoses with chosen findings, and a fit, on simulated records: what a report must show."""

from dataclasses import replace
from functools import cache, partial
from typing import get_args

import numpy as np

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis import corrections, result
from psa_casadi.diagnosis.held_out import Errors, Gain, Share, StackBudget
from psa_casadi.diagnosis.misfit import Misfit, misfit
from psa_casadi.diagnosis.noise import NoiseFloor, noise_floor
from psa_casadi.diagnosis.remedy import Size
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import Simulated
from psa_casadi.identification.fitting.unknowns import unknowns_of
from psa_casadi.identification.identify import StackIdentification, identify
from psa_casadi.model.variables import Interval, Provenance
from psa_casadi.records import multisine, sine, time_grid
from psa_casadi.records.split import Experiment, split, whole
from psa_casadi.report.words.series import Curve, Series
from psa_casadi.simulation.simulate import EXACT, Way

NOISE = 5e-9
VERDICTS: tuple[result.Verdict, ...] = get_args(result.Verdict)
ADDED = {"cause_named", "partly_explained", "ambiguous"}


@cache
def experiment(name: str, samples: int) -> tuple[Experiment, FloatArray, FloatArray]:
    """Return a record of a stack that drifts, some samples missing, without and with the drift."""
    time = time_grid(samples / 1000.0, 1e-3)
    voltage = multisine(time, 5.0, 95.0, (1.0, 12.0), seed=3)
    clean = psa.simulate(psa.compose(psa.BASE), time, voltage).displacement
    drift = 8e-8 * time / time[-1]
    y = clean + drift + NOISE * np.random.default_rng(1).standard_normal(len(time))
    y[40:50] = np.nan
    record = psa.Record(name=name, time=time, voltage=voltage, displacement=y)
    return split(record), clean, clean + drift


@cache
def misfits(name: str, samples: int) -> tuple[NoiseFloor, Misfit, Misfit]:
    """Return the noise floor of a record, and what models without and with the drift leave."""
    e, clean, drifting = experiment(name, samples)
    without, with_drift = (e.record.measured - y for y in (clean, drifting))
    (floor,) = noise_floor([e.record], [with_drift])
    return floor, misfit(e.record, without, floor), misfit(e.record, with_drift, floor)


def periodic(counts: bool = False) -> tuple[Experiment, NoiseFloor, Misfit, Misfit]:
    """Return a record of eight periods with an even error and hum, and its misfits without both."""
    time = time_grid(4.0, 1e-3)
    voltage = sine(time, 0.0, 100.0, 2.0)
    clean = 1e-7 * voltage
    bent = 4e-8 * ((voltage - 50.0) / 50.0) ** 2 + 3e-8 * np.sin(2.0 * np.pi * 51.0 * time)
    noise = NOISE * np.random.default_rng(4).standard_normal(time.size)
    size = 1e9 if counts else 1.0
    loops = partial(psa.Record, name="loops", time=time, voltage=voltage)
    loops = partial(loops, displacement_unit="counts" if counts else "m")
    quiet, record = (loops(displacement=size * y) for y in (clean + noise, clean + bent + noise))
    # the noise is known from before the hum began
    (floor,) = noise_floor([quiet], [size * noise])
    before, after = (misfit(record, size * e, floor) for e in (bent + noise, noise))
    return split(record), floor, before, after


def with_periodic(d: result.StackDiagnosis, *, counts: bool = False) -> result.StackDiagnosis:
    """Return a diagnosis of one record with another in its place, of a periodic voltage."""
    e, floor, before, after = periodic(counts)
    y = e.record.measured
    base = np.asarray((1e2 if counts else 1e-7) * e.record.voltage)
    return replace(d, experiments=(e,), noise=(floor,), misfit=(before,), remainder=(after,),
                   base=(base,), extended=(y,))  # fmt: skip


def _fit(model: psa.Model, experiments: tuple[Experiment, ...]) -> Fit:
    records = len(experiments)
    unknowns = unknowns_of(model, ("k_L", "tau"), [{}] * records, [0.0] * records, 1e-6)
    empty, levels = np.zeros((0, unknowns.size)), (NOISE,) * records
    return Fit(model, experiments, unknowns, np.zeros(unknowns.size), np.zeros(0), empty, levels,
               0.0, True, False, 1, Way(1e-6, 1e-6), (Simulated(EXACT, (0.0,)),))  # fmt: skip


def diagnosis(
    verdict: result.Verdict, names: tuple[str, ...] = ("plant_a",), samples: int = 1500
) -> result.StackDiagnosis:
    """Return a diagnosis with this verdict on the named records."""
    added = verdict in ADDED
    parts = [experiment(n, samples) for n in names]
    experiments, base = tuple(p[0] for p in parts), tuple(p[1] for p in parts)
    model = psa.compose((*psa.BASE, psa.EFFECTS["slow_creep"]) if added else psa.BASE)
    intervals = {"k_L": Interval(9.9, 10.1), "tau": Interval(1e-7, 1.0)}
    model = replace(model, provenance=Provenance(free=("k_L", "tau"), intervals=intervals))
    cause = result.Cause("slow_creep", "plant", 0.97,
                  {"creep_gain": corrections.Estimate(0.04, "1", (0.037, 0.043)),
                   "creep_time": corrections.Estimate(0.3, "s", (0.2, 0.45))},
                  ("offset_drift",) if verdict == "ambiguous" else (), 0.9,
                  "wait_or_feed_forward",
                  (Size("hold", 4e-8, "m", (3.7e-8, 4.3e-8), 10.0, "s", (0.0, 100.0)),
                   Size("hold", 9e-8, "m", None, 600.0, "s", (0.0, 100.0), True)))  # fmt: skip
    errors = Errors(4e-8, 5e-8, 1.5e-7, 0.31)
    removes = Share("slow_creep", 0.97 if added else 0.0, (0.95, 0.98) if added else (0.0, 0.0))
    left = (7e-9, 0.04) if added else (4.97e-8, 0.31)
    items = [misfits(n, samples) for n in names]
    return result.StackDiagnosis(
        verdict=verdict,
        causes=(cause,) if added else (),
        candidates=(
            result.Candidate("slow_creep", 0.93, 1250.0, True, 0.91 if added else 0.0),
            result.Candidate("offset_drift", -40.0, -3000.0, True, 0.08 if added else 0.0),
            result.Candidate("sensor_delay", 0.004, 0.2, False),
        ),
        noise_floor_rms_m=NOISE,
        base_errors=errors,
        extended_errors=Errors(5.1e-9, 8.5e-9, 2e-8, 0.052) if added else errors,
        errors=(result.OutputError("displacement", "m", NOISE, 5e-8, 8.5e-9 if added else 5e-8),),
        budget=StackBudget(
            replace(removes, what="together"), (removes,) * added, None, 4.97e-8, NOISE, *left
        ),
        gain=Gain(83.0, (79.0, 86.0)) if added else Gain(0.0, (0.0, 0.0)),
        blind_to=(
            result.BlindSpot("sensor_delay", 0.002, "s", "The record is slow <and> short."),
            result.BlindSpot("current_limit", 1e300, "1/A", "The current stays small."),
        ),
        remaining=result.Remaining(verdict in ("adequate", "cause_named"), 0.4, "Nothing is left."),
        next_experiment=result.NextExperiment(None, (), ("Hold the voltage for a minute.",)),
        remarks=("Forces are assumed.",),
        experiments=experiments,
        base_fit=_fit(psa.compose(psa.BASE), experiments),
        extended_fit=_fit(model, experiments),
        base=base,
        extended=tuple(p[2] for p in parts) if added else base,
        model=model,
        noise=tuple(s[0] for s in items),
        misfit=tuple(s[1] for s in items),
        remainder=tuple(s[2] if added else s[1] for s in items),
    )


@cache
def identification() -> StackIdentification:
    """Return the fit of the base model to two short records that drift."""
    return identify([experiment(*case)[0].record for case in (("rig_a", 1500), ("rig_b", 800))])


def long_fit(records: int, samples: int) -> tuple[StackIdentification, tuple[Series, ...]]:
    """Return a fit that claims to come from long records of loops, and their curves.

    Every record has one sample that is 3 um off, and one missing stretch of a fiftieth.
    """
    experiments, rows = [], []
    for k in range(records):
        rng = np.random.default_rng(k)
        time = np.arange(samples) / 100_000.0
        voltage = 50.0 - 40.0 * np.cos(200.0 * time) * np.exp(-time / time[-1])
        model = 1e-7 * voltage + 1e-6 * np.sin(200.0 * time)
        measured = model + NOISE * rng.standard_normal(samples)
        measured[int((0.05 + 0.4 * k / records) * samples)] += 3e-6
        measured[samples // 2 : samples // 2 + samples // 50] = np.nan
        record = psa.Record(name=f"long_{k + 1}", time=time, voltage=voltage, displacement=measured)
        experiments.append(whole(record))
        curve = Curve("model", "#0072b2", model)
        held = np.zeros(samples, dtype=bool)
        rows.append(Series(record.name, time, voltage, measured, (curve,), held, NOISE, False))
    fit = replace(identification().fit, experiments=tuple(experiments))
    return replace(identification(), fit=fit), tuple(rows)
