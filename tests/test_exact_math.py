"""exp and log of exact steps: their tables correctly rounded, their values to the last place."""

import ctypes
import re
import struct
from decimal import Decimal, localcontext
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from psa_casadi.simulation.compiler import shared_library, sources_directory

FloatArray = NDArray[np.float64]

ENTRIES = 128
LAST_PLACE = 2.0**-52
CODE = """
#include "exact_math.h"
#define EACH(name)                                                                                \\
    __attribute__((visibility("default"))) void each_##name(long n, const double *x, double *y) { \\
        for (long i = 0; i < n; ++i) {                                                            \\
            const real z = x[i] + REAL(0.0);                                                      \\
            const real found = name(z);                                                           \\
            y[i] = LANE(found, PSA_LANES - 1);                                                    \\
        }                                                                                         \\
    }
EACH(v_exp)
EACH(v_log)
EACH(v_log_of_base)
"""


@cache
def library(lanes: int) -> ctypes.CDLL:
    flags = ("-std=gnu99", f"-DPSA_LANES={lanes}")
    return ctypes.CDLL(str(shared_library({"math.c": CODE}, (), flags)))


def each(name: str, x: FloatArray, lanes: int = 1) -> FloatArray:
    y = np.empty_like(x)
    doubles = ctypes.POINTER(ctypes.c_double)
    call = getattr(library(lanes), f"each_{name}")
    call(ctypes.c_long(x.size), x.ctypes.data_as(doubles), y.ctypes.data_as(doubles))
    return y


def arguments(name: str) -> FloatArray:
    if name == "v_exp":
        return np.concatenate([np.linspace(-708.0, 709.0, 100_003), np.linspace(-1, 1, 10_001)])
    return np.concatenate([np.geomspace(1e-300, 1e300, 100_003), np.linspace(0.7, 1.5, 10_001)])


def numbers(table: str) -> list[float]:
    text = (sources_directory() / "exact_tables.h").read_text()
    body = text[text.index(table) :].split("= {", 1)[1].split("};", 1)[0]
    return [float.fromhex(q) for q in re.findall(r"-?0x1\.[0-9a-f]+p[+-]\d+|0x0\.0p\+0", body)]


def from_bits(bits: int) -> float:
    return float(struct.unpack("<d", struct.pack("<Q", bits))[0])


def test_powers_in_the_table_are_rounded_correctly() -> None:
    with localcontext() as context:
        context.prec = 60
        exact = [float(Decimal(2) ** (Decimal(i) / ENTRIES)) for i in range(ENTRIES)]
    assert numbers("EXP_TABLE") == exact


def test_logarithms_in_the_table_are_rounded_correctly() -> None:
    found = numbers("LOG_TABLE")
    assert len(found) == 2 * ENTRIES
    first = struct.unpack("<Q", struct.pack("<d", float(np.sqrt(0.5))))[0]
    for i, (inverse, log) in enumerate(zip(found[::2], found[1::2], strict=True)):
        with localcontext() as context:
            context.prec = 60
            assert log == float(-Decimal(inverse).ln())
        assert inverse * 2.0**12 == round(inverse * 2.0**12)  # 13 bits: m / c is nearly exact
        for edge in (i, i + 1):
            assert abs(from_bits(first + (edge << 45)) * inverse - 1.0) < 0.0041


@pytest.mark.parametrize("lanes", [1, 4])
@pytest.mark.parametrize("name", ["v_exp", "v_log"])
def test_relative_error_is_a_last_place(name: str, lanes: int) -> None:
    x = arguments(name)
    exact = (np.exp if name == "v_exp" else np.log)(x.astype(np.longdouble))
    error = np.abs(each(name, x, lanes) - exact)
    assert np.max(error / np.maximum(np.abs(exact), 1e-320)) <= LAST_PLACE


@pytest.mark.parametrize("lanes", [1, 4])
def test_logarithm_of_a_base_is_good_enough_for_powers(lanes: int) -> None:
    x = arguments("v_log_of_base")
    exact = np.log(x.astype(np.longdouble))
    error = np.abs(each("v_log_of_base", x, lanes) - exact)
    assert np.max(error / np.maximum(1.0, np.abs(exact))) <= 2.0 * LAST_PLACE


def test_ends() -> None:
    assert each("v_exp", np.array([-1e4, 0.0, 1e4])).tolist() == [
        pytest.approx(np.exp(-708.0)),
        1.0,
        pytest.approx(np.exp(709.0)),
    ]
    for name in ("v_log", "v_log_of_base"):
        assert each(name, np.array([1.0])).tolist() == [0.0]
        assert np.isnan(each(name, np.array([0.0, -1.0]))).all()
