"""FMUs of several models against computations that share no code with them."""

import pytest

from psa_casadi.export.check.agreement import has_reference
from psa_casadi.export.check.check import check_fmu
from psa_casadi.export.common.variable_table import variable_table
from tests.export.fmu_models import exported, model_named
from tests.tiers import slow_but

STACK = "P-885.51"
#: The two versions are two faces of one core: each kind of model in one of them, one in both. Other
#: stacks are checked in `test_cli_commands` and played in `test_fmu_accuracy`.
CHECKED = (
    (STACK, 3), ("flexure", 3), (STACK, 2), ("single_mass", 2), ("slow_creep", 2),
    ("every_effect", 3),
)  # fmt: skip


@pytest.mark.parametrize(("name", "fmi"), slow_but(CHECKED[:1], CHECKED))
def test_check_passes(name: str, fmi: int) -> None:
    report = check_fmu(exported(name, fmi), model_named(name))
    assert report.compared
    assert not report.failures, "\n".join(
        f"{r.name}: {r.figure} {r.remark}" for r in report.failures
    )
    steps = [r for r in report.rows if r.name.startswith("co-simulation, step")]
    assert len(steps) == 4
    assert all(r.limit == 1e-6 for r in steps)
    against = "reference" if has_reference(model_named(name)) else "simulator"
    assert all(r.remark.endswith(f"against the {against}") for r in steps)


@pytest.mark.parametrize("name", dict(CHECKED))
def test_nominal_values_of_parameters_are_within_their_bounds(name: str) -> None:
    for v in variable_table(model_named(name)):
        if v.kind == "parameter" and v.bounds and v.bounds[1] > 0.0:
            assert v.nominal is not None
            assert v.bounds[0] <= v.nominal <= v.bounds[1], v
