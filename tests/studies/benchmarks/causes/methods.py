"""Answers to the data set: by `psa diagnose` (the record alone, every effect), and by PySINDy.

An outside method is PySINDy's sparse regression of what the fitted base leaves.

Discrepancy modelling (Kaheman, Kaiser, Strom, Kutz and Brunton 2019, "Learning discrepancy models
from experimental data") with sequentially thresholded least squares. Each term of the library
belongs to a cause of the list; the directions of the base's parameters are projected out first. As
the effects are as small as the noise, the residual itself is regressed and not its derivative.
`pip install pysindy`.
"""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import lfilter

import psa_casadi as psa
from psa_casadi.common.units import FloatArray

FORMAT = "psa_causes.answer/1"


def column_table(path: Path) -> FloatArray:
    """Return a CSV with one line of names, (N, columns), nan where a cell is empty."""
    return np.asarray(np.genfromtxt(path, delimiter=",", skip_header=1), dtype=np.float64)


def write_answer(method: str, answers: Path, data: Path, name: str) -> str:
    """Answer a case by a method, as NAME.json; return what is named."""
    begin, case = time.process_time(), data / "cases" / name
    detected, sets, predicted, gain = METHODS[method](case)
    content: dict[str, Any] = {
        "format": FORMAT,
        "case": name,
        "detected": detected,
        "causes": [{e: round(p, 6) for e, p in s.items()} for s in sets],
        "displacement_um": np.round(1e6 * predicted, 6).tolist(),
        "seconds": round(time.process_time() - begin, 2),
    }
    if gain is not None and np.all(np.isfinite(gain)):
        ends = (round(float(g), 3) for g in gain)
        content["gain_percent"] = dict(zip(("value", "low", "high"), ends, strict=True))
    answers.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content, ensure_ascii=False, allow_nan=False)
    (answers / f"{name}.json").write_text(text + "\n", encoding="utf-8")
    return f"case {name}: {content['causes'] or 'nothing named'}"


#: Sets of causes with their probabilities.
Sets = list[dict[str, float]]
#: Whether something was detected, the sets, the displacement on the held-out voltage (N,) [m], and
#: value and interval of the reduction of the held-out rms [%].
Answer = tuple[bool, Sets, FloatArray, tuple[float, float, float] | None]
#: 0 degC [K].
ZERO_CELSIUS = 273.15
#: Less than this is no statement.
_LEAST = 0.01


def by_psa(case: Path) -> Answer:
    """Diagnose the record of a case, and predict the held-out one."""
    d = psa.diagnose([psa.read_record(case / "record.csv")])
    gain = (d.gain.holdout_rms_reduction_percent, *d.gain.interval) if d.causes else None
    return d.verdict not in ("adequate", "not_driven"), _sets(d), _predicted(d, case), gain


def _sets(d: psa.StackDiagnosis) -> Sets:
    """Return each named cause and what cannot be distinguished from it, with probabilities.

    Candidates of the first step have a probability. A later cause has its confidence, and what
    cannot be distinguished from it shares the rest.
    """
    table = {c.effect: c.probability for c in d.candidates}
    sets = []
    for k, cause in enumerate(d.causes):
        rest = max(0.0, 1.0 - cause.confidence) / max(1, len(cause.cannot_be_told_from))
        one_set = {cause.effect: cause.confidence}
        for other in cause.cannot_be_told_from:
            one_set[other] = max(_LEAST, min(rest, table.get(other, rest) if k == 0 else rest))
        over = max(1.0, sum(one_set.values()))
        sets.append({e: p / over for e, p in one_set.items()})
    return sets


def _predicted(d: psa.StackDiagnosis, case: Path) -> FloatArray:
    """Return the displacement on the held-out voltage [m]: with the unnamed correction, where a
    remainder has no name and one is offered.
    """
    if d.patch is not None and d.verdict in ("unexplained", "partly_explained"):
        try:
            return _run(psa.patched_model(d), case)
        except psa.PsaError:
            pass  # the correction cannot be simulated: the model without it is the answer
    return _run(d.model, case)


