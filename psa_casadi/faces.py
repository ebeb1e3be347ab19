"""`psa.identify` and `psa.diagnose`: of a stack's records, or of any model, which comes first."""

from collections.abc import Callable, Sequence
from functools import wraps
from inspect import signature
from typing import Any, overload

from psa_casadi.common.errors import InputError
from psa_casadi.common.interruption import interruptible_work
from psa_casadi.common.progress import Progress, on_a_terminal
from psa_casadi.diagnosis import diagnose as diagnosis
from psa_casadi.diagnosis.ode import diagnose_ode
from psa_casadi.diagnosis.result import Diagnosis, StackDiagnosis
from psa_casadi.diagnosis.task import Method
from psa_casadi.identification import identify as stack
from psa_casadi.identification.identify import StackIdentification
from psa_casadi.identification.own_model import identify_ode
from psa_casadi.identification.result import Identification
from psa_casadi.identification.start.ordinary import Hysteresis
from psa_casadi.model.component import Component
from psa_casadi.model.compose import Model
from psa_casadi.records.read.reading import Records
from psa_casadi.records.signals import Hold
from psa_casadi.simulation.side_by_side import one_thread_of_algebra
from psa_casadi.simulation.start import is_stack


def _with_help_of(work: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add to a function's help that of the function for any other model."""

    def documented(face: Callable[..., Any]) -> Callable[..., Any]:
        words = f"For your model, {face.__name__}{signature(work)}:\n\n    {work.__doc__}"
        face.__doc__ = f"{face.__doc__}\n    {words}"
        return face

    return documented


@overload
def identify(
    records: Records,
    *,
    model: Model | None = None,
    stiffness: float | None = None,
    hysteresis: Hysteresis | None = None,
    progress: Progress = ...,
) -> StackIdentification: ...
@overload
def identify(
    model: Model,
    records: Any,
    *,
    free: Sequence[str] | None = None,
    starts: int = 8,
    zeros: Sequence[str] = (),
    known_start: bool = False,
    hold: Hold | None = None,
    progress: Progress = ...,
) -> Identification: ...
@on_a_terminal
@_with_help_of(identify_ode)
@wraps(stack.identify)
def identify(*inputs: Any, **words: Any) -> Any:
    """Identify a stack, or your model (the first argument), from its records."""
    model, records = _models_first(inputs, words)
    if model is None or is_stack(model):
        return stack.identify(records, model=model, **_known(words, stack.identify))
    return _own(identify_ode, model, records, words)


@overload
def diagnose(
    records: Records,
    *,
    holdout: Records = (),
    reference: Records = (),
    model: Model | None = None,
    stiffness: float | None = None,
    hysteresis: Hysteresis | None = None,
    effects: Sequence[Component] | None = None,
    leave_out: Sequence[str] = (),
    method: Method | None = None,
    progress: Progress = ...,
) -> StackDiagnosis: ...
@overload
def diagnose(
    model: Model,
    records: Any,
    *,
    holdout: Any = (),
    free: Sequence[str] | None = None,
    leave_out: Sequence[str] = (),
    starts: int = 8,
    zeros: Sequence[str] = (),
    known_start: bool = False,
    hold: Hold | None = None,
    effects: Sequence[Component] = ...,
    progress: Progress = ...,
) -> Diagnosis: ...
@on_a_terminal
@_with_help_of(diagnose_ode)
@wraps(diagnosis.diagnose)
def diagnose(*inputs: Any, **words: Any) -> Any:
    """Diagnose a stack, or your model (the first argument), on its records."""
    model, records = _models_first(inputs, words)
    if model is None or is_stack(model):
        return diagnosis.diagnose(records, model=model, **_known(words, diagnosis.diagnose))
    return _own(diagnose_ode, model, records, words)


@interruptible_work()
@one_thread_of_algebra()
def _own(work: Callable[..., Any], model: Model, records: Any, words: dict[str, Any]) -> Any:
    return work(model, records, **_known(words, work))


#: Words that are several names.
_NAMES = ("free", "zeros", "leave_out")


def _known(words: dict[str, Any], work: Callable[..., Any]) -> dict[str, Any]:
    """Return the words for a piece of work, one name in the place of several as a list of it.

    Raises InputError for a word that it does not take.
    """
    names = [n for n in signature(work).parameters if n not in ("model", "records")]
    for word in words:
        if word not in names:
            what = "your model" if "known_start" in names else "a stack"
            raise InputError(f"'{word}' is not among the arguments for {what}: {', '.join(names)}.")
    single = {n: [w] for n, w in words.items() if n in _NAMES and isinstance(w, str)}
    return words | single


def _models_first(inputs: tuple[Any, ...], words: dict[str, Any]) -> tuple[Model | None, Any]:
    """Return the model, if there is one, and the records; `words` lose both."""
    left = list(inputs)
    model = left.pop(0) if left and isinstance(left[0], Model) else words.pop("model", None)
    if left[1:] and isinstance(left[1], Model):
        raise InputError(
            "The model comes first and its records second: psa.diagnose(model, records). With the"
            " records of a stack, name it: model=..."
        )
    records = left.pop(0) if left else words.pop("records", None)
    if records is None or left:
        raise InputError("Give records, or your model and its records; name the other arguments.")
    return model, records
