"""Variants of the base fit: resonances and ringing.

After each step of the force a resonance rings, and what the samples show of it is a tone below half
the sampling rate f_s that decays as fast as the resonance, whatever the resonance's frequency: one
at f appears at |f - k f_s|. Any such tone adds, with unknown amplitude and phase,

    q_k = 2 Re(z) q_(k-1) - |z|^2 q_(k-2) + b_0 (F_k - F_(k-1)) + b_1 (F_(k-1) - F_(k-2)),
    z = exp((-2 pi d + 2 pi i f) / f_s)

to the prediction, F the force. The residual is projected on it for a grid of f and d, as in
`screening`, the fitted parameters' directions taken out.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.progress import Progress
from psa_casadi.common.units import FloatArray, IndexArray
from psa_casadi.diagnosis.colour import residual_colour
from psa_casadi.diagnosis.screening import independent, without
from psa_casadi.diagnosis.task import shows_ringing
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.mechanics import force_of, retuned, shortest_interval, without_blur
from psa_casadi.identification.refitting import quick_from, refit
from psa_casadi.identification.search import search
from psa_casadi.identification.start.ordinary import ordinary_values
from psa_casadi.identification.start.starting_points import linear_start, resolved
from psa_casadi.model.component import Component
from psa_casadi.records.noise import filtered
from psa_casadi.records.split import Experiment, fitted
from psa_casadi.simulation.side_by_side import side_by_side
from psa_casadi.simulation.timings import stage

#: Tones and decay rates that are tried, over the sampling rate.
_TONES, _DECAYS = np.arange(0.04, 0.501, 0.02), (0.03, 0.06, 0.12, 0.25)
#: Records whose sampling interval differs by this share do not contribute, nor those that gaps make
#: this many times as long as their samples.
_SAME, _LONGER = 0.01, 4.0
#: Multiple of the sampling rate about which a tone's resonance may lie at most.
_IMAGES = 2
#: Less than this of a column is rounding.
_NEW = 1e-7


@dataclass(frozen=True)
class Ringing:
    """A decaying tone in a residual.

    `tone` [Hz] and `decay` [Hz], damping ratio times frequency; `rate` of sampling [Hz];
    `decrease` of the whitened sum of squares over the noise's variance, two amplitudes being free.
    """

    tone: float
    decay: float
    rate: float
    decrease: float

    @property
    def resonances(self) -> tuple[tuple[float, float], ...]:
        """Frequencies [Hz] with damping ratios that appear at this tone when sampled."""
        return tuple((f, min(1.0, self.decay / f)) for f in images(self.tone, self.rate, _IMAGES))


def images(tone: float, rate: float, most: int) -> list[float]:
    """Return what appears at a tone f, |k f_s + f| and |k f_s - f| for k up to `most` [Hz].

    At half the sampling rate these are pairs, apart by rounding only.
    """
    result = {
        round(abs(k + sign * tone / rate), 9) for k in range(most + 1) for sign in (1.0, -1.0)
    }
    return [share * rate for share in sorted(result)]


def ringing(fit: Fit) -> Ringing | None:
    """Return the tone that explains most of a residual; None where no record can show one.

    The residual is whitened by an autoregression fitted to it, so that a tone has to follow the
    force to count: one that is there all the time counts as colour.
    """
    interval, experiments = shortest_interval(fit), fit.experiments
    forces = [
        None if e.held_out_whole else _force(fit, k, e, interval) for k, e in enumerate(experiments)
    ]
    if all(f is None for f in forces):
        return None
    colour = residual_colour(fit.record_residuals)
    basis = independent(colour.whiten(fit.jacobian))
    residual = without(colour.whiten(fit.residuals), basis)
    best: Ringing | None = None
    for tone in _TONES:
        columns = [_response(forces, experiments, interval, tone, d) for d in _DECAYS]
        free = without(colour.whiten(np.hstack(columns)), basis)
        for decay, pair in zip(_DECAYS, np.hsplit(free, len(_DECAYS)), strict=True):
            decrease = _explained(pair, residual) / colour.level**2
            if best is None or decrease > best.decrease:
                best = Ringing(float(tone) / interval, decay / interval, 1.0 / interval, decrease)
    return best


def _explained(columns: FloatArray, residual: FloatArray) -> float:
    """Return the decrease of a residual's (n,) sum of squares along two columns (n, 2).

    A sixth of the time of their orthonormal basis by `independent`. Of one in the other's
    direction, and of none, nothing counts.
    """
    value = 0.0
    first: FloatArray | None = None
    for column in np.ascontiguousarray(columns.T):
        size = float(np.linalg.norm(column))
        rest = column if first is None else column - (first @ column) * first
        norm = float(np.linalg.norm(rest))
        if norm > _NEW * size:
            first = rest / norm
            value += float(first @ residual) ** 2
    return value


def _force(fit: Fit, number: int, experiment: Experiment, interval: float) -> FloatArray | None:
    """Return a record's simulated force [N] from its first sample on, at even distances [s].

    None where the record is sampled at another rate, is mostly gaps, or cannot be simulated.
    """
    record = experiment.record
    count = _places(experiment, interval)[-1] + 1
    if abs(record.sample_time / interval - 1.0) > _SAME or count > _LONGER * record.n:
        return None
    try:
        force = force_of(fit, number, record)
    except PsaError:
        return None
    even = record.time[0] + interval * np.arange(count)
    change: FloatArray = np.interp(even, record.time, force - force[0])
    return change


def _places(experiment: Experiment, interval: float) -> IndexArray:
    """Return which of the even samples each sample of a record is, or is next to."""
    time = experiment.record.time
    indices: IndexArray = np.rint((time - time[0]) / interval).astype(np.int64)
    return indices


def _response(
    forces: Sequence[FloatArray | None],
    experiments: Sequence[Experiment],
    interval: float,
    tone: float,
    decay: float,
) -> FloatArray:
    """Return the two columns of a tone at the used samples; tone and decay over the rate."""
    z = np.exp(-2.0 * np.pi * decay + 2j * np.pi * tone)
    poles = [1.0, -2.0 * z.real, abs(z) ** 2]
    parts = []
    for force, e in zip(forces, experiments, strict=True):
        part = np.zeros((int(e.used.sum()), 2))
        if force is not None:
            where = _places(e, interval)[e.used]
            rung = filtered([1.0, -1.0], poles, force)
            part[:, 0] = rung[where]
            part[:, 1] = np.append(0.0, rung)[where]  # a sample later
        parts.append(part)
    return np.vstack(parts)


#: n ln(ratio of rms) by which a resonance of the stack may fall short of a further mode, and
#: of another effect.
_AS_GOOD, _LIKE = 10.0, 3.0
#: To what share of the rms one added to the causes must lead.
_MUCH = 0.985
#: n ln(ratio of rms) by which a fit with resonances must be better to count.
_CLEAR = 15.0
#: Multiple of the sampling rate about which the images of a mode's tone are tried at most.
_NEAR_IMAGES = 3
_QUICK, _FIRST, _BEST = 8, 4, 2
#: How far above what is of use the cost after the first evaluations may be.
_HOPEFUL = 2.0
#: A search for resonances restarts from elsewhere where its mean weighted square exceeds this.
_AGAIN = 1.5
#: Sampling rate [Hz] from which a stack's resonances may show though they lie above the band; the
#: decrease of the whitened sum of squares from which ringing is detected, and resonances at most.
_SHOWS, LEAST_DECREASE, _RESONANCES = 300.0, 40.0, 2


@stage("base fit again")
def from_resonances(base: Fit, progress: Progress) -> Fit | None:
    """Fit the base from resonances and lags that fast records show; None if none explain more.

    Ordinary lags lead nowhere for a stack that rings within the record's band. The search starts
    with an ordinary loop and, while it misses something, with that of the base.
    """
    if "k_P" not in base.model.values:
        return None
    records = [e.record for e in fitted(base.experiments)]
    progress("resonances and lags")
    linear = linear_start(records, base.model.values)
    if not resolved(base.model, linear, shortest_interval(base)):
        return None
    ordinary = base.model.with_values(ordinary_values(base.model, records))
    best = base
    for model in (ordinary, base.model):
        with suppress(PsaError):
            searched = search(model, base.experiments, linear=linear, progress=progress).best
            best = min(best, searched, key=lambda f: f.rms)
            if searched.cost < _AGAIN * len(searched.residuals):
                break
    return best if _short(base, best) > _CLEAR else None


@stage("base fit again")
def from_band(before: Fit, progress: Progress) -> Fit | None:
    """Fit with resonances near or above the band; None where none explains much more.

    Steps excite such a resonance, and what a slow record shows of its ringing looks like noise
    after each step. `before` may hold causes; the mechanics is sought again where it holds none.
    """
    result = before
    for _ in range(_RESONANCES):
        more = _with_ringing(result, progress, LEAST_DECREASE)
        if more is None:
            break
        result = more
    if result.rms > _MUCH * before.rms:
        return None
    return result if before.model.effects else _tuned(result, progress)


@stage("base fit again")
def instead_of_mode(before: Fit, mode: Component, fit: Fit, progress: Progress) -> Fit | None:
    """Fit with a resonance of the stack in the place of the further mode in `fit`.

    `before` is the model to which the mode was added. A stack that rings near the sampling rate
    shows a tone at one of its images, |k f_s + f| and |k f_s - f|, which decays as fast: its
    damping ratio times its frequency is the same. None where no mass explains the data about as
    well as the mode.
    """
    progress("base fit, mode as resonance")
    values = fit.model.values
    tone, damping = values[mode.tone or ""], values["mode_damping"]
    rate = 1.0 / shortest_interval(fit)
    near = images(tone, rate, _NEAR_IMAGES)
    starts = [m for f in near for m in _masses(before.model.values, [f], damping * tone / f)]
    return _with_masses(before, starts, _as_good(fit, _AS_GOOD))


@stage("base fit again")
def instead_of(base: Fit, fit: Fit, progress: Progress, other: Fit | None = None) -> Fit | None:
    """Fit the base with its resonances in the place of the effect in `fit`.

    None where no masses explain the data about as well as the effect. A resonance above the band
    delays what is within it, as a lag would; two within it that a fit has mistaken for others leave
    what looks like a further mode. The `other` base has resonances that the records show.
    """
    if other is not None and _short(other, fit) < _LIKE:
        return other
    rung = _with_ringing(base, progress, least=_as_good(fit, _LIKE))
    if rung is not None and _short(rung, fit) < _LIKE:
        return _tuned(rung, progress)
    if not shows_ringing(base.experiments):
        return None
    again = retuned(base, progress, reached=fit.rms)
    if _short(base, again) <= _CLEAR:
        return None
    return without_blur(again) if _short(again, fit) < _LIKE else None


def rings(effect: Component) -> bool:
    """Whether an effect is a further resonance of the plant."""
    return effect.tone is not None and effect.belongs_to == "plant"


def _tuned(fit: Fit, progress: Progress) -> Fit:
    """Return the fit with its mechanics sought again while it rings; k_P is free if determined."""
    left = ringing(fit)
    if left is None or left.decrease >= LEAST_DECREASE:
        fit = retuned(fit, progress)
    return without_blur(fit)


def _short(fit: Fit, other: Fit) -> float:
    """Return n ln(rms of a fit / rms of another one)."""
    return len(other.residuals) * float(np.log(fit.rms / other.rms))


def _as_good(other: Fit, short: float) -> float:
    """Return the rms [m] that falls short of another fit's by n ln(ratio of rms) = `short`."""
    return other.rms * float(np.exp(short / len(other.residuals)))