def _run(model: psa.Model, case: Path) -> FloatArray:
    times, voltage, celsius = column_table(case / "holdout.csv").T
    warm = celsius + ZERO_CELSIUS if "temperature" in model.input_names else None
    return np.asarray(psa.simulate(model, times, voltage, temperature=warm).displacement)


#: Chosen on the data set of seed 4711: threshold over the residual's rms, and the least that a
#: cause lowers Schwarz's criterion.
THRESHOLD, LEAST = 0.1, 30.0
#: A cause within so much of Schwarz's criterion of the best cannot be distinguished from it.
_NEAR = 6.0
Library = dict[str, list[FloatArray]]


def library(t: FloatArray, v: FloatArray, warm: FloatArray, x: FloatArray) -> Library:
    """Return the terms of each cause (N,) from times, voltage, temperature and base displacement;
    scaled by constants of nobody's choosing: 100 V, 20 um, so that both records have the same.
    """
    u, z, dt = v / 100.0, x / 20.0, float(t[1] - t[0])
    rate = np.gradient(z, t)
    speed, turn = np.gradient(u, t), np.sign(np.gradient(u, t))
    air = warm - warm[0]
    waves = [w(2 * np.pi * f * t) for f in (50.0, 60.0, 100.0) for w in (np.sin, np.cos)]
    grid = [w(2 * np.pi * x / p) for p in (1.6, 1.8, 2.0, 2.2, 2.4) for w in (np.sin, np.cos)]
    half = float(np.median(z))
    heat = np.cumsum(np.abs(np.gradient(u))) * dt
    return {
        "slow_creep": [_lagged(z, dt, tau) for tau in (0.1, 1.0, 10.0)],
        "rate_dependent_hysteresis": [rate, rate * np.abs(rate), _root(rate)],
        "hysteresis_memory": [_play(u, r) for r in (0.05, 0.1, 0.2, 0.3)],
        "rate_independent_asymmetry": [turn * u * (1.0 - u), turn * u, _upper(_play(u, 0.2))],
        "field_dependent_gain": [u**2, u**3],
        "saturation_of_strain": [np.tanh(2.0 * u), np.tanh(u)],
        "structural_mode": [np.gradient(rate, t), _band(z, dt, 40.0), _band(z, dt, 80.0)],
        "load_stiffness": [z**2, z**3],
        "sensor_nonlinearity": [z**2, z**3],
        "preload_loss": [np.minimum(z - 0.25 * c, 0.0) for c in (half, 2 * half)],
        "backlash": [_play(z, r) for r in (0.002, 0.01)],
        "self_heating": [_lagged(heat, dt, 3.0), _lagged(np.abs(speed), dt, 3.0)],
        "ageing": [t * z, np.log1p(t) * z],
        "current_limit": [np.where(np.abs(speed) > c, speed, 0.0) for c in (2.0, 10.0)],
        "voltage_saturation": [np.maximum(u - c * float(u.max()), 0.0) for c in (0.8, 0.9, 0.95)],
        "drive_lag": [_lagged(u, dt, 2 * dt), _lagged(u, dt, 6 * dt)],
        "charge_leakage": [_lagged(u, dt, 3.0), _lagged(u, dt, 30.0)],
        "sensor_delay": [np.interp(t - k * dt, t, z) for k in (0.5, 1.5)],
        "sensor_ripple": grid,
        "sensor_jump": [np.sign(z - q) for q in np.quantile(z, (0.3, 0.4, 0.5, 0.6, 0.7))],
        "offset_drift": [t, t**2],
        "mains_hum": waves,
        "temperature": [air, _lagged(air, dt, 0.1), air * z],
    }  # fmt: skip


def _lagged(x: FloatArray, dt: float, tau: float) -> FloatArray:
    a = float(np.exp(-dt / tau))
    return np.asarray(lfilter([1.0 - a], [1.0, -a], x), dtype=np.float64)


def _root(x: FloatArray) -> FloatArray:
    return np.asarray(np.sign(x) * np.abs(x) ** 0.5, dtype=np.float64)


def _upper(x: FloatArray) -> FloatArray:
    return np.maximum(x, 0.0)


