"""Identify a stack from records: start, several shapes of loop, what can be told besides."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from psa_casadi.errors import PsaError
from psa_casadi.experiment.record import Record
from psa_casadi.experiment.split import Experiment, whole
from psa_casadi.identification.determinacy import Determinacy, determinacy
from psa_casadi.identification.fit import FIT_RTOL, Fit, fit
from psa_casadi.identification.noise import high_frequency_noise
from psa_casadi.identification.prediction import measured, predict
from psa_casadi.identification.starting import loop_starts, starting_model
from psa_casadi.identification.unknowns import unknowns_of
from psa_casadi.model.compose import Model
from psa_casadi.variables import Provenance
from psa_casadi.version import __version__

#: Parameters that voltage and displacement determine in every record with loops.
CORE = ("k_L", "A", "beta", "gamma", "delta", "n", "tau", "R_s", "c_P", "c_B", "c")
#: Parameters that only fast records determine; each pair is freed when the data can tell it.
FAST = (("m_P",), ("m_B",), ("m",))
_QUICK = 12
_AGREE = 1.02

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Identification:
    """An identified model with the fit behind it, what the data determine, and warnings."""

    model: Model
    fit: Fit
    determinacy: Determinacy
    experiments: tuple[Experiment, ...]
    warnings: tuple[str, ...]


def identify(
    records: Sequence[Record],
    *,
    model: Model | None = None,
    stiffness: float | None = None,
    progress: Progress = lambda _: None,
) -> Identification:
    """Fit the base model, or `model`, to all samples of all records.

    `stiffness` is the free stack's stiffness [N/m] from a data sheet; without it forces keep the
    scale of an assumed stiffness, and the model says so. Raises InputError, SimulationError.
    """
    experiments = tuple(whole(r) for r in records)
    start = model or starting_model(records, stiffness)
    best = fit_base(start, experiments, progress=progress)
    found = determinacy(best)
    given = stiffness is not None or (model is not None and model.provenance.force_scale == "given")
    return Identification(
        model=with_provenance(best.model, found, records, given),
        fit=best,
        determinacy=found,
        experiments=experiments,
        warnings=_warnings(best, found),
    )


def with_provenance(
    model: Model, found: Determinacy, records: Sequence[Record], stiffness_given: bool
) -> Model:
    """Return a fitted model that says from which records it comes and how sure its values are."""
    provenance = Provenance(
        identified_from=tuple((r.name, r.sha256) for r in records),
        package_version=version(),
        free=found.names,
        intervals=found.intervals,
        force_scale="given" if stiffness_given else "assumed",
        notes=() if stiffness_given else (FORCE_NOTE,),
    )
    return replace(model, provenance=provenance)


FORCE_NOTE = (
    "Force scale assumed: voltage and displacement determine the displacement only. Forces, masses"
    " and stiffnesses are right in proportion, not in size; give a stiffness to fix them."
)


def noise_levels(experiments: Sequence[Experiment]) -> list[float]:
    """Return the white noise of every record's displacement [m], from its fast differences."""
    levels = []
    for e in experiments:
        y = measured(e.record)[e.used]
        levels.append(max(high_frequency_noise(y), 1e-6 * float(np.ptp(y)), 1e-15))
    return levels


def free_parameters(model: Model) -> list[str]:
    """Return the core parameters and those of the model's effects (units of time excepted)."""
    effects = [p.name for c in model.effects for p in c.parameters if p.name not in FIXED]
    return [n for n in CORE if n in model.values] + effects


#: Parameters of effects that only set a scale and are never searched.
FIXED = frozenset({"drift_span"})


