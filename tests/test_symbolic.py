"""Threads that make expressions at once do not end the process."""

import subprocess
import sys

#: Without the decorator six of six runs ended by a signal.
_MANY = """
from threading import Thread

import casadi as ca

from psa_casadi.common.symbolic import in_turn


@in_turn
def made(k):
    x = ca.SX.sym("x", 8)
    e = ca.vertcat(*[x[i] * (1.5 + i) + 0.1 * i + k for i in range(8)])
    return ca.Function("f", [x], [e, ca.jacobian(e.T @ e, x)]).n_instructions()


threads = [Thread(target=lambda: [made(k) for k in range(1500)]) for _ in range(4)]
[t.start() for t in threads]
[t.join() for t in threads]
print("ended")
"""


def test_many_threads_make_expressions_in_turn() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _MANY], capture_output=True, text=True, check=False, timeout=120
    )
    assert (done.returncode, done.stdout) == (0, "ended\n"), done.stderr[-500:]