def _with_ringing(
    fit: Fit, progress: Progress, value: float = 0.0, least: float = np.inf
) -> Fit | None:
    """Fit with a mass free, from the resonances that the residual's ringing may be of.

    None where it shows less than `value`, a decrease of the whitened sum of squares, or where none
    explains clearly more, down to the rms `least` [m]. A mass that is free already is tried
    elsewhere, too.
    """
    rate = 1.0 / shortest_interval(fit)
    if rate <= _SHOWS:
        return None
    tone = ringing(fit)
    if tone is None or tone.decrease < value:
        return None
    progress(f"base fit, resonance at {tone.tone:.3g} Hz")
    starts = [m for f, z in tone.resonances for m in _masses(fit.model.values, [f], z)]
    return _with_masses(fit, starts, least)


def _masses(
    p: Mapping[str, float], frequencies: Sequence[float], damping: float
) -> Iterator[dict[str, float]]:
    """Yield mass and damping of wafers or bonding layers for resonances [Hz] at a damping ratio."""
    for part in ("_P", "_B") if "k_B" in p else ("",):
        for frequency in frequencies:
            mass = p[f"k{part}"] / (2.0 * np.pi * frequency) ** 2
            lost = 2.0 * damping * float(np.sqrt(mass * p[f"k{part}"]))
            yield {f"m{part}": mass, f"c{part}": lost}