def _band(x: FloatArray, dt: float, f: float) -> FloatArray:
    r, w = 0.95, 2.0 * np.pi * f * dt
    return np.asarray(lfilter([1.0, -1.0], [1.0, -2.0 * r * np.cos(w), r * r], x), np.float64)


def _play(x: FloatArray, r: float) -> FloatArray:
    out, now = np.empty_like(x), float(x[0])
    for k, value in enumerate(x.tolist()):
        now = min(max(now, value - r), value + r)
        out[k] = now
    return out


def by_sindy(case: Path) -> Answer:
    """Regress the residual of a case; name the causes whose terms stay."""
    record, held = column_table(case / "record.csv"), column_table(case / "holdout.csv")
    bases = [column_table(case / f"base_{k}.csv")[:, 2] for k in ("record", "holdout")]
    moves = np.load(case / "base.npz")
    terms, later = (
        library(table[:, 0], table[:, 1], table[:, -1], base)
        for table, base in zip((record, held), bases, strict=True)
    )
    causes = list(terms)
    owner = np.array([c for c in causes for _ in terms[c]])
    output = np.isfinite(record[:, 2])
    nuisance = np.asarray(moves["record"], dtype=np.float64)
    scale = np.linalg.norm(nuisance, axis=0)
    base_part = np.linalg.qr((nuisance / scale)[output])[0]
    raw = np.column_stack([column for c in causes for column in terms[c]])[output]
    y = (record[:, 2] - bases[0])[output]
    free, rest = (a - base_part @ (base_part.T @ a) for a in (raw, y))
    size = np.sqrt(np.mean(free**2, axis=0)) + 1e-12
    level = float(np.std(rest))
    kept = _sparse(free / size, rest / level, THRESHOLD)
    named = _named(free / size, rest / level, owner, {str(c) for c in owner[kept]}, LEAST)
    use = np.isin(owner, [max(s, key=lambda c: s[c]) for s in named])
    weights = np.linalg.lstsq(free[:, use] / size[use], rest, rcond=1e-6)[0] / size[use]
    after = np.column_stack([column for c in causes for column in later[c]])
    shift = np.linalg.lstsq((nuisance / scale)[output], raw[:, use] @ weights, rcond=1e-8)[0]
    added = after[:, use] @ weights - np.asarray(moves["holdout"], float) @ (shift / scale)
    predicted = 1e-6 * (bases[1] + added)
    return bool(named), named, predicted, None


def _sparse(a: FloatArray, y: FloatArray, threshold: float) -> Any:
    """Return which columns PySINDy's optimiser keeps, (K,) bool."""
    from pysindy import STLSQ  # noqa: PLC0415  an optional need of this benchmark alone

    stlsq = STLSQ(threshold=threshold, alpha=0.05, max_iter=20)
    stlsq.fit(a, y[:, None])
    return np.abs(stlsq.coef_[0]) > 0.0


def _criterion(a: FloatArray, y: FloatArray) -> float:
    """Return Schwarz's criterion of a least-squares fit."""
    left = y - a @ np.linalg.lstsq(a, y, rcond=1e-6)[0] if a.shape[1] else y
    return float(y.size * np.log(np.mean(left**2)) + a.shape[1] * np.log(y.size))


def _named(a: FloatArray, y: FloatArray, owner: Any, kept: set[str], least: float) -> Sets:
    """Take causes one by one while the criterion falls; those as good as the best share its set."""
    sets: Sets = []
    chosen: list[str] = []
    before = _criterion(a[:, :0], y)
    while rivals := [c for c in sorted(kept) if c not in chosen]:
        after = {c: _criterion(a[:, np.isin(owner, [*chosen, c])], y) for c in rivals}
        best = min(after, key=lambda c: after[c])
        if before - after[best] < least:
            break
        near = {
            c: np.exp(0.5 * (after[best] - b)) for c, b in after.items() if b < after[best] + _NEAR
        }
        total = sum(near.values())
        sets.append({c: float(p / total) for c, p in near.items()})
        chosen, before = [*chosen, best], after[best]
    return sets


#: Who answers.
METHODS = {"psa": by_psa, "sindy": by_sindy}
