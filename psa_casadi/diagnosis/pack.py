"""What a search asks of the kind of device: any model, or a stack."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from psa_casadi.component import DISPLACEMENT_PEAKS, Component
from psa_casadi.diagnosis.colour import Colour, noise_rms
from psa_casadi.diagnosis.noise import knowable_of, known_colour
from psa_casadi.diagnosis.omnibus import Omnibus, omnibus
from psa_casadi.diagnosis.own_colour import OwnColour
from psa_casadi.diagnosis.process_noise import entering
from psa_casadi.diagnosis.screening import independent, without
from psa_casadi.diagnosis.task import Method, Thresholds, Tried, same_curves, shows_ringing
from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.refitting import relevelled
from psa_casadi.records.drive import is_tone_separable
from psa_casadi.records.split import Experiment
from psa_casadi.simulation.simulate import record_inputs
from psa_casadi.simulation.start import linear_part
from psa_casadi.units import FloatArray

#: Terms of a static curve.
_CURVE = 8
#: Damping ratio of a sharp resonance, and halves of its width within which a tone is its ringing.
_SHARP, _WIDTHS = 0.05, 2.0


@dataclass(frozen=True)
class Pack:
    """Any model: several inputs and outputs, of which nothing else is known.

    Where noise of some colour tells the residual of its base, it `asks_effects` for what one of
    them would lower.
    """

    asks_effects: bool = True

    def fast(self, experiments: Sequence[Experiment]) -> bool:
        """Return whether the device may ring within a record's band."""
        return False

    def alike(
        self, experiments: Sequence[Experiment], table: Sequence[Component], fit: Fit
    ) -> tuple[tuple[str, ...], ...]:
        """Return groups of effects that these records cannot tell apart but by unknown forms."""
        return ()

    def colours(
        self, fit: Fit, experiments: Sequence[Experiment]
    ) -> list[FloatArray | None] | None:
        """Return the colour of every record's noise where it is known without a model."""
        return None

    def tested(
        self, fit: Fit, residuals: Sequence[FloatArray], experiments: Sequence[Experiment],
        colour: Colour, limits: Thresholds, *, own: bool,
    ) -> Omnibus:  # fmt: skip
        """Test the residual of every output along every input; the most telling one counts.

        With Bonferroni's correction for their number.
        """
        rows = []
        for f, left, noise in zip(fit.channels, residuals, colour.each, strict=True):
            time, inputs = [], []
            for k in f.records:
                e, at = experiments[k], experiments[k].at(f.number)
                time.append((e.record.time - e.record.time[0])[at])
                inputs.append(record_inputs(fit.model, e.record, e.record.n)[at])
            moving = [column for column in np.vstack(inputs).T if np.ptp(column) > 0]
            for along in moving or [np.zeros(len(left))]:
                result = omnibus(
                    left, along, np.concatenate(time), noise, noise_rms(f.residuals, noise),
                    lengths=f.lengths, knowable=f.straight, own=own, alarms_below=limits.alarm,
                )  # fmt: skip
                rows.append(replace(result, output=f.column if fit.further else ""))
        p = min(1.0, len(rows) * min(r.p_value for r in rows))
        worst = min(rows, key=lambda r: (not r.alarm, r.p_value))
        output = worst.p_value * len(rows)
        return replace(worst, p_value=min(1.0, output if worst.alarm else p))

    def shows(self, fit: Fit, promise: float, test: Omnibus) -> bool:
        """Return whether what a direction promises to remove can be told of the device."""
        return any(f.rms > f.straight for f in fit.channels)

    def told(self, fit: Fit, before: Fit, removed: float, knowable: float) -> bool:
        """Return whether a fit removes more of another one's error than what cannot be told."""
        pairs = zip(fit.channels, before.channels, strict=True)
        return any(old.rms**2 - new.rms**2 > new.straight**2 for new, old in pairs)

    def in_character(self, fit: Fit, cause: Component, experiments: Sequence[Experiment]) -> bool:
        """Return whether the data ask for this effect and not for something else."""
        return cause.is_inside_ranges(fit.model.values)

    def remembers(
        self, added: Sequence[FloatArray], before: Fit, experiments: Sequence[Experiment],
        limits: Thresholds,
    ) -> bool:  # fmt: skip
        """Return whether what a memory adds (n,) is more than a static curve of an input."""
        return True

    def entering(
        self, fit: Fit, experiments: Sequence[Experiment], arrays: Sequence[FloatArray],
        item: tuple[OwnColour, ...],
    ) -> tuple[OwnColour, ...]:  # fmt: skip
        """Return the noise of every channel, where it enters the model if that is likelier."""
        return tuple(
            entering(
                fit, experiments,
                [e.errors(f.number, y[:, k]) for e, y in zip(experiments, arrays, strict=True)],
                k, colour,
            )
            for k, (f, colour) in enumerate(zip(fit.channels, item, strict=True))
        )  # fmt: skip

    def ended(self, fit: Fit, experiments: Sequence[Experiment]) -> Fit:
        """Return a fit at its end, with the noise that it leaves of every output."""
        return relevelled(fit, experiments, every=True)[0]


