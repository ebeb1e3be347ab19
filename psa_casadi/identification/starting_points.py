"""The points from which a search starts: shapes of loop, and dynamics that the records show."""

from collections.abc import Mapping, Sequence

from psa_casadi.identification.linear_start import LinearCandidate
from psa_casadi.identification.starting import loop_starts
from psa_casadi.identification.unknowns import static_compliance
from psa_casadi.model.compose import Model

#: Candidate dynamics that miss the fast records this much more than the best are not tried.
_WORSE, _DYNAMICS = 1.2, 3


def starting_points(
    model: Model, linear: Sequence[LinearCandidate]
) -> list[tuple[str, dict[str, float]]]:
    """Return the starts by name; static gain and loop keep their size where k_P moves."""
    shapes = [("loop shape {}", shape) for shape in loop_starts(model)]
    named = [(name.format(k + 1), dict(shape)) for k, (name, shape) in enumerate(shapes)]
    if linear:
        dynamics = _dynamics(model, linear)
        named = [(name, _moved(model, shape, dynamics[0])) for name, shape in named]
        named += [
            (f"dynamics {k}", _moved(model, shapes[0][1], other))
            for k, other in enumerate(dynamics[1:], 2)
        ]
    return named


def _dynamics(model: Model, linear: Sequence[LinearCandidate]) -> list[dict[str, float]]:
    """Return the dynamics to start from: the creep lag the slower one, then the drive's lag.

    A linear response cannot tell the two apart; amplifiers are usually the faster.
    """
    near = [c.values for c in linear if c.misfit < _WORSE * linear[0].misfit]
    slow_first, turned = [], []
    for values in near:
        drive = values["R_s"] * model.values["C_p"]
        there = {**values, "tau": drive, "R_s": values["tau"] / model.values["C_p"]}
        pair = (dict(values), there) if values["tau"] >= drive else (there, dict(values))
        slow_first.append(pair[0])
        turned.append(pair[1])
    return [*slow_first[:_DYNAMICS], turned[0]]


def _moved(
    model: Model, shape: Mapping[str, float], candidate: Mapping[str, float]
) -> dict[str, float]:
    """Return a loop with a candidate's dynamics, forces scaled to keep the displacement."""
    before = static_compliance(model.values)
    ratio = before / static_compliance({**model.values, **candidate})
    forces = {"k_L": model.values["k_L"], **shape}
    scaled = {n: v if n == "n" else v * ratio for n, v in forces.items()}
    return {**scaled, **candidate}
