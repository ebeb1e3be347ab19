"""What a search asks of the kind of device: any model, or a stack."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from psa_casadi.common.errors import PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.colour import Colour, noise_rms
from psa_casadi.diagnosis.noise import Omnibus, detection_limit_of, omnibus
from psa_casadi.diagnosis.screening import independent, without
from psa_casadi.diagnosis.task import Method, Thresholds, Tried, same_curves, shows_ringing
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.model.component import DISPLACEMENT_PEAKS, Component
from psa_casadi.records.drive import is_tone_separable
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.start import linear_part

#: Terms of a static curve.
_CURVE = 8
#: Damping ratio of a sharp resonance, and halves of its width within which a tone is its ringing.
_SHARP, _WIDTHS = 0.05, 2.0


class Pack:
    """Any model: several inputs and outputs, of which nothing else is known."""

    is_stack = False

    def tested(
        self, fit: Fit, residuals: Sequence[FloatArray], colour: Colour, limits: Thresholds,
        *, from_residual: bool,
    ) -> Omnibus:  # fmt: skip
        """Test the residual of every output along every input; the most significant one counts.

        With Bonferroni's correction for their number.
        """
        rows = []
        for f, left, noise in zip(fit.channels, residuals, colour.each, strict=True):
            time, inputs = [], []
            for k in f.records:
                e, at = fit.experiments[k], fit.experiments[k].at(f.number)
                time.append((e.record.time - e.record.time[0])[at])
                inputs.append(record_inputs(fit.model, e.record, e.record.n)[at])
            moving = [column for column in np.vstack(inputs).T if np.ptp(column) > 0]
            for along in moving or [np.zeros(len(left))]:
                result = omnibus(
                    left, along, np.concatenate(time), noise, noise_rms(f.residuals, noise),
                    lengths=f.lengths, detection_limit=f.straight, from_residual=from_residual,
                    alarms_below=limits.alarm,
                )  # fmt: skip
                rows.append(replace(result, output=f.column if fit.further else ""))
        p = min(1.0, len(rows) * min(r.p_value for r in rows))
        worst = min(rows, key=lambda r: (not r.alarm, r.p_value))
        corrected = worst.p_value * len(rows)
        return replace(worst, p_value=min(1.0, corrected if worst.alarm else p))

    def shows(self, fit: Fit, promise: float, test: Omnibus) -> bool:
        """Return whether what a direction promises to remove exceeds the detection limit."""
        return any(f.rms > f.straight for f in fit.channels)

    def exceeds_detection_limit(self, fit: Fit, before: Fit, removed: float, least: float) -> bool:
        """Return whether a fit removes more of another one's error than the detection limit."""
        pairs = zip(fit.channels, before.channels, strict=True)
        return any(old.rms**2 - new.rms**2 > new.straight**2 for new, old in pairs)

    def is_admissible(self, fit: Fit, cause: Component) -> bool:
        """Return whether the data ask for this effect and not for something else."""
        return cause.is_inside_ranges(fit.model.values)


