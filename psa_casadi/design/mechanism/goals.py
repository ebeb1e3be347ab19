"""What a mechanism is wanted for and what it may cost, checked before any search."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, sqrt

from psa_casadi.errors import Problems


@dataclass(frozen=True)
class Limits:
    """What a mechanism may cost.

    `stroke_loss`: largest share of the static stroke [1]; `force`: largest force in the mechanism
    in a step of rated voltage [N]; `mass` [kg] and `damping` [N.s/m]: least and largest.
    """

    stroke_loss: float = 0.1
    force: float | None = None
    mass: tuple[float, float] = (0.0, 1.0)
    damping: tuple[float, float] = (0.0, 1e5)


def goal_texts(
    damping: float | None, width: float | None, poles: Sequence[complex]
) -> tuple[str, ...]:
    """Return each goal in words."""
    texts = []
    if damping is not None:
        texts.append(f"a damping ratio of {damping:g} or more")
    if width is not None:
        texts.append(f"a bandwidth of {width:g} Hz or more")
    if poles:
        texts.append("poles at " + ", ".join(f"{p:.5g}" for p in poles) + " rad/s")
    return tuple(texts)


def wanted_pairs(poles: Sequence[complex]) -> tuple[tuple[float, float], ...]:
    """Return (natural frequency, damping ratio) of wanted poles: conjugates, then real ones."""
    upper = [p for p in poles if p.imag > 0.0]
    real = sorted(p.real for p in poles if p.imag == 0.0)
    pairs = [(abs(p), -p.real / abs(p)) for p in upper]
    for a, b in zip(real[::2], real[1::2], strict=True):
        w = sqrt(a * b)
        pairs.append((w, -(a + b) / (2.0 * w)))
    return tuple(pairs)


def check_goals(
    damping: float | None,
    width: float | None,
    poles: Sequence[complex],
    limits: Limits,
    starts: int,
) -> None:
    """Raise an InputError that names every goal and limit that makes no sense."""
    problems = Problems()
    if poles and (damping is not None or width is not None):
        problems.add(
            "Poles are wanted together with a damping or a bandwidth; leave one of them out."
        )
    if not poles and damping is None and width is None:
        problems.add("Nothing is wanted; give a damping ratio, a bandwidth in Hz, or poles.")
    if damping is not None and not 0.0 < damping <= 1.0:
        problems.add(f"The damping ratio {damping:g} is not in (0, 1]; 0.7 is usual.")
    if width is not None and not 0.0 < width < inf:
        problems.add(f"The bandwidth {width:g} Hz is not positive; give it in Hz.")
    _check_poles(poles, problems)
    _check_limits(limits, problems)
    if starts < 1:
        problems.add(f"{starts} starts find nothing; give 1 or more.")
    problems.raise_if_any()


def _check_poles(poles: Sequence[complex], problems: Problems) -> None:
    if not all(isfinite(p.real) and isfinite(p.imag) and p.real < 0.0 for p in poles):
        problems.add("A wanted pole has no negative real part; a mounted stack must be stable.")
    for p in poles:
        if p.imag and not any(abs(q - p.conjugate()) < 1e-9 * abs(p) for q in poles):
            problems.add(f"The wanted pole {p:.5g} comes without its conjugate; add it.")
    if len(poles) not in (0, 2, 4):
        problems.add(
            f"{len(poles)} poles are wanted; give one or two pairs: two or four poles in rad/s."
        )
    elif sum(p.imag == 0.0 for p in poles) % 2:
        problems.add("A real pole is wanted alone; real poles come in pairs too.")


def _check_limits(limits: Limits, problems: Problems) -> None:
    if not 0.0 <= limits.stroke_loss < 1.0:
        problems.add(
            f"The largest stroke loss is {limits.stroke_loss:g}; give a share of the stroke from 0"
            " up to, not including, 1."
        )
    if limits.force is not None and not 0.0 < limits.force < inf:
        problems.add(
            f"The largest force is {limits.force:g} N; give a positive one, or leave it out."
        )
    for what, (low, high), unit in (
        ("mass", limits.mass, "kg"),
        ("damping", limits.damping, "N.s/m"),
    ):
        if not 0.0 <= low < high < inf:
            problems.add(
                f"The {what} may lie between {low:g} and {high:g} {unit}, which is no range; give"
                " a least value of 0 or more and a larger one."
            )
