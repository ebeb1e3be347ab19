r"""Parameters that differ between two or more findings by more than their noise.

Cochran's Q: with weights w_i = 1/s_i^2 and the weighted mean m,

    Q = sum_i w_i (theta_i - m)^2  ~  chi^2(k - 1)

where all k devices have one value; for two it is the square of the z test. (W. G. Cochran,
Biometrics 10 (1954) 101.) p values are adjusted over the parameters (Holm).
"""

from collections.abc import Sequence
from dataclasses import dataclass

from psa_casadi.population.finding import Finding
from psa_casadi.population.parameters import Estimates, estimates, names_of
from psa_casadi.population.statistics import LIMIT, adjusted, mixed_regression


@dataclass(frozen=True, eq=False)
class Difference:
    """A parameter that two findings or more tell; p values of "all have one value"."""

    estimates: Estimates
    p_value: float
    p_adjusted: float

    @property
    def differs(self) -> bool:
        """Whether the values differ beyond noise."""
        return self.p_adjusted < LIMIT


def differences(findings: Sequence[Finding]) -> tuple[Difference, ...]:
    """Return the parameters that two findings or more tell, in the order of the files."""
    shared = [e for n in names_of(findings) if len((e := estimates(findings, n)).places) > 1]
    p_values = [mixed_regression(e.theta, e.errors).p_value for e in shared]
    corrected = adjusted(p_values, "bonferroni")
    return tuple(
        Difference(e, p, float(c)) for e, p, c in zip(shared, p_values, corrected, strict=True)
    )
