"""Mechanics sought again where a fit has found the force but not what is behind it.

Two resonances within the band, a lag and the zero between them give a fit many places to come to
rest, most of them far above the noise. There the force is nearly right: what it has of the
voltage's history is quasi-static and hardly depends on the mechanics. So the fit's own force,
simulated, takes the voltage's place in `linear_start`: poles by vector fitting, placed, refined
with the ratio k_P/k_B free, and a full fit from each of the best. The play operators of
`starting_points` then stand for what is wrong with that force. A better fit has a better force.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from math import log

import numpy as np

from psa_casadi.errors import PsaError
from psa_casadi.identification.exchanges import force_of
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.fitting.prediction import measured
from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.refitting import (
    quick_from,
    record_rms,
    refit,
    residual_noise,
)
from psa_casadi.identification.start.starting_points import Excerpt, fastest_part, placed, sought
from psa_casadi.progress import Progress
from psa_casadi.records.split import Experiment, fitted
from psa_casadi.units import FloatArray

#: Samples that one record and all together may have, and the fewest that count.
_MOST, _ALL, _FEWEST = 6_000, 12_000, 16
#: Share of them that is given to the transient: from the record's start, and from amid it.
_LEAD, _AMID = 0.01, 0.2
#: Records sampled this much more slowly than the fastest add no dynamics.
_SLOWER = 30.0
#: Orders of vector fitting.
_ORDERS = (2, 3, 4, 5, 6)
#: How many starts get a few evaluations, how many of these a full refinement.
_ROUNDS = ((12, 6), (4, 25))
#: How many full fits are begun, with how many evaluations, how many of them are ended, and rounds.
_BEGUN, _QUICK, _ENDED, _REPEATS = 3, 15, 2, 4
#: The fit misses something where its rms is this much above the noise; a better one lowers the
#: cost, twice the log-likelihood, by more than this.
_MISSED, _BETTER = 1.01, 20.0
#: Share of the rms that is taken for noise at least.
_FLOOR = 0.1
_FREE = ("m_P", "m_B", "k_P")
_FORCES = ("k_L", "A", "beta", "gamma", "delta", "h_ref")


def retuned(
    best: Fit, experiments: Sequence[Experiment], progress: Progress, *, reached: float = np.inf
) -> Fit:
    """Return a fit whose mechanics was sought again while that explains more; `best` if nothing.

    It is sought while records miss more than their own fast part, which holds some of a misfit's
    ringing, or than the rms [m] that another model has `reached`. Needs two resonators (k_P, k_B);
    records on instants that are not uniform do not contribute. A keyboard interrupt ends it at the
    best fit so far.
    """
    if "k_P" not in best.model.values:
        return best
    for _ in range(_REPEATS):
        levels = residual_noise(best, experiments)
        pairs = zip(record_rms(best, experiments), levels, strict=True)
        misfit = best.rms > reached or any(rms > _MISSED * level for rms, level in pairs)
        if best.interrupted or not misfit:
            return best
        progress("base fit, mechanics again behind the force found")
        try:
            better = _once(best, experiments)
        except KeyboardInterrupt:
            return replace(best, interrupted=True)
        except (PsaError, np.linalg.LinAlgError):
            return best
        if better is None or better.data_cost > best.data_cost - _BETTER:
            return best
        best = better
    return best


def _once(best: Fit, experiments: Sequence[Experiment]) -> Fit | None:
    parts = list(_parts(best, experiments))
    if not parts:
        return None
    item = log(best.model.values["k_P"] / best.model.values["k_B"])
    starts = [s for e in parts for s in placed(e, e.v, _ORDERS, (item, -item), weak=False)]
    names = list(dict.fromkeys([*best.unknowns.names, *_FREE]))
    forces = {s.name for s in best.model.structure.states if s.unit == "N"}
    items = []
    for linear in sought(parts, starts, _ROUNDS, ratio_free=True)[0][:_BEGUN]:
        values = _values(best, linear.theta)
        scale = values["k_L"] / best.model.values["k_L"]  # memories of forces change with them
        states = [
            {n: v * (scale if n in forces else 1.0) for n, v in s.items()} for s in best.starts()
        ]
        quick = quick_from(
            best, best.model.with_values(values), experiments, names,
            start_states=states, evaluations=_QUICK,
        )  # fmt: skip
        items += [quick] if quick is not None else []
    result = sorted(items, key=lambda f: f.data_cost)[:_ENDED]
    ended = [refit(f, experiments, names, sigma=best.sigma, least=best.rms) for f in result]
    if any(f.interrupted for f in (*result, *ended)):
        raise KeyboardInterrupt
    return min(ended, key=lambda f: f.data_cost, default=None)


def _parts(best: Fit, experiments: Sequence[Experiment]) -> Iterator[Excerpt]:
    """Yield the records with the fit's force, in metres of static displacement, for a voltage."""
    fastest = min(e.record.sample_time for e in fitted(experiments))
    values, levels, total = best.model.values, residual_noise(best, experiments), 0
    for k, e in enumerate(experiments):
        record, y = e.record, measured(e.record)
        steps, there = np.diff(record.time), np.isfinite(y)
        uneven = np.ptp(steps) > 0.01 * record.sample_time
        if uneven or record.sample_time > _SLOWER * fastest or total >= _ALL:
            continue
        first = fastest_part(record.voltage, _MOST) if y.size > _MOST else 0
        cut = slice(first, first + _MOST)
        valid = (e.used & there)[cut]
        valid[: max(1, int((_AMID if first else _LEAD) * valid.size))] = False
        if valid.sum() < _FEWEST or not np.ptp(record.voltage[cut][valid]):
            continue
        force = force_of(best, k, record)
        source = (force[cut] - force[cut][0]) * static_compliance(values)
        filled = np.interp(np.arange(y.size), np.flatnonzero(there), y[there])
        level = max(levels[k], _FLOOR * best.rms)
        total += valid.size
        yield Excerpt(
            name=record.name,
            h=record.duration / steps.size,
            longest=record.duration,
            v=source,
            y=filled[cut] - filled[cut][0],
            valid=valid,
            sigma=level,
            loop=source,
            static=best.rms,
        )


def _values(best: Fit, theta: FloatArray) -> dict[str, float]:
    """Return the parameters of theta, forces scaled to keep the displacement.

    Of the two lags behind the force the slower is the creep lag; the other one is added to the
    drive's.
    """
    p = best.model.values
    one, two, a_p, q_p, a_b, q_b, ratio = np.exp(theta).tolist()
    k_b, k_p = p["k_B"], ratio * p["k_B"]
    table = {
        "tau": max(one, two),
        "R_s": p["R_s"] + min(one, two) / p["C_p"],
        "k_P": k_p,
        "c_P": a_p * k_p,
        "m_P": q_p * k_p,
        "c_B": a_b * k_b,
        "m_B": q_b * k_b,
    }
    scale = static_compliance(p) / static_compliance({**p, **table})
    table |= {n: scale * p[n] for n in _FORCES if n in p}
    bounds = {n: best.model.parameter(n).bounds for n in table}
    return {n: float(np.clip(v, *bounds[n])) for n, v in table.items()}
