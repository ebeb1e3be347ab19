"""What a model's evidence says, in words: the same for the page and for the meta data."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from psa_casadi.export.common.markup import number
from psa_casadi.model.compose import Model
from psa_casadi.model.evidence import Covariance, Evidence, RecordRun

NOT_HELD_OUT = "no sample was held out; `psa diagnose` holds some out and judges the model on them"


@dataclass(frozen=True)
class Said:
    """One thing that is said: a keyword for machines, and the text."""

    keyword: str
    text: str


@dataclass(frozen=True)
class Chapter:
    """A part of the evidence: its name for machines, its title, and what is said there."""

    name: str
    title: str
    said: tuple[Said, ...]


def chapters(model: Model, evidence: Evidence) -> tuple[Chapter, ...]:
    """Return what is known of a model's origin, errors, range and uncertainty."""
    origin = Said("found by", f"{evidence.by}, psa_casadi {model.provenance.package_version}")
    parts: tuple[tuple[str, str, Iterable[Said]], ...] = (
        ("origin", "Where it comes from", (origin, *_records(evidence.runs))),
        ("error", "What it errs by", _errors(evidence)),
        ("budget", "Where the error goes", _budget(evidence)),
        ("validity", "What the records have shown", _seen(evidence)),
        ("covariance", "How sure the values are", _sure(model, evidence.covariance)),
    )
    found = (Chapter(name, title, tuple(said)) for name, title, said in parts)
    return tuple(c for c in found if c.said)


def micrometres(metres: float) -> str:
    """Return a length as people read it."""
    return f"{1e6 * metres:.4g} um"


def _records(runs: Iterable[RecordRun]) -> Iterator[Said]:
    for run in runs:
        blocks = f", each the mean of {run.averaged}" if run.averaged > 1 else ""
        errors = f"fitted to {micrometres(run.fitted_m)} rms"
        if run.held_out_m is not None:
            count = sum(stop - first for first, stop in run.held_out)
            errors += f", {micrometres(run.held_out_m)} rms over {count} held-out ones"
        yield Said(
            "record", f"{run.record}, sha256 {run.sha256}: {run.samples} samples{blocks}; {errors}"
        )


def _errors(evidence: Evidence) -> Iterator[Said]:
    yield Said("fitted error", f"{micrometres(evidence.fitted_m)} rms over the samples of the fit")
    held = evidence.held_out
    if held is None:
        yield Said("held-out error", NOT_HELD_OUT)
    else:
        low, high = held.interval_m.low, held.interval_m.high
        over = f"{held.records} records" if held.records else "blocks of the records"
        yield Said(
            "held-out error",
            f"{micrometres(held.rms_m)} rms, 95 % interval {micrometres(low)} to"
            f" {micrometres(high)} (jackknife over {over}); {held.nrmse_percent:.3g} % of the"
            f" range; at most {micrometres(held.max_m)}",
        )
    if evidence.outside:
        yield Said(
            "counted with",
            f"{', '.join(evidence.outside)}: of sensor or environment, which an exported plant"
            " leaves out",
        )


def _budget(evidence: Evidence) -> Iterator[Said]:
    yield from (Said("unnamed correction inside", text) for text in evidence.unnamed)
    b = evidence.budget
    if b is None:
        return
    yield Said("base", f"{micrometres(b.base_m)} rms above the noise, without the causes")
    yield Said("noise", f"{micrometres(b.noise_m)} rms")
    for effect in b.causes:
        yield Said("effect", f"{effect.what}: {_share(effect.share, effect.interval)}")
    if b.unnamed is not None:
        share = _share(b.unnamed.share, b.unnamed.interval)
        yield Said("unnamed correction outside", f"{b.unnamed.what}: {share}; the model lacks it")
    yield Said(
        "remains", f"{micrometres(b.remains_m)} rms above the noise, {b.remains_percent:.3g} % of"
        " the range"
    )  # fmt: skip


def _share(share: float, interval: object) -> str:
    ends = (share, *(getattr(interval, end) for end in ("low", "high")))
    percent, low, high = (100.0 * min(max(v, 0.0), 1.0) for v in ends)  # cut as in every page
    return f"{percent:.3g} % of the error, 95 % interval {low:.3g} to {high:.3g} %"


def _seen(evidence: Evidence) -> Iterator[Said]:
    seen = evidence.seen
    yield Said("voltage", f"{seen.voltage.low:.6g} to {seen.voltage.high:.6g} V")
    yield Said("rate of voltage", f"up to {seen.rate:.4g} V/s")
    yield Said("duration", f"up to {seen.duration:.4g} s from the start of a run")
    warm = seen.temperature
    yield Said(
        "temperature",
        "not recorded" if warm is None else f"{warm.low:.6g} to {warm.high:.6g} K",
    )


def _sure(model: Model, c: Covariance) -> Iterator[Said]:
    """Yield the standard errors, and the covariance row by row."""
    for k, name in enumerate(c.names):
        unit = model.parameter(name).unit
        value = f"{model.values[name]:.6g}{'' if unit == '1' else f' {unit}'}"
        yield Said(name, f"{value}, standard error {c.matrix[k][k] ** 0.5:.3g}")
    if c.names:
        yield Said("covariance of", " ".join(c.names))
        for name, row in zip(c.names, c.matrix, strict=True):
            yield Said(f"covariance.{name}", " ".join(number(v) for v in row))
