"""The hidden-effect suite: independent plants hide a cause, the public `diagnose` must find it.

The plants (`tests/studies/plants/`) share no code and no equation form with the effects. Every
case runs `psa_casadi.diagnose` on the file that was written, and judges what a user would see.
Every effect, clean records and several causes have golden answers (`tests/studies/golden`); here
are fresh seeds.
"""

import secrets

import numpy as np

from tests.studies.benchmarks.hidden_cases import Case, Found, run_case
from tests.studies.plants.table import KNOWN
from tests.tiers import slow

#: Fresh records in every run: so many, and twice as many where one of them misleads.
FRESH = 2


@slow
def test_fresh_records_every_time() -> None:
    """Seeds are drawn anew and printed: none of two may mislead, or at most one of four."""
    seeds = [secrets.randbelow(10**6) for _ in range(2 * FRESH)]
    draw = np.random.default_rng(seeds[0])
    cases = [Case("known", str(draw.choice(KNOWN)), s, (1.0, 3.0)) for s in seeds]
    found = [_told(case) for case in cases[:FRESH]]
    if not all(map(_right, found)):
        found += [_told(case) for case in cases[FRESH:]]
    assert sum(not _right(f) for f in found) <= 1


def _told(case: Case) -> Found:
    found = run_case(case)
    print(found.case, found.rho, found.verdict, found.within)
    return found


def _right(f: Found) -> bool:
    """Whether no other cause is named alone, and the hidden one is named if it shows."""
    return f.alone in (None, f.case.right) and (f.case.right in f.within or f.rho < 0.9)
