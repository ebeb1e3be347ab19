"""Which hypotheses may be the answer: what a cause must remove, and what held-out data must say."""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from psa_casadi.component import DISPLACEMENT_PEAKS, Component
from psa_casadi.diagnosis.screening import independent, without
from psa_casadi.diagnosis.search.hypothesis import Hypothesis, Scale
from psa_casadi.diagnosis.thresholds import thresholds
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.records.drive import tells_tone
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.linear_part import linear_part

FloatArray = npt.NDArray[np.float64]

#: Fits of one set whose evidence differs by so many nats at most are the same minimum.
_SAME = 1.0
#: Terms of a static curve.
_CURVE = 8
#: Share of a range that is near its end.
_END = 0.1
#: Damping ratio of a sharp resonance, and halves of its width within which a tone is its ringing.
_SHARP, _WIDTHS = 0.05, 2.0


def held_out_confirms(
    of: Hypothesis, before: Hypothesis, experiments: Sequence[Experiment], scale: Scale
) -> bool:
    """Whether held-out samples do not speak against what a hypothesis adds to another one.

    The rule is `confirmed`; a change of prediction with the sum of squares D promises D/2 over the
    noise's power.
    """
    held = np.concatenate([e.held_out for e in experiments])
    if not np.any(held):
        return True
    samples = np.count_nonzero(held) / scale.colour.inflation
    change = np.concatenate(
        [(new - old) for new, old in zip(of.predicted, before.predicted, strict=True)]
    )[held]
    after = max(of.holdout_rms, 1e-300)
    promise = 0.5 * samples * float(np.mean(change**2)) / after**2
    gained = scale.held_out(of, before)
    return confirmed(gained, promise, scale.of_fitted(of) - scale.of_fitted(before))


def confirmed(gained: float, promise: float, score: float) -> bool:
    """Whether a gain of the held-out log-likelihood is enough, beside that of the score [nats].

    A promised gain p is found give or take sqrt(2 p). Found must be `held_out`, or, where these
    samples can hardly show the cause, two such errors less than what is promised; and so much must
    the fitted samples' score and what is found be together.
    """
    least = min(thresholds().held_out, promise - 2.0 * float(np.sqrt(2.0 * promise)))
    return bool(gained > least and score + gained > thresholds().held_out)


def another_minimum(gained: float, held_out: float) -> bool:
    """Whether a fit of the same causes is another minimum that takes the other one's place.

    It has `gained` more evidence, and held-out samples do not object by more than that [nats].
    """
    return gained > _SAME and gained + held_out > 0.0


def shows_memory(of: Hypothesis, before: Hypothesis, experiments: Sequence[Experiment]) -> bool:
    """Whether what a cause adds to another hypothesis is more than a curve of the voltage.

    At most `static` of the power that the other's parameters cannot follow may be one. Elements
    that are wider than the voltage's way are such a curve.
    """
    pairs = zip(of.predicted, before.predicted, experiments, strict=True)
    added = np.concatenate([(new - old)[e.used] for new, old, e in pairs])
    voltage = np.concatenate([e.record.voltage[e.used] for e in experiments])
    basis = independent(before.fit.jacobian)
    target = without(added, basis)
    place = (voltage - voltage.min()) / max(float(np.ptp(voltage)), 1e-300)
    curves = np.cos(np.pi * np.outer(place, np.arange(1, _CURVE + 1)))
    static = independent(without(curves, basis)).T @ target
    return float(static @ static) < thresholds().static * float(target @ target)


def in_character(fit: Fit, cause: Component, experiments: Sequence[Experiment]) -> bool:
    """Whether the data ask for this effect and not for something else.

    Not with a parameter pushed to the end of its range, a tone among the harmonics of a periodic
    drive (a hum at the mains' frequency may lie between them), a hum where the stack itself rings,
    or a period over the displacement that fits into it less than twice.
    """
    values = fit.model.values
    widest = max(e.record.range_m for e in experiments)
    periods = [values[n] for n, grid in cause.probe.items() if grid == DISPLACEMENT_PEAKS]
    if any(period > 0.5 * widest for period in periods):
        return False
    tone = cause.tone
    hum = cause.belongs_to == "environment"
    if tone is not None and not all(
        tells_tone(values[tone], e.record, hum=hum) for e in experiments
    ):
        return False
    if tone is not None and hum and _rings_at(fit, values[tone]):
        return False
    return inside_ranges(values, cause)


def _rings_at(fit: Fit, frequency: float) -> bool:
    """Whether a frequency [Hz] lies within a sharp resonance of the fitted model."""
    try:
        poles = np.linalg.eigvals(linear_part(fit.model).a) / (2.0 * np.pi)
    except (PsaError, np.linalg.LinAlgError):
        return False
    sharp = np.abs(poles.real) < _SHARP * np.abs(poles)
    near = np.abs(np.abs(poles) - frequency) < _WIDTHS * np.abs(poles.real)
    return bool(np.any(sharp & near))


def inside_ranges(values: Mapping[str, float], cause: Component) -> bool:
    """Whether no parameter of a cause but its gain was pushed to the end of its range.

    One whose lower end is a limit of the law may be there.
    """
    for p in cause.parameters:
        if not p.fitted or p.name == cause.gain:
            continue
        low, high = (0.0, p.bounds[1]) if p.limit else p.bounds
        margin = 1e-3 * (high - low) if not p.log else 0.0
        value = values[p.name]
        if p.log and (value < 1.01 * low or value > high / 1.01):
            return False
        if not p.log and (value <= low + margin or value >= high - margin):
            return False
    return True


def near_end(values: Mapping[str, float], effect: Component) -> bool:
    """Whether a parameter of an effect, its gain and weights apart, is near an end of its range."""
    for p in effect.parameters:
        if not p.fitted or p.name in (effect.gain, *effect.linear):
            continue
        scale = np.log if p.log else float
        low, high, value = scale(p.bounds[0]), scale(p.bounds[1]), scale(values[p.name])
        if not _END < (value - low) / (high - low) < 1.0 - _END:
            return True
    return False
