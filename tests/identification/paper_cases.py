"""Steps in closed form, and records of the reference that the paper's method is tried on."""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import numpy as np

from psa_casadi import reference
from psa_casadi.common.units import ComplexArray, FloatArray
from psa_casadi.identification.start.linear_response import mechanics_poles, numerator_time
from psa_casadi.records import Record, sine, time_grid
from tests.model.stack_models import stack_values

LINEAR = {"A": 0.0, "beta": 0.0, "gamma": 0.0, "delta": 0.0, "R_s": 8e-3}
#: A loop that leads, for which the paper's condition gamma > beta holds (over k_L).
LEADING = {"A": 0.25, "beta": 0.05, "gamma": 0.2, "delta": -0.02}


def compliance(p: dict[str, float]) -> float:
    return 1.0 / p["k_P"] + 1.0 / p["k_B"]


def poles(p: dict[str, float]) -> ComplexArray:
    parts = [np.roots([p[f"m_{q}"], p[f"c_{q}"], p[f"k_{q}"]]) for q in "PB"]
    return np.concatenate([[-1.0 / p["tau"]], *parts]).astype(np.complex128)


def residues(p: dict[str, float]) -> ComplexArray:
    """Return r_i of the step response 1 + sum r_i e^(p_i t), by the limit (s - p_i) G(s)/s."""
    result, scale = [], p["tau"] * p["m_P"] * p["m_B"] * compliance(p)
    for k, pole in enumerate(poles(p)):
        both = (p["c_B"] + p["c_P"]) * pole + p["k_B"] + p["k_P"]
        result.append(both / (scale * pole * np.prod(pole - np.delete(poles(p), k))))
    return np.array(result)


def step_response(p: dict[str, float], time: FloatArray) -> FloatArray:
    g = 1.0 + np.exp(np.outer(time, poles(p))) @ residues(p)
    return np.asarray(g.real, dtype=np.float64)


def coefficients_of_values(values: Mapping[str, float]) -> FloatArray:
    """Return a_1..a_5, b_1, shape (6,), of the physical parameters of the cascade, eqs. (13), (15).

    The denominator is (tau s + 1) (m_B/k_B s^2 + c_B/k_B s + 1) (m_P/k_P s^2 + c_P/k_P s + 1).
    """
    product = np.array([values["tau"], 1.0])
    for part in "BP":
        m, c, k = (values[f"{q}_{part}"] for q in "mck")
        product = np.polymul(product, [m / k, c / k, 1.0])
    zero = (values["c_B"] + values["c_P"]) / (values["k_B"] + values["k_P"])
    return np.append(product[-2::-1], zero)


def closed_step(p: dict[str, float], duration: float, samples: int, noise: float = 0.0) -> Record:
    """Return a record of the closed step response: a jump to u_rated in 0.1 ns, then held."""
    time = np.linspace(0.0, duration, samples)
    g = step_response(p, time) + noise * np.random.default_rng(0).standard_normal(samples)
    voltage = np.concatenate([[0.0], np.full(samples, p["u_rated"])])
    x = np.concatenate([[0.0], g]) * p["k_L"] * compliance(p) * p["u_rated"]
    time = np.concatenate([[0.0], time + 1e-10])
    return Record(name="step", time=time, voltage=voltage, displacement=x)


def responding(p: dict[str, float], name: str, time: FloatArray, voltage: FloatArray) -> Record:
    """Return a record of the reference."""
    drive, breaks = reference.from_samples(time, voltage), time[1:3].tolist()
    x = reference.simulate(p, drive, time, breakpoints=breaks, rtol=1e-9).displacement
    return Record(name=name, time=time, voltage=voltage, displacement=x)


@lru_cache(maxsize=8)
def loop(name: str = "P-885.51", frequency: float = 1.0, leading: bool = False) -> Record:
    """Return two periods of a sine from rest at 0 V to u_rated, without noise."""
    p = stack_values(name)
    if leading:
        p |= {key: share * p["k_L"] for key, share in LEADING.items()}
    time = time_grid(2.0 / frequency, 1.0 / (500.0 * frequency))
    voltage = sine(time, 0.0, p["u_rated"], frequency)
    return responding(p, f"loop {frequency:g} Hz", time, voltage)


@lru_cache(maxsize=4)
def real_step(volts: float, name: str = "P-885.51") -> Record:
    """Return the reference's response, hysteresis and all, to a jump of `volts`."""
    time = np.linspace(0.0, 4e-3, 4001)
    voltage = np.full(time.shape, volts)
    voltage[0] = 0.0
    return responding(stack_values(name), f"step {volts:g} V", time, voltage)


def noisy(record: Record, share: float) -> Record:
    draw = share * record.range_m * np.random.default_rng(1).standard_normal(record.n)
    return replace(record, displacement=np.asarray(record.displacement) + draw)


def transfer(theta: FloatArray, frequency: FloatArray) -> ComplexArray:
    """Return X/U at the frequencies [Hz], shape (k,), gain 1 at rest."""
    s = 2j * np.pi * frequency
    whole = np.append(mechanics_poles(theta), -np.exp(-theta[0]))
    spectrum: ComplexArray = (1.0 + numerator_time(theta) * s) / np.prod(
        1.0 - s[:, None] / whole, axis=1
    )
    return spectrum
