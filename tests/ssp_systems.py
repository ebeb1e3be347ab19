"""Systems and their SSP archives for the tests; each is exported once per process."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from psa_casadi.export.ssp.archive import export_ssp
from psa_casadi.model.nanopositioner import nanopositioner
from psa_casadi.model.system import System
from tests.fmu_models import model_named
from tests.test_fmu_system import STACK

_FOLDER = TemporaryDirectory()


def pushed_stage() -> System:
    """Return a stack that pushes on a flexure: two parts in a loop."""
    return System(
        name="pushed_stage",
        parts={"stack": model_named(STACK).plant(), "flexure": model_named("flexure")},
        wires=(
            ("stack.displacement", "flexure.tip_position"),
            ("stack.velocity", "flexure.tip_velocity"),
            ("flexure.reaction_force", "stack.load_force"),
        ),
        inputs={"command": "stack.voltage"},
        outputs={"stage_position": "flexure.stage_position", "tip": "stack.displacement"},
    )


@cache
def closed_loop() -> System:
    return nanopositioner(STACK)


@cache
def archive_of(name: str) -> Path:
    system = pushed_stage() if name == "pushed_stage" else closed_loop()
    return export_ssp(system, Path(_FOLDER.name) / f"{name}.ssp")