class StackPack(Pack):
    """A stack: one voltage, a displacement and further columns."""

    is_stack = True

    def tested(
        self, fit: Fit, residuals: Sequence[FloatArray], colour: Colour, limits: Thresholds,
        *, from_residual: bool,
    ) -> Omnibus:  # fmt: skip
        """Test the displacement's residual, or that of a column where only this one alarms."""

        def test_of(
            residual: FloatArray, parts: Sequence[Experiment], of: Colour, least: float
        ) -> Omnibus:
            voltage, time = (
                np.concatenate([getattr(e.record, name)[e.used] for e in parts])
                for name in ("voltage", "time")
            )
            noise = noise_rms(residual, of)
            return omnibus(
                residual, voltage, time, of, noise,
                lengths=[int(e.used.sum()) for e in parts], detection_limit=least,
                from_residual=from_residual, alarms_below=limits.alarm,
            )  # fmt: skip

        experiments, (first, *others) = fit.experiments, residuals
        test = test_of(first, experiments, colour, detection_limit_of(fit, limits))
        for f, left, of in zip(fit.further, others, colour.further, strict=True):
            if test.alarm:
                break
            result = test_of(left, [experiments[k] for k in f.records], of, f.straight)
            p, least = min(1.0, result.p_value * (1 + len(fit.further))), test.detection_limit
            if result.alarm and p < limits.alarm:
                size = max(test.size, 2.0 * least)
                test = replace(result, p_value=p, size=size, detection_limit=least, output=f.column)
        return test

    def shows(self, fit: Fit, promise: float, test: Omnibus) -> bool:
        """Return whether the power [m^2] that a direction promises exceeds the detection limit."""
        return promise > test.detection_limit**2

    def exceeds_detection_limit(self, fit: Fit, before: Fit, removed: float, least: float) -> bool:
        """Return whether the `removed` power [m^2] exceeds that of the limit `least` [m]."""
        return removed > least**2

    def is_admissible(self, fit: Fit, cause: Component) -> bool:
        """Return whether the data ask for this effect and not for something else.

        Not with a parameter pushed to the end of its range, a tone among the harmonics of a
        periodic drive (a hum at the mains' frequency may lie between them), a hum where the stack
        itself rings, or a period over the displacement that fits into it less than twice.
        """
        values, tone, hum = fit.model.values, cause.tone, cause.belongs_to == "environment"
        records = [e.record for e in fit.experiments]
        widest = max(r.range_m for r in records)
        periods = [values[n] for n, grid in cause.probe.items() if grid == DISPLACEMENT_PEAKS]
        if any(period > 0.5 * widest for period in periods):
            return False
        if tone is not None:
            distinct = all(is_tone_separable(values[tone], r, hum=hum) for r in records)
            if not distinct or (hum and _rings_at(fit, values[tone])):
                return False
        return cause.is_inside_ranges(values)


#: The pack of a diagnosis of records that come without a user's model.
STACK = StackPack()


@dataclass(frozen=True)
class Task:
    """The effects to search, what knows the device, the method, and the observers.

    `watch` gets every hypothesis of the search, `keep` the best fit so far where a keyboard
    interrupt ends it; `hidden` is the share of the readings that a saturated sensor has made. Of a
    base that is known but for its parameters `free` only these are fitted.
    """

    table: tuple[Component, ...]
    pack: Pack
    method: Method = field(default_factory=Method)
    progress: Callable[[str], None] = lambda _: None
    keep: Callable[[Fit], None] = lambda _: None
    watch: Callable[[Tried], None] = lambda _: None
    hidden: float = 0.0
    free: tuple[str, ...] | None = None

    @property
    def limits(self) -> Thresholds:
        """The constants that decide."""
        return self.method.thresholds

    def is_fast(self, fit: Fit) -> bool:
        """Whether the device may ring within the band of a record of a fit."""
        return self.pack.is_stack and shows_ringing(fit.experiments)

    def indistinguishable(self, fit: Fit) -> tuple[tuple[str, ...], ...]:
        """Groups of effects that these records cannot separate but by forms nobody knows."""
        return same_curves(self.table, fit) if self.pack.is_stack else ()


def is_dynamic(added: Sequence[FloatArray], before: Fit, limits: Thresholds) -> bool:
    """Return whether what a memory adds (n,) is more than a curve of a stack's voltage.

    At most `static` of the power that the other's parameters cannot follow may be one. Elements
    that are wider than the voltage's way are such a curve.
    """
    change = np.concatenate([a[e.used] for a, e in zip(added, before.experiments, strict=True)])
    voltage = np.concatenate([e.record.voltage[e.used] for e in before.experiments])
    basis = independent(before.jacobian)
    target = without(change, basis)
    place = (voltage - voltage.min()) / max(float(np.ptp(voltage)), 1e-300)
    curves = np.cos(np.pi * np.outer(place, np.arange(1, _CURVE + 1)))
    static = independent(without(curves, basis)).T @ target
    return float(static @ static) < limits.static * float(target @ target)


def _rings_at(fit: Fit, frequency: float) -> bool:
    """Whether a frequency [Hz] lies within a sharp resonance of the fitted model."""
    try:
        poles = np.linalg.eigvals(linear_part(fit.model).a) / (2.0 * np.pi)
    except (PsaError, np.linalg.LinAlgError):
        return False
    sharp = np.abs(poles.real) < _SHARP * np.abs(poles)
    near = np.abs(np.abs(poles) - frequency) < _WIDTHS * np.abs(poles.real)
    return bool(np.any(sharp & near))
