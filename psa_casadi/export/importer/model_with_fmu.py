"""MODEL.json of any model, with the FMU that it may have."""

import os
from collections.abc import Iterable
from functools import partial
from pathlib import Path, PurePath

from psa_casadi.component import Component, FmuUsed
from psa_casadi.export.importer.fmu_model import component_again
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import model_of, no_fmu, read_content
from psa_casadi.variables import Parameter


def load_model(
    path: str | os.PathLike[str],
    effects: Iterable[Component] = (),
    *,
    fmu: str | os.PathLike[str] | None = None,
) -> Model:
    """Read MODEL.json; `effects` are own ones of modules that it may have.

    Equations in the file are read as text, none of it is run. The binary of an FMU that the model
    has runs in this process: `fmu` is that FMU or the folder with it, by default the folder of
    MODEL.json.

    Raises InputError with every unknown name, missing or bad value, and for an FMU that is not
    there or has another SHA-256 than when the model was saved.
    """
    place = Path(path).parent if fmu is None else Path(fmu)
    return model_of(read_content(path), str(path), effects, partial(_opened, place))


def _opened(place: Path, used: FmuUsed, name: str, parameters: tuple[Parameter, ...]) -> Component:
    """Return the component of an FMU that lies at a place, or in it."""
    if PurePath(used.file).name != used.file:
        return no_fmu(used, name, parameters)
    file = place / used.file if place.is_dir() else place
    return component_again(file, used, name, parameters)
