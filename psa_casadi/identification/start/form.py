"""The form of the base's hysteresis: the paper's Bouc-Wen force, or a spectrum of elements."""

from typing import Literal

from psa_casadi.components.stack import BOUC_WEN, MEMORY_SPECTRUM
from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model

#: Forms of the hysteresis by name; `best` is the one that the records prefer.
Hysteresis = Literal["bouc-wen", "spectrum", "best"]

FORMS = {"bouc-wen": BOUC_WEN, "spectrum": MEMORY_SPECTRUM}


def forms_of(model: Model, hysteresis: Hysteresis | None) -> tuple[Model, ...]:
    """Return the model in each form that is to be fitted; as it is where none is asked for.

    Raises InputError for a model whose hysteresis has neither form.
    """
    if hysteresis is None:
        return (model,)
    names = tuple(FORMS) if hysteresis == "best" else (hysteresis,)
    return tuple(_in_form(model, name) for name in names)


def _in_form(model: Model, name: str) -> Model:
    known = {c.name for c in FORMS.values()}
    if not any(c.name in known for c in model.components):
        raise InputError(
            f"The model '{model.name}' has no hysteresis of its own to give another form; leave"
            " --hysteresis out."
        )
    own = [FORMS[name] if c.name in known else c for c in model.components]
    there = {c.name for c in own}
    return model.with_components(c for c in own if set(c.needs) <= there)
