"""A stack of two masses with action and reaction, beside the paper's one-way cascade.

    M z'' + C z' + K z = (f_out, f_load),   z = (y, x)
    M = diag(m_P, m_B),  C = [[c_P + c_B, -c_B], [-c_B, c_B]],  K likewise of k_P, k_B

M, C and K are symmetric: that is Newton's third law for springs and dampers. The force behind the
lag is that of the base (quasi-static hysteresis of the electrode voltage); lag and masses are
solved by a matrix exponential, exact for a force that is linear on each sub-interval. Source: any
text on vibration, e.g. L. Meirovitch, "Fundamentals of Vibrations", ch. 5. Not the project's form:
no gain that blends two sets of equations, matrices instead of balances.
"""

import numpy as np
from scipy.linalg import expm

from tests.studies.plants.base import Run
from tests.studies.plants.stack import FloatArray, Stack


def matrices(s: Stack) -> tuple[FloatArray, FloatArray, FloatArray]:
    """M [kg], C [N.s/m] and K [N/m] of (y, x), (2, 2) each."""
    mass = np.diag([s.m_p, s.m_b])
    damping, stiffness = (
        np.array([[p + b, -b], [-b, b]]) for p, b in ((s.c_p, s.c_b), (s.k_p, s.k_b))
    )
    return mass, damping, stiffness


def two_masses(run: Run, load: FloatArray | None = None) -> FloatArray:
    """Displacement x at the samples, (N,) [m], for the force of a run of the base.

    load: force on the output mass at the samples, (N,) [N], linear in between.
    """
    mass, damping, stiffness = matrices(run.stack)
    a = np.zeros((5, 5))
    a[:2, 2:4] = np.eye(2)
    a[2:4, :2] = -np.linalg.solve(mass, stiffness)
    a[2:4, 2:4] = -np.linalg.solve(mass, damping)
    a[2, 4] = 1.0 / run.stack.m_p
    a[4, 4] = -1.0 / run.stack.tau
    b = np.zeros((5, 2))
    b[4, 0], b[3, 1] = 1.0 / run.stack.tau, 1.0 / run.stack.m_b
    pushed = np.zeros_like(run.times) if load is None else load
    fine = np.interp(np.arange(run.force.size) / run.sub_intervals, np.arange(pushed.size), pushed)
    x = linear_response(a, b, np.column_stack([run.force, fine]), run.fine_step)[:, 1]
    return x[:: run.sub_intervals]


def linear_response(a: FloatArray, b: FloatArray, u: FloatArray, step: float) -> FloatArray:
    """Solve z' = a z + b u from rest, (M, n), exactly for inputs (M, k) linear on each step.

    One exponential of [[a, b, 0], [0, 0, 1/h], [0, 0, 0]] gives growth and both weights.
    """
    n, k = b.shape
    block = np.zeros((n + 2 * k, n + 2 * k))
    block[:n, :n], block[:n, n : n + k] = a * step, b * step
    block[n : n + k, n + k :] = np.eye(k)
    moved = expm(block)
    growth, new = moved[:n, :n], moved[:n, n + k :]
    old = moved[:n, n : n + k] - new
    driven = u[:-1] @ old.T + u[1:] @ new.T
    z = np.zeros((len(u), n))
    for index, push in enumerate(driven):
        z[index + 1] = growth @ z[index] + push
    return z