@dataclass(frozen=True)
class StackPack(Pack):
    """A stack: one voltage, a displacement and columns beside it."""

    asks_effects: bool = False

    def fast(self, experiments: Sequence[Experiment]) -> bool:
        """Return whether a stack may ring within a record's band."""
        return shows_ringing(experiments)

    def alike(
        self, experiments: Sequence[Experiment], table: Sequence[Component], fit: Fit
    ) -> tuple[tuple[str, ...], ...]:
        """Return groups of effects that bend the same curve."""
        return same_curves(experiments, table, fit)

    def colours(
        self, fit: Fit, experiments: Sequence[Experiment]
    ) -> list[FloatArray | None] | None:
        """Return the colour of every record's noise where repeats tell it."""
        residuals = fit.residuals_of(experiments)
        return [known_colour(e.record, r) for e, r in zip(experiments, residuals, strict=True)]

    def tested(
        self, fit: Fit, residuals: Sequence[FloatArray], experiments: Sequence[Experiment],
        colour: Colour, limits: Thresholds, *, own: bool,
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
                lengths=[int(e.used.sum()) for e in parts], knowable=least, own=own,
                alarms_below=limits.alarm,
            )  # fmt: skip

        first, *others = residuals
        test = test_of(first, experiments, colour, knowable_of(fit, experiments, limits))
        for f, left, of in zip(fit.further, others, colour.further, strict=True):
            if test.alarm:
                break
            result = test_of(left, [experiments[k] for k in f.records], of, f.straight)
            p = min(1.0, result.p_value * (1 + len(fit.further)))
            if result.alarm and p < limits.alarm:
                size = max(test.size, 2.0 * test.knowable)
                test = replace(
                    result, p_value=p, size=size, knowable=test.knowable, output=f.column
                )
        return test

    def shows(self, fit: Fit, promise: float, test: Omnibus) -> bool:
        """Return whether the power [m^2] that a direction promises to remove can be told."""
        return promise > test.knowable**2

    def told(self, fit: Fit, before: Fit, removed: float, knowable: float) -> bool:
        """Return whether more power is removed [m^2] than can be told."""
        return removed > knowable**2

    def in_character(self, fit: Fit, cause: Component, experiments: Sequence[Experiment]) -> bool:
        """Return whether the data ask for this effect and not for something else.

        Not with a parameter pushed to the end of its range, a tone among the harmonics of a
        periodic drive (a hum at the mains' frequency may lie between them), a hum where the stack
        itself rings, or a period over the displacement that fits into it less than twice.
        """
        values = fit.model.values
        widest = max(e.record.range_m for e in experiments)
        periods = [values[n] for n, grid in cause.probe.items() if grid == DISPLACEMENT_PEAKS]
        if any(period > 0.5 * widest for period in periods):
            return False
        tone = cause.tone
        hum = cause.belongs_to == "environment"
        if tone is not None and not all(
            is_tone_separable(values[tone], e.record, hum=hum) for e in experiments
        ):
            return False
        if tone is not None and hum and _rings_at(fit, values[tone]):
            return False
        return cause.is_inside_ranges(values)

    def remembers(
        self, added: Sequence[FloatArray], before: Fit, experiments: Sequence[Experiment],
        limits: Thresholds,
    ) -> bool:  # fmt: skip
        """Return whether what a memory adds is more than a curve of the voltage.

        At most `static` of the power that the other's parameters cannot follow may be one. Elements
        that are wider than the voltage's way are such a curve.
        """
        change = np.concatenate([a[e.used] for a, e in zip(added, experiments, strict=True)])
        voltage = np.concatenate([e.record.voltage[e.used] for e in experiments])
        basis = independent(before.jacobian)
        target = without(change, basis)
        place = (voltage - voltage.min()) / max(float(np.ptp(voltage)), 1e-300)
        curves = np.cos(np.pi * np.outer(place, np.arange(1, _CURVE + 1)))
        static = independent(without(curves, basis)).T @ target
        return float(static @ static) < limits.static * float(target @ target)

    def entering(
        self, fit: Fit, experiments: Sequence[Experiment], arrays: Sequence[FloatArray],
        item: tuple[OwnColour, ...],
    ) -> tuple[OwnColour, ...]:  # fmt: skip
        """Return the noise as it is: that of any colour is the sensor's."""
        return item

    def ended(self, fit: Fit, experiments: Sequence[Experiment]) -> Fit:
        """Return the fit as it is: levels of columns are those of the base."""
        return fit


#: The stack of a diagnosis of records that come without a model of one's own.
STACK = StackPack()


@dataclass(frozen=True)
class Task:
    """The records, the effects to search, what knows the device, the method, and who is told.

    `watch` gets every hypothesis of the search, `keep` the best fit so far where a keyboard
    interrupt ends it; `hidden` is the share of the readings that a saturated sensor has made. Of a
    base that is known but for its parameters `free` only these are fitted.
    """

    experiments: tuple[Experiment, ...]
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

    @property
    def fast(self) -> bool:
        """Whether the device may ring within a record's band."""
        return self.pack.fast(self.experiments)

    def alike(self, fit: Fit) -> tuple[tuple[str, ...], ...]:
        """Groups of effects that these records cannot tell apart but by forms nobody knows."""
        return self.pack.alike(self.experiments, self.table, fit)


def _rings_at(fit: Fit, frequency: float) -> bool:
    """Whether a frequency [Hz] lies within a sharp resonance of the fitted model."""
    try:
        poles = np.linalg.eigvals(linear_part(fit.model).a) / (2.0 * np.pi)
    except (PsaError, np.linalg.LinAlgError):
        return False
    sharp = np.abs(poles.real) < _SHARP * np.abs(poles)
    near = np.abs(np.abs(poles) - frequency) < _WIDTHS * np.abs(poles.real)
    return bool(np.any(sharp & near))
