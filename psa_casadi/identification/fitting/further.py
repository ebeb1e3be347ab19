"""Channels beside the first that are fitted as outputs: a stack's current, charge and so on.

A channel may have an offset in each record and factors for what it shows, the same in all records;
both are linear, so that they are projected out of the residual instead of being searched (variable
projection; Golub and Pereyra 1973, with the Jacobian of Kaufman 1975).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.identification.fitting.prediction import Prediction
from psa_casadi.model.compose import Model
from psa_casadi.notes import Note, note
from psa_casadi.records.split import Channel, Experiment
from psa_casadi.units import FloatArray


@dataclass(frozen=True, eq=False)
class Further:
    """The fit of one channel, in its unit; samples of all records that have it, stacked.

    `residuals` (n,) are measured minus predicted; `jacobian` (n, size) d prediction / d theta, both
    over the records' shares of the noise, and without what offsets and factors can follow: `basis`
    (n, k) is orthonormal. `factors` belong to the outputs, `level` weighted the channel, `spread`
    is its size (`Channel`), `lengths` are the samples of each of the `records`, of which `number`
    is the place among the channels.
    """

    channel: Channel
    number: int
    level: float
    spread: float
    residuals: FloatArray
    jacobian: FloatArray
    basis: FloatArray
    factors: FloatArray
    lengths: tuple[int, ...]
    records: tuple[int, ...]

    @property
    def column(self) -> str:
        """Name of the column."""
        return self.channel.column

    @property
    def parts(self) -> list[FloatArray]:
        """The residuals of each of the `records`."""
        return np.split(self.residuals, np.cumsum(self.lengths)[:-1])

    def left_of(self, change: FloatArray) -> FloatArray:
        """Return what offsets and factors leave of a change of the prediction (n,)."""
        left: FloatArray = change - self.basis @ (self.basis.T @ change)
        return left

    @property
    def straight(self) -> float:
        """Rms error below which nothing is known of the channel, in its unit."""
        return self.channel.straight * self.spread

    def relevelled(self) -> Channel:
        """Return the channel with what the fit leaves as its noise level."""
        return replace(self.channel, level=max(self.rms, self.straight))

    @property
    def notes(self) -> tuple[Note, ...]:
        """What is left of the column, and what is odd about it."""
        unit, share = self.channel.unit, 100.0 * self.rms / max(self.spread, 1e-300)
        named = "" if unit == "1" else f" {unit}"
        left = note("column", column=self.column, rms=self.rms, unit=named, share=share)
        return left, *self.turned

    @property
    def turned(self) -> tuple[Note, ...]:
        """Say so where a column falls while what it shows rises."""
        falls = self.channel.scale is None and self.factors[0] < 0.0
        return (note("turned_column", column=self.column),) if falls else ()

    @property
    def rms(self) -> float:
        """Root mean square of the residuals."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def further_of(
    experiments: Sequence[Experiment], predictions: Sequence[Prediction]
) -> tuple[Further, ...]:
    """Return the fit of every further channel from what a model shows in the records' used samples.

    The predictions hold the further channels' outputs.
    """
    channels = experiments[0].further if experiments else ()
    return tuple(_fitted(k, experiments, predictions) for k, _ in enumerate(channels, 1))


def _fitted(
    number: int, experiments: Sequence[Experiment], predictions: Sequence[Prediction]
) -> Further:
    """Return the fit of one channel; offsets and factors are projected out where it is free."""
    channel = experiments[0].channels[number]
    at = {k: e.at(number) for k, e in enumerate(experiments)}
    records = tuple(k for k, item in at.items() if item.any())
    shares = [experiments[k].share(number) for k in records]
    lengths = tuple(int(np.count_nonzero(at[k])) for k in records)
    target = np.concatenate(
        [experiments[k].measured(number)[at[k]] / s for k, s in zip(records, shares, strict=True)]
    )

    def shown(name: str, part: int) -> FloatArray:
        rows = zip(records, shares, strict=True)
        return np.concatenate(
            [predictions[k].further[name][part][at[k][: experiments[k].stop]] / s for k, s in rows]
        )

    values = np.column_stack([shown(name, 0) for name in channel.outputs])
    slopes = [shown(name, 1) for name in channel.outputs]
    factors, basis = np.ones(1), np.zeros((len(target), 0))
    if channel.offset:
        values, target = _centred(values, lengths), _centred(target, lengths)
        basis = np.zeros((len(target), len(lengths)))
        for k, last in enumerate(np.cumsum(lengths)):
            basis[last - lengths[k] : last, k] = 1.0 / np.sqrt(lengths[k])
    if channel.factors:
        size = np.maximum(np.linalg.norm(values, axis=0), 1e-300)
        factors = np.linalg.lstsq(values / size, target, rcond=1e-10)[0] / size
        u, s, _ = np.linalg.svd(values / size, full_matrices=False)
        basis = np.hstack([basis, u[:, s > 1e-10 * max(float(s[0]), 1e-300)]])
        left = target - basis @ (basis.T @ target)
        spread = float(np.sqrt(np.mean(target**2)))
    else:
        left, spread = target - values[:, 0], span_of(experiments, number)
    moved = sum(f * item for f, item in zip(factors, slopes, strict=True))
    moved = moved - basis @ (basis.T @ moved)
    return Further(
        channel=channel, number=number, level=channel.level, spread=spread, residuals=left,
        jacobian=moved, basis=basis, factors=factors, lengths=lengths, records=records,
    )  # fmt: skip


def span_of(experiments: Sequence[Experiment], number: int) -> float:
    """Return the range of a channel's readings over the fitted samples of all records."""
    parts = [e.measured(number)[e.at(number)] for e in experiments]
    return float(np.ptp(np.concatenate(parts))) if any(p.size for p in parts) else 0.0


def scaled(model: Model, furthers: Sequence[Further]) -> tuple[Model, tuple[Further, ...]]:
    """Return a model whose sensors have the scales that were found, and the factors beside it."""
    values, others = {}, []
    for each in furthers:
        name, factors = each.channel.scale, each.factors
        if name is not None and factors[0] != 0.0:
            low, high = model.parameter(name).bounds
            values[name] = float(np.clip(factors[0] * model.values[name], low, high))
            factors = factors * model.values[name] / values[name]
        others.append(replace(each, factors=factors))
    return model.with_values(values), tuple(others)


def predicted_further(
    experiments: Sequence[Experiment], predictions: Sequence[Prediction], fitted: Further
) -> dict[int, FloatArray]:
    """Return a further channel of whole records (n,) as predicted, by the index of the record.

    Factors are those of the fit, offsets those of the known samples. The predictions are those of
    whole records, with the further channels' outputs.
    """
    table = {}
    for k, (e, p) in enumerate(zip(experiments, predictions, strict=True)):
        known = e.at(fitted.number, e.known)
        if not known.any():
            continue
        rows = zip(fitted.factors, fitted.channel.outputs, strict=True)
        total = sum((f * p.further[name][0] for f, name in rows), np.zeros(e.record.n))
        if fitted.channel.offset:
            total = total + np.mean((e.measured(fitted.number) - total)[known])
        table[k] = total
    return table


def _centred(values: FloatArray, lengths: Sequence[int]) -> FloatArray:
    """Return values (n,) or columns less their mean in every record."""
    parts = np.split(values, np.cumsum(lengths)[:-1])
    return np.concatenate([part - np.mean(part, axis=0) for part in parts])
