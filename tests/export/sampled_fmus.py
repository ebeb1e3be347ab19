"""FMUs of the sampled models; each is exported once per process."""

import tempfile
from functools import cache
from pathlib import Path

from psa_casadi.export.fmu.archive import export_fmu
from tests.model.sampled_models import controller, loop

_FOLDER = tempfile.TemporaryDirectory()


@cache
def exported(name: str, fmi: int) -> Path:
    """Return the FMU of "loop" or "controller", FMI 2.0 or 3.0."""
    model = loop() if name == "loop" else controller()
    return export_fmu(model, Path(_FOLDER.name) / f"{name}_{fmi}.fmu", fmi=fmi)