def _with_masses(
    before: Fit, starts: Sequence[Mapping[str, float]], least: float = np.inf
) -> Fit | None:
    """Fit with one mass free from several starts; None where none explains clearly more.

    None as well where no rms comes near the `least` that is of use [m].
    """
    least = min(least, before.rms * float(np.exp(-_CLEAR / len(before.residuals))))

    def fit_from(start: Mapping[str, float]) -> Fit | None:
        free = [*before.unknowns.names, *(n for n in start if n not in before.unknowns.names)]
        return quick_from(
            before, before.model, free,
            start_states=before.starts(), evaluations=_FIRST, start=start,
        )  # fmt: skip

    def further(quick: Fit) -> Fit | None:
        return quick_from(
            quick, quick.model, quick.unknowns.names,
            start_states=quick.starts(), evaluations=_QUICK,
        )  # fmt: skip

    limit = _HOPEFUL * before.cost * (least / before.rms) ** 2
    hopeful = [f for f in side_by_side(fit_from, starts) if f is not None and f.cost < limit]
    ended = side_by_side(further, sorted(hopeful, key=lambda f: f.cost)[:_BEST])
    best = min((f for f in ended if f is not None), key=lambda f: f.cost, default=None)
    if best is None:
        return None
    try:
        final = refit(best, least=least)
    except PsaError:
        return None
    return final if _short(before, final) > _CLEAR else None
