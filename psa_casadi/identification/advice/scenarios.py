"""Plausible values for lags and masses that the records leave open, to plan a record with."""

from collections.abc import Collection, Mapping, Sequence

from psa_casadi.model.compose import Model

#: Parameters that only fast records determine; a fit leaves them at their start where it must.
SEARCHABLE = ("tau", "R_s", "c_P", "c_B", "c", "m_P", "m_B", "m")
#: Weights by which the open lags share their sum, and the damping ratio of open masses. No two
#: lags are equal: two equal poles cannot be told apart by any record.
_CASES: tuple[tuple[Mapping[str, float], float], ...] = (
    ({"tau": 10.0, "R_s": 2.0, "c_P": 1.0, "c_B": 4.0, "c": 4.0}, 2.0),
    ({"tau": 2.0, "R_s": 4.0, "c_P": 1.0, "c_B": 10.0, "c": 10.0}, 0.3),
)


def scenarios(model: Model, open_names: Collection[str]) -> list[Model]:
    """Return models that agree with the records and fill in what these leave open.

    The sum of the open lags (tau, R_s C_p, c/k) stays what was identified; once tau has most of it
    and open masses are overdamped (damping ratio zeta = 2), once the mechanics have most of it and
    open masses ring (zeta = 0.3): m = (c/2 zeta)^2 / k. An estimate of an open parameter may be
    anything, a bound included, so a forecast must not rest on it. Values stay within their bounds.
    """
    names = [n for n in SEARCHABLE if n in model.values and n in open_names]
    return [_filled(model, names, *case) for case in _CASES]


def _filled(
    model: Model, names: Sequence[str], weights: Mapping[str, float], damping: float
) -> Model:
    values = dict(model.values)
    lags = [n for n in names if n in weights]
    total = sum(_lag(model.values, n) for n in lags)
    for name in lags:
        share = weights[name] / sum(weights[n] for n in lags)
        values[name] *= share * total / _lag(model.values, name)
    for name in names:
        if name not in weights:
            c, k = (values[q + name[1:]] for q in "ck")
            values[name] = (0.5 * c / damping) ** 2 / k
        low, high = model.parameter(name).bounds
        values[name] = min(max(values[name], low), high)
    return model.with_values(values)


def _lag(values: Mapping[str, float], name: str) -> float:
    """Return the lag [s] that a parameter stands for."""
    if name == "tau":
        return values["tau"]
    if name == "R_s":
        return values["R_s"] * values["C_p"]
    return values[name] / values["k" + name[1:]]
