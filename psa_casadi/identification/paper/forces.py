"""From what the paper's method finds, in displacements and times, to the model in forces."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from psa_casadi.identification.fitting.unknowns import static_compliance
from psa_casadi.identification.paper.hysteresis import HysteresisPart
from psa_casadi.identification.paper.linear import mechanics_of
from psa_casadi.model.compose import Model


@dataclass(frozen=True, eq=False)
class Translated:
    """The model, the names of its parameters that were found, and what could not be taken over."""

    model: Model
    found: tuple[str, ...]
    sentences: tuple[str, ...]


def in_forces(
    start: Model,
    k: float | None,
    coefficients: Mapping[str, float] | None,
    bend: HysteresisPart,
) -> Translated:
    """Return `start` with everything that was found, k_P and k_B being those of `start`.

    k_L = k/C with C = 1/k_P + 1/k_B [m/N]; lag, masses and dampings are factors of the denominator.
    Without a loop f_H is 0; without factors the parts are damped critically, c >= 2 sqrt(k m),
    since nothing is known to ring. A value out of its bounds is refused, n is clipped.
    """
    compliance = static_compliance(start.values)
    usual = _still(start)
    motion: dict[str, float] = {}
    sentences: tuple[str, ...] = ()
    if coefficients is not None:
        motion, sentences = mechanics_of(coefficients, start.values["k_P"], start.values["k_B"])
    wanted = {**motion, **_loop(bend, compliance, start.values["h_ref"])}
    if k is not None:
        wanted["k_L"] = k / compliance
    kept, refused = _inside(usual, wanted)
    return Translated(
        model=usual.with_values(kept),
        found=tuple(name for name in start.parameter_names if name in kept),
        sentences=(*sentences, *refused),
    )


def _still(start: Model) -> Model:
    """Return the model without a loop and with both parts damped critically at least."""
    p = start.values
    critical = {f"c_{q}": 2.0 * float(np.sqrt(p[f"k_{q}"] * p[f"m_{q}"])) for q in "PB"}
    loop = dict.fromkeys(("A", "beta", "gamma", "delta"), 0.0)
    return start.with_values({**loop, **{c: max(v, p[c]) for c, v in critical.items()}})


def _loop(bend: HysteresisPart, compliance: float, h_ref: float) -> dict[str, float]:
    """Return the loop in forces, {} where it is not complete.

    h = C f_H gives A/C and delta/C. As eq. (8) is in r = |f_H|/h_ref here, beta becomes
    beta C^(n-1) h_ref^n, and gamma likewise.
    """
    if bend.A is None or bend.delta is None or bend.bends is None:
        return {}
    n = bend.bends.n
    unit = compliance ** (n - 1.0) * h_ref**n
    return {
        "A": bend.A / compliance,
        "delta": bend.delta / compliance,
        "n": n,
        "beta": bend.bends.beta * unit,
        "gamma": bend.bends.gamma * unit,
    }


def _inside(model: Model, wanted: Mapping[str, float]) -> tuple[dict[str, float], list[str]]:
    """Return the values that the parameters' bounds allow, and a sentence for each other one."""
    kept, refused = {}, []
    for name, value in wanted.items():
        p = model.parameter(name)
        low, high = p.bounds
        within = low <= value <= high
        if within or (name == "n" and np.isfinite(value)):
            kept[name] = float(np.clip(value, low, high))
        if not within:
            instead = kept.get(name, model.values[name])
            refused.append(
                f"{name} = {value:.3g} {p.unit} is outside of its range, {low:g} to {high:g};"
                f" {instead:.3g} stands in the model, and the rest does not belong to it."
            )
    return kept, refused
