"""The records of models that are no stacks, as what pictures need: one series for every output."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from psa_casadi.any_model.identify import OdeIdentification
from psa_casadi.any_model.result import OdeDiagnosis
from psa_casadi.any_model.runs import Run, noise_share, varied
from psa_casadi.model.compose import Model
from psa_casadi.report.words.phrases import in_brackets
from psa_casadi.report.words.series import BASE_COLOUR, EXTENDED_COLOUR, Curve, FloatArray, Series
from psa_casadi.report.words.verdict_words import added

#: Readings that an output must have in a record to be a series.
_FEWEST = 8


def own_series(d: OdeDiagnosis) -> tuple[Series, ...]:
    """Return every measured output of every record, with the base and the extended model."""
    noise = {e.output: e.noise for e in d.errors}
    curves = [("base model", BASE_COLOUR, d.base)]
    if added(d):
        curves.append(("extended model", EXTENDED_COLOUR, d.extended))
    return tuple(_series(d.model, d.runs, noise, curves))


def own_fit_series(found: OdeIdentification) -> tuple[Series, ...]:
    """Return every measured output of every record, with the fitted model."""
    predicted = found.fit.predicted(found.runs)
    curves = [("model", EXTENDED_COLOUR, predicted)]
    return tuple(_series(found.model, found.runs, found.noise, curves))


def _series(
    model: Model,
    runs: Sequence[Run],
    noise: Mapping[str, float],
    curves: Sequence[tuple[str, str, Sequence[FloatArray]]],
) -> Iterator[Series]:
    outputs = model.structure.outputs
    shares = [noise_share(runs, k) if o.name in noise else 1.0 for k, o in enumerate(outputs)]
    for i, run in enumerate(runs):
        moving = varied(run)
        inputs = model.structure.inputs
        against = "" if moving is None else in_brackets(inputs[moving].name, inputs[moving].unit)
        for k, o in enumerate(outputs):
            if o.name not in noise or np.isfinite(run.outputs[:, k]).sum() < _FEWEST:
                continue
            yield Series(
                name=run.name if len(noise) == 1 else f"{o.name} of {run.name}",
                time=run.time,
                voltage=np.zeros(len(run.time)) if moving is None else run.inputs[:, moving],
                measured=run.outputs[:, k],
                curves=tuple(Curve(name, c, y[i][:, k]) for name, c, y in curves),
                held_out=run.judged(k),
                noise=noise[o.name] * float(run.noise[k]) / shares[k],
                counts=False,
                quantity=o.name,
                unit=o.unit or "1",
                against=against,
            )
