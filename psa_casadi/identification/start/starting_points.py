"""The points from which a search starts: shapes of loop, and dynamics that the records show."""

from collections.abc import Mapping, Sequence

import numpy as np

from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.start.linear import LinearCandidate
from psa_casadi.identification.start.loop import loop_start
from psa_casadi.identification.start.ordinary import has_loop, loop_starts
from psa_casadi.model.compose import Model
from psa_casadi.records.record import Record

#: Candidate dynamics that miss the fast records this much more than the best are not tried.
_WORSE, _DYNAMICS = 1.2, 3
#: An oscillator shows where sqrt(m/k) is at least this share of the sampling interval.
_RESOLVED = 0.3
_MASSES = ("m_P", "m_B")


def starting_points(
    model: Model, linear: Sequence[LinearCandidate], records: Sequence[Record]
) -> list[tuple[str, dict[str, float]]]:
    """Return the starts by name; static gain and loop keep their size where k_P moves.

    The loop that the records show comes first, then shapes that loops usually have: fewer of them
    where the records show a loop, and where they show dynamics to try.
    """
    shapes = _shapes(model, records, fewer=bool(linear))
    if not linear:
        return shapes
    found = _dynamics(model, linear, min(r.sample_time for r in records))
    dynamics = [_within_bounds(model, values) for values in found]
    named = [(name, _moved(model, shape, dynamics[0])) for name, shape in shapes]
    return named + [
        (f"dynamics {k}", _moved(model, shapes[0][1], other))
        for k, other in enumerate(dynamics[1:], 2)
    ]


def _shapes(
    model: Model, records: Sequence[Record], *, fewer: bool
) -> list[tuple[str, dict[str, float]]]:
    """Return shapes of loop; the model's own where its hysteresis is none of Bouc-Wen's."""
    if not has_loop(model):
        return [("the model's own loop", {})]
    shapes = [(f"loop shape {k}", shape) for k, shape in enumerate(loop_starts(model), 1)]
    shown = loop_start(model, records)
    return (
        shapes if shown is None else [("the records' loops", shown), *shapes[: 1 if fewer else 2]]
    )


def resolved(
    model: Model, linear: Sequence[LinearCandidate], sample_time: float
) -> tuple[str, ...]:
    """Return the masses, and k_P, that are searched because the best candidate shows them.

    Two masses that the sampling resolves are searched even where they are told badly: lags told
    beside masses that are only assumed would look surer than they are.
    """
    if not linear:
        return ()
    values = {**model.values, **linear[0].values}
    times = {m: (values[m] / values[m.replace("m", "k")]) ** 0.5 for m in _MASSES}
    masses = tuple(m for m, t in times.items() if t >= _RESOLVED * sample_time)
    return (*masses, *(n for n in ("k_P",) if masses and n in linear[0].told))


def _dynamics(
    model: Model, linear: Sequence[LinearCandidate], sample_time: float
) -> list[dict[str, float]]:
    """Return the dynamics to start from: the creep lag the slower one, then the drive's lag.

    A linear response cannot tell the two apart; amplifiers are usually the faster. Where the
    sampling resolves no mass, masses stay as they are and the slowest lag is the creep lag.
    """
    near = [dict(c.values) for c in linear if c.misfit < _WORSE * linear[0].misfit]
    if not set(_MASSES) & set(resolved(model, linear, sample_time)):
        near = [_creep_slowest(model, values) for values in near]
    slow_first, turned = [], []
    for values in near:
        drive = values["R_s"] * model.values["C_p"]
        there = {**values, "tau": drive, "R_s": values["tau"] / model.values["C_p"]}
        pair = (values, there) if values["tau"] >= drive else (there, values)
        slow_first.append(pair[0])
        turned.append(pair[1])
    return [*slow_first[:_DYNAMICS], turned[0]]


def _within_bounds(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Return values within the bounds of the model's parameters: slow records have slow lags."""
    bounds = {p.name: p.bounds for p in model.structure.parameters}
    return {n: float(np.clip(v, *bounds[n])) for n, v in values.items()}


def _creep_slowest(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Return dynamics of lags alone: ordinary masses, the creep lag exchanged with a slower c/k."""
    ordinary = {k: v for k, v in values.items() if k not in (*_MASSES, "k_P")}
    stiffness = {c: model.values[c.replace("c", "k")] for c in ("c_P", "c_B")}
    shown = {c: values[c] / {**model.values, **values}[c.replace("c", "k")] for c in stiffness}
    ordinary |= {c: lag * stiffness[c] for c, lag in shown.items()}
    slow = max(shown, key=lambda c: shown[c])
    if shown[slow] > values["tau"]:
        ordinary |= {"tau": shown[slow], slow: values["tau"] * stiffness[slow]}
    return ordinary


def _moved(
    model: Model, shape: Mapping[str, float], candidate: Mapping[str, float]
) -> dict[str, float]:
    """Return a loop with a candidate's dynamics, forces scaled to keep the displacement."""
    before = static_compliance(model.values)
    ratio = before / static_compliance({**model.values, **candidate})
    forces = {"k_L": model.values["k_L"], **shape}
    scaled = {n: v if n == "n" else v * ratio for n, v in forces.items()}
    return {**scaled, **candidate}
