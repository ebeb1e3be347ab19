"""Polynomials whose coefficients are CasADi expressions, highest power first."""

from typing import Any

import casadi as ca


def product(a: Any, b: Any) -> Any:
    """Product of two polynomials in CasADi, highest power first."""
    a, b = ca.vertcat(a), ca.vertcat(b)
    terms = [0.0] * (a.numel() + b.numel() - 1)
    for i in range(a.numel()):
        for k in range(b.numel()):
            terms[i + k] = terms[i + k] + a[i] * b[k]
    return ca.vertcat(*terms)


def total(a: Any, b: Any) -> Any:
    """Sum of two polynomials in CasADi, highest power first."""
    size = max(a.numel(), b.numel())
    return ca.vertcat(*[0.0] * (size - a.numel()), a) + ca.vertcat(*[0.0] * (size - b.numel()), b)


def log_square(polynomial: Any, w: Any) -> Any:
    """Return ln |p(i w)|^2 of a polynomial, highest power first."""
    real, imaginary = 0.0, 0.0
    for k in range(polynomial.numel()):
        real, imaginary = -w * imaginary + polynomial[k], w * real
    return ca.log(real * real + imaginary * imaginary)