def fit_base(
    model: Model,
    experiments: Sequence[Experiment],
    *,
    starts: Sequence[dict[str, float]] | None = None,
    progress: Progress = lambda _: None,
) -> Fit:
    """Fit the core parameters from several shapes of loop, then whatever else the data can tell."""
    free = free_parameters(model)
    sigma = noise_levels(experiments)
    candidates: list[Fit] = []
    for index, start in enumerate(starts if starts is not None else loop_starts(model)):
        progress(f"base fit, start {index + 1}")
        try:
            candidates.append(
                fit(
                    model,
                    experiments,
                    free,
                    sigma=sigma,
                    start=start,
                    evaluations=_QUICK,
                    rtol=1e-4,
                )
            )
        except PsaError:
            continue
    if not candidates:
        raise PsaError(
            "The base model could not be simulated from any start; the voltage's unit or the"
            " displacement's sign is the likely cause: check the record."
        )
    candidates.sort(key=lambda f: f.cost)
    progress("base fit, final")
    polished = refit(candidates[0], experiments, free)
    for other in candidates[1:2]:
        if other.cost < _AGREE * candidates[0].cost:
            rival = refit(other, experiments, free)
            polished = min(polished, rival, key=lambda f: f.cost)
    return _with_fast(polished, experiments, free)


def refit(previous: Fit, experiments: Sequence[Experiment], free: Sequence[str]) -> Fit:
    """Continue a fit from where it stands, with the noise level its residuals suggest."""
    sigma = _residual_noise(previous, experiments)
    memory = [previous.memory(r) for r in range(len(experiments))]
    return fit(previous.model, experiments, free, sigma=sigma, start_memory=memory, evaluations=60)


def _residual_noise(previous: Fit, experiments: Sequence[Experiment]) -> list[float]:
    levels, first = [], 0
    for e in experiments:
        count = int(e.used.sum())
        levels.append(high_frequency_noise(previous.residuals[first : first + count]))
        first += count
    return [max(s, 1e-15) for s in levels]


def _with_fast(best: Fit, experiments: Sequence[Experiment], free: list[str]) -> Fit:
    """Free the fast parameters that these records can tell, if that lowers the cost clearly."""
    available = [g for g in FAST if all(n in best.model.values for n in g)]
    told = [n for group in available if _can_tell(best, experiments, free, group) for n in group]
    if not told:
        return best
    memory = [best.memory(r) for r in range(len(experiments))]
    try:
        wider = fit(best.model, experiments, [*free, *told], sigma=best.sigma, start_memory=memory)
    except PsaError:
        return best
    needed = len(told) * np.log(len(best.residuals))
    return wider if wider.cost < best.cost - needed else best


def _can_tell(
    best: Fit, experiments: Sequence[Experiment], free: list[str], group: Sequence[str]
) -> bool:
    """Whether every parameter of the group has a standard error below half a logarithmic unit."""
    names = [*free, *group]
    unknowns = unknowns_of(best.model, names, len(experiments), best.unknowns.offset_scale)
    theta = np.zeros(unknowns.size)
    theta[len(names) :] = best.theta[len(free) :]
    parts = predict(best.model, experiments, unknowns, theta, rtol=FIT_RTOL)
    jacobian = np.vstack(
        [p.jacobian[e.used[: e.stop]] for p, e in zip(parts, experiments, strict=True)]
    )
    scaled = jacobian / max(best.rms, min(best.sigma))
    information = scaled.T @ scaled + np.diag(1.0 / unknowns.prior**2)
    errors = np.sqrt(np.diag(np.linalg.pinv(information, hermitian=True)))
    return bool(np.all(errors[len(free) : len(names)] < 0.5))


def _warnings(best: Fit, found: Determinacy) -> tuple[str, ...]:
    sentences = []
    if not best.converged:
        sentences.append("The fit was cut off before it converged; its values are not final.")
    sentences += [
        f"'{name}' sits on a bound of its range; its interval means nothing."
        for name in found.on_bound
    ]
    sentences += [f"'{name}' is not determined by these records." for name in found.undetermined]
    return tuple(sentences)


def version() -> str:
    """Return the version of the package, which a model file carries."""
    return __version__
