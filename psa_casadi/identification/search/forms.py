"""Which form of the hysteresis the records prefer."""

from collections.abc import Sequence

import numpy as np

from psa_casadi.errors import PsaError
from psa_casadi.identification.fitting.fit import Fit
from psa_casadi.identification.refitting import Progress, record_rms
from psa_casadi.identification.search.multistart import Search, search
from psa_casadi.identification.start.linear import LinearCandidate
from psa_casadi.identification.start.ordinary import FORMS
from psa_casadi.model.compose import Model
from psa_casadi.records.split import Experiment

_LABELS = {FORMS["bouc-wen"].name: "Bouc-Wen", FORMS["spectrum"].name: "a spectrum of elements"}


def search_forms(
    models: Sequence[Model],
    experiments: Sequence[Experiment],
    *,
    linear: Sequence[LinearCandidate] = (),
    thorough: bool = False,
    progress: Progress = lambda _: None,
) -> tuple[Search, str]:
    """Search from each model, and return the search that the records prefer, and why in words.

    That of the smaller Schwarz criterion, sum_r n_r ln S_r + k ln n: S_r the mean square of record
    r's residual, k the parameters, n the samples (Schwarz, Annals of Statistics 6 (1978) 461). The
    words are empty for one model. Raises PsaError where no model can be fitted.
    """
    found: list[Search] = []
    failed: list[PsaError] = []
    for model in models:
        try:
            one = search(model, experiments, linear=linear, thorough=thorough, progress=progress)
        except PsaError as error:
            failed.append(error)
            continue
        found.append(one)
        if one.best.interrupted:
            break
    if not found:
        raise failed[0]
    ranked = sorted(found, key=lambda s: _criterion(s.best, experiments))
    if len(ranked) < 2:
        return ranked[0], ""
    (form, rms), (other, more) = ((_form(s.best), 1e9 * s.best.rms) for s in ranked)
    return ranked[0], (
        f"hysteresis: {form}, which leaves {rms:.3g} nm rms; {other} would leave {more:.3g} nm."
    )


def _form(found: Fit) -> str:
    return next(_LABELS[c.name] for c in found.model.components if c.name in _LABELS)


def _criterion(found: Fit, experiments: Sequence[Experiment]) -> float:
    samples = [int(e.used.sum()) for e in experiments]
    levels = record_rms(found, experiments)
    likely = sum(n * np.log(level**2) for n, level in zip(samples, levels, strict=True))
    return float(likely + len(found.unknowns.names) * np.log(sum(samples)))
