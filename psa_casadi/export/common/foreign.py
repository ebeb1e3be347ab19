"""What no export can print: equations that call an imported FMU."""

from psa_casadi.errors import InputError
from psa_casadi.model.structure import Structure


def refuse_foreign(structure: Structure, what: str) -> None:
    """Raise InputError for a model with an FMU in it; `what` it would become, as "an FMU"."""
    if structure.foreign:
        (own, *_) = (c for c in structure.components if c.foreign)
        raise InputError(
            f"The model has an FMU in it ('{own.name}': {own.source}), which is a binary without"
            f" equations to write as {what}; add the effects to the model in the tool that made the"
            " FMU. Here it can be simulated, identified and diagnosed."
        )
