"""`--model` that is no stack: a function of a Python file, an FMU, the file of another model."""

import re
import runpy
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import psa_casadi as psa
from psa_casadi.cli.inputs import Inputs
from psa_casadi.cli.options import Reading
from psa_casadi.common.errors import InputError, quoted

_PYTHON = re.compile(r"(?P<file>.+\.py)(?::(?P<name>\w*))?", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class Fitting:
    """How a model that is no stack is fitted: keyword arguments of `psa.identify(model, records)`.

    Options:
        fmu: FMU of any tool, in the place of --model.
        free: Parameter of a model of your own to fit, by default all that may be; repeat the option
            for several. Of an FMU whose description has no bounds for it, with these:
            NAME=LOW:HIGH.
        value: Value of a parameter of an FMU in the place of its own, NAME=VALUE, or of an input
            that no record has; repeat the option for several.
        zeros: Output of a model of your own whose zero is unknown in each record; repeat the option
            for several.
        hold: What the inputs of a model of your own do between samples; by default what the
            records make likelier.
        known_start: The records of a model of your own begin at its declared states.
    """

    fmu: Path | None = None
    free: list[str] | None = None
    value: list[str] | None = None
    zeros: list[str] | None = None
    hold: Literal["linear", "zero"] | None = None
    known_start: bool = False

    @property
    def words(self) -> dict[str, Any]:
        """The keyword arguments that have a value, without those that name the model."""
        every = {n: v for n, v in asdict(self).items() if v and n not in ("fmu", "value")}
        if self.free:
            every["free"] = [text.partition("=")[0] for text in self.free]
        return every


def own_model(
    inputs: Inputs, path: Path | None, fitting: Fitting, *, fitted: bool = True
) -> psa.Model | None:
    """Return the model that a path names where it is no stack's; None for a stack's or none.

    Unless it is to be `fitted`, no parameter of an FMU is free.

    A model that cannot be made ends the command.
    """
    if fitting.fmu is not None and path is not None:
        inputs.add("--fmu and --model are both given; leave one of them out.")
    model = (
        None if (place := fitting.fmu or path) is None else _model(inputs, place, fitting, fitted)
    )
    if model is None or not model.structure.foreign:
        bounds = [text for text in fitting.free or () if "=" in text]
        for text in [*bounds, *(fitting.value or ())]:
            inputs.add(f"'{text}' is said of an FMU; add --fmu FILE.fmu.")
    if model is None:
        for name in fitting.words:
            option = name.replace("_", "-")
            inputs.add(f"--{option} is said of a model of your own; add --model FILE.py:FUNCTION.")
    return model


def _model(inputs: Inputs, path: Path, fitting: Fitting, fitted: bool) -> psa.Model | None:
    from psa_casadi.simulation.start import is_stack

    if (model := from_python(path)) is not None:
        return model
    if path.suffix.lower() == ".fmu" or fitting.fmu:
        return _imported(inputs, path, fitting, fitted)
    try:
        model = psa.load_model(path, inputs.user_effects)
    except InputError:  # the reader of a stack's file reports it
        return None
    return None if is_stack(model) else model


def _imported(inputs: Inputs, path: Path, fitting: Fitting, fitted: bool) -> psa.Model | None:
    """Return the model of an FMU, in whose names the parameters are that a fit is to find."""
    free: dict[str, tuple[float, float] | None] = {}
    for text in fitting.free or ():
        name, equals, bounds = text.partition("=")
        low, _, high = bounds.partition(":")
        try:
            free[name.strip()] = (float(low), float(high)) if equals else None
        except ValueError:
            inputs.add(f"--free is '{text}'; give NAME=LOW:HIGH, such as --free mass=0.1:10.")
    values = inputs.numbers("--value", fitting.value)
    inputs.check()
    return psa.fmu_model(path, free=(free or None) if fitted else {}, values=values)


def from_python(path: Path) -> psa.Model | None:
    """Return the model of FILE.py:FUNCTION, of a function or a variable; None for other paths."""
    match = _PYTHON.fullmatch(str(path))
    if match is None:
        return None
    file, name = Path(match["file"]), match["name"] or ""
    if not file.is_file():
        raise InputError(f"--model: there is no file {file}; check the name and the directory.")
    sys.path.append(str(file.resolve().parent))  # modules in its folder can be imported
    try:
        held = runpy.run_path(str(file), run_name=file.stem)
        made = held.get(name)
        model = made() if callable(made) else made
    except Exception as error:  # the user's own code may raise anything
        raise InputError(
            f"--model: {file} cannot make a model ({type(error).__name__}: {error}); correct it."
        ) from error
    if not isinstance(model, psa.Model):
        functions = [n for n, v in held.items() if getattr(v, "__module__", "") == file.stem]
        known = f"; it has {quoted(functions)}" if functions else ""
        lacks = f"{file} has no function '{name}' that returns a model{known}. Name one that does"
        if not name:
            lacks = f"say which function of {file} returns the model{known}"
        raise InputError(f"--model: {lacks}, as {file}:{functions[-1] if functions else 'make'}.")
    return model


def own_diagnosis(
    model: psa.Model,
    records: Sequence[Path],
    held_out: Sequence[Path],
    fitting: Fitting,
    reading: Reading,
    inputs: Inputs,
    *,
    leave_out: Sequence[str],
    others: Mapping[str, object],
) -> Callable[..., psa.Diagnosis]:
    """Read the records of a model that is no stack; return a function that diagnoses it.

    It takes `progress` and `watch`; `others` are options that must be empty.
    """
    components = inputs.effects_of_any_model()
    inputs.refuse(others)
    measured, held = (inputs.signals(model, part, reading) for part in (records, held_out))
    return partial(
        psa.diagnose, model, measured, holdout=held, leave_out=leave_out, effects=components,
        **fitting.words,
    )  # fmt: skip
