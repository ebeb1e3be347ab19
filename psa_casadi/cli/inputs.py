"""The inputs of a command, checked as a whole before any long work starts.

Also `--model` that is no stack: a function of a Python file, an FMU, the file of another model.
"""

import difflib
import math
import os
import re
import runpy
import sys
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

import psa_casadi as psa
from psa_casadi.cli.options import Published, Reading, Start
from psa_casadi.cli.screen import print_message, set_quiet
from psa_casadi.common.errors import InputError, quoted
from psa_casadi.common.files import why_not_written

if TYPE_CHECKING:
    from psa_casadi.records.read.columns import ColumnMap

T = TypeVar("T")
#: What an option writes, and what the names of such files end with.
PAGE, _PICTURE = ("a page", ".html", ".htm"), ("a picture", ".png", ".svg", ".pdf")

#: Stiffness of free stacks [N/m], from a lever of 0.1 N/um to 100 x 100 mm2 of 1 cm with a margin
#: of ten: what is outside is of another unit.
_STIFFNESSES = (1e4, 1e11)


@dataclass(kw_only=True)
class Inputs:
    """The inputs of a command: collects their problems, to report all of them at once.

    Unless `quiet`, it prints how the reader understood a record's columns. `user_effects` are those
    of the modules that --effects names, `fitted` is the number of records that are not held out.
    """

    effects: list[str] | None = None
    quiet: bool = False
    fitted: int = field(default=0, init=False)
    _problems: list[str] = field(default_factory=list, init=False)

    def __post_init__(self) -> None:
        """Read the effects."""
        set_quiet(self.quiet)
        self.user_effects: list[psa.Component] = []
        self._misfits: list[str] = []
        if not self.effects:
            return
        from psa_casadi.model.user_effects import declared_effects, misfits

        read = [self.attempt(partial(declared_effects, module)) for module in self.effects]
        self.user_effects = [c for result in read for c in (result or {}).values()]
        self._misfits = misfits(self.user_effects)

    def effects_of_any_model(self) -> "list[psa.Component]":
        """Return the user's effects for a model that is no stack, which they need not fit."""
        self._misfits = []
        return self.user_effects

    def add(self, sentence: str) -> None:
        """Note one problem."""
        self._problems.append(sentence)

    def attempt(self, read: Callable[[], T]) -> T | None:
        """Return what `read` returns, or None after noting the problems it raised."""
        try:
            return read()
        except InputError as error:
            self._problems.extend(error.problems)
            return None

    def check(self) -> None:
        """Raise an `InputError` with all problems, if there are any."""
        if self._problems or self._misfits:
            raise InputError([*self._problems, *self._misfits])

    def ready(self, value: T | None) -> T:
        """Return what was read, None only with a problem; raises all of these as `check`."""
        self.check()
        return cast("T", value)

    def records(
        self,
        paths: Sequence[Path],
        reading: Reading,
        held_out: Sequence[Path] = (),
        others: Sequence[Path] = (),
    ) -> "list[psa.Record]":
        """Read records to fit, `fitted` of them, then those held out; none may come twice.

        A record to fit must have a voltage that changes, all must have a displacement. Nothing is
        read where --columns is not understood; it may name `others`, which are read elsewhere.
        """
        wanted = self.columns(reading.columns, [*paths, *held_out, *others])
        if wanted is None:
            return []
        records: list[psa.Record] = []
        for files, fitted in ((paths, True), (held_out, False)):
            read = partial(
                psa.read_records, files, need_excitation=fitted, columns=wanted,
                sample_time=reading.sample_time,
            )  # fmt: skip
            for record in (self.attempt(read) if files else None) or ():
                twin = next((r for r in records if r.sha256 == record.sha256), None)
                if twin is not None:
                    self.add(
                        f"{record.source}: holds the same data as {twin.source}; a record counts"
                        " once, and one that is held out cannot be fitted too: remove one of the"
                        " two."
                    )
                records.append(record)
                self.fitted += fitted
                for note in () if self.quiet else record.notes:
                    print_message(f"Note: {note}")
        return records

    def signals(
        self, model: "psa.Model", paths: Sequence[Path], reading: Reading
    ) -> "tuple[psa.Signals, ...]":
        """Read records of a model that is no stack, each in the units of its file."""
        if not paths:
            return ()
        read_signals = partial(psa.read_signals, paths, inputs=model.input_names, **vars(reading))
        read = self.attempt(partial(read_signals, outputs=model.output_names))
        lacks = [f"column '{n}' is missing" for n in model.input_names]
        if model.structure.foreign and any(q in p for q in lacks for p in self._problems):
            self.add("An input of the FMU that no record has is held by --value NAME=VALUE.")
        for note in [n for s in read or () for n in s.notes if not self.quiet]:
            print_message(f"Note: {note}")
        return read or ()

    def refuse(self, others: Mapping[str, object]) -> None:
        """Refuse the options with a value, which a model that is no stack does not take."""
        for option in [name for name, value in others.items() if value]:
            self.add(f"{option} does not apply to your model; leave it out.")

    def numbers(self, option: str, texts: Sequence[str] | None) -> dict[str, float]:
        """Return the numbers of an option NAME=VALUE that may be repeated."""
        form = f"NAME=VALUE, such as {option} mass=0.3"
        return {name: value for name, (value,) in self.named(option, texts, form).items()}

    def named(
        self, option: str, texts: Sequence[str] | None, form: str, counts: Container[int] = (1,)
    ) -> dict[str, tuple[float, ...]]:
        """Return the numbers of an option NAME=NUMBER:NUMBER, of which `counts` are allowed."""
        values: dict[str, tuple[float, ...]] = {}
        for text in texts or ():
            name, _, figures = text.partition("=")
            numbers: tuple[float, ...] = ()
            with suppress(ValueError):
                numbers = tuple(float(figure) for figure in figures.split(":"))
            if len(numbers) in counts and not any(map(math.isnan, numbers)):
                values[name.strip()] = numbers
            else:
                self.add(f"{option} is '{text}'; give {form}.")
        return values

    def columns(self, text: str | None, paths: Sequence[Path] | None = None) -> "ColumnMap | None":
        """Return the map of --columns, an empty one without it; None where it is wrong.

        A file that it names must be one of the `paths`, where these are known.
        """
        from psa_casadi.records.read.columns import files_named, parse_columns

        column_map = self.attempt(lambda: parse_columns(text)) if text is not None else {}
        named = files_named(column_map or {}) if paths is not None else set()
        for name in sorted(named - {p.name for p in paths or ()}):
            self.add(f"--columns: '{name}' is none of the files; give its name without a folder.")
        return column_map

    def model(self, path: Path | None) -> "psa.Model | None":
        """Read a stack's model; None where no file is named."""
        from psa_casadi.simulation.start import is_stack

        if path is None:
            return None
        model = self.attempt(lambda: psa.load_model(path, self.user_effects))
        if model is None:
            return None
        if not is_stack(model):
            self.add(
                f"{path}: this model has no voltage input or no displacement of a stack, so it is"
                " no stack; give a stack's file. Other models are for `psa identify`,"
                " `diagnose`, `batch`, `simulate`, `export`, `check` and `compare`."
            )
            return None
        return model

    def model_or_stack(
        self,
        path: Path | None,
        stack: str | None,
        *,
        any_model: bool = False,
        needed: bool = True,
    ) -> "psa.Model | None":
        """Read a model, or compose a named stack; one at most, and one where it is needed.

        With `any_model` the file need not hold a stack, and FILE.py:FUNCTION makes the model.
        """
        if path is not None and stack is not None:
            self.add("--model and --stack exclude each other; leave one out.")
            return None
        if stack is not None:
            return self.attempt(lambda: psa.stack_model(stack))
        if path is None:
            if needed:
                self.add(
                    "The model is missing; add --model MODEL.json, or --stack NAME (`psa stacks`)."
                )
            return None
        if any_model:
            read = partial(psa.load_model, path, self.user_effects)
            return self.attempt(lambda: from_python(path) or read())
        return self.model(path)

    def turns(self, history: str | None) -> tuple[float, ...]:
        """Return the voltages [V] of a history; none without one."""
        try:
            return tuple(float(part) for part in history.split(",")) if history is not None else ()
        except ValueError:
            self.add(
                f"--history is '{history}'; give voltages in V with commas between, such as 150,0."
            )
            return ()

    def started(self, model: "psa.Model | None", start: Start) -> "psa.Model | None":
        """Return a model that starts settled at a voltage after a history; as it is without one."""
        turns, voltage = self.turns(start.history), start.start_voltage
        if start.history is not None and voltage is None:
            self.add("--history needs --start-voltage, the voltage at which it ends.")
        if model is None or voltage is None or self._problems:
            return model
        return self.attempt(
            lambda: psa.settled_at(model, voltage, turns, sweep=start.sweep, rest=start.rest)
        )

    def published(self, model: "psa.Model | None", published: Published) -> "psa.Model | None":
        """Return a model with the statements of the options, else its former ones."""
        statements = {name: text for name, text in asdict(published).items() if text is not None}
        for name, text in statements.items():
            if not text.strip() or not text.isprintable():
                self.add(f"--{name} is {text!r}; give a text of one line, or leave it out.")
        if model is None:
            return None
        return replace(model, publication=replace(model.publication, **statements))

    def stiffness(self, value: float | None) -> None:
        """Demand the stiffness of a free stack, if there is one."""
        low, high = _STIFFNESSES
        if value is not None and not low <= value <= high:
            self.add(
                f"--stiffness is {value:g} N/m; give that of the free stack from its data sheet"
                f" ({low:.0e} to {high:.0e} N/m), such as 5e7, which is 50 N/um."
            )

    def outputs(
        self,
        named: Mapping[str, Path | None],
        inputs: Sequence[Path | None],
        output: tuple[str, ...] = ("",),
    ) -> None:
        """Demand that every output can be written, and that no two are one file or an input.

        Where the name of a page or a picture has an ending, it is one of theirs; so is that of the
        `output`: what it is, and its endings.
        """
        endings = {"--report": PAGE, "--figure": _PICTURE, "--output": output}
        sources = {p.resolve() for p in inputs if p is not None}
        taken: dict[Path, str] = {}
        for option, path in named.items():
            if path is None:
                continue
            where = path.resolve()
            what, *known = endings.get(option, ("",))
            if known and path.suffix and path.suffix.lower() not in known:
                self.add(f"{path}: {option} writes {what}, {' or '.join(known)}; name it so.")
            if where in taken:
                self.add(
                    f"{path}: both {taken[where]} and {option} name it; give each a separate file."
                )
            elif where in sources:
                self.add(f"{path}: {option} would overwrite an input; give another name.")
            taken[where] = option
            if reason := why_not_written(path):
                self.add(reason)
            elif not os.access(where.parent, os.W_OK):
                self.add(
                    f"{path}: cannot write, {where.parent} may not be written to; choose another"
                    " place."
                )


def meant(word: str, known: Iterable[str]) -> str:
    """Return the question whether the most similar of the known words is meant, or nothing."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"is '{near[0]}' meant? " if near else ""


def similar(word: str, known: Iterable[str], otherwise: str) -> str:
    """Return the question which of the known words is meant, `otherwise` where none is similar."""
    near = difflib.get_close_matches(word, list(known), n=3, cutoff=0.4)
    return f"did you mean {' or '.join(near)}?" if near else otherwise


def step_seconds(text: str, *, plain: bool = False) -> float:
    """Return the time [s] of a step, a number with its unit; a `plain` number is in seconds.

    Raises InputError for anything else.
    """
    from psa_casadi.common.units import parse_unit, to_si, units_of

    match = re.fullmatch(r"\s*(?P<number>[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(?P<unit>\D*)", text)
    try:
        number = float(match["number"]) if match else 0.0
    except ValueError:
        match = None
    if match and not match["unit"].strip():
        if plain:
            return number
        meant = " or ".join(f"{match['number']}{unit}" for unit in ("s", "ms", "us"))
        raise InputError(f"--step is '{text}', without a unit; type --step {meant}.")
    unit = parse_unit(match["unit"], "time").name if match else ""
    if unit not in units_of("time"):
        raise InputError(f"--step is '{text}'; give a number with a unit of time, such as 10us.")
    return float(to_si(number, unit))


_PYTHON = re.compile(r"(?P<file>.+\.py)(?::(?P<name>\w*))?", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class Fitting:
    """How a model that is no stack is fitted: keyword arguments of `psa.identify(model, records)`.

    Options:
        fmu: FMU of any tool, in the place of --model.
        free: Parameter of your model to fit, by default all that may be; repeat the option
            for several. Of an FMU whose description has no bounds for it, with these:
            NAME=LOW:HIGH.
        value: Value of a parameter of an FMU that replaces its default, NAME=VALUE, or of an input
            that no record has; repeat the option for several.
        zeros: Output of your model whose zero is unknown in each record; repeat the option
            for several.
        hold: What the inputs of your model do between samples; by default what the
            records make likelier.
        known_start: The records of your model start at its declared states.
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
) -> "psa.Model | None":
    """Return the model that a path names where it is no stack's; None for a stack's or none.

    Unless it is to be `fitted`, no parameter of an FMU is free.

    A model that cannot be made ends the command.
    """
    if fitting.fmu is not None and path is not None:
        inputs.add("--fmu and --model exclude each other; leave one of them out.")
    model = (
        None if (place := fitting.fmu or path) is None else _model(inputs, place, fitting, fitted)
    )
    if model is None or not model.structure.foreign:
        bounds = [text for text in fitting.free or () if "=" in text]
        for text in [*bounds, *(fitting.value or ())]:
            inputs.add(f"'{text}' applies to an FMU; add --fmu FILE.fmu.")
    if model is None:
        for name in fitting.words:
            option = name.replace("_", "-")
            inputs.add(f"--{option} applies to your model; add --model FILE.py:FUNCTION.")
    return model


def _model(inputs: Inputs, path: Path, fitting: Fitting, fitted: bool) -> "psa.Model | None":
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


def _imported(inputs: Inputs, path: Path, fitting: Fitting, fitted: bool) -> "psa.Model | None":
    """Return the model of an FMU, in whose names the parameters are that a fit is to find."""
    form, texts = "NAME=LOW:HIGH, such as --free mass=0.1:10", fitting.free or []
    bounds = inputs.named("--free", [t for t in texts if "=" in t], form, (2,))
    free: dict[str, Any] = {n.strip(): bounds.get(n.strip()) for n in fitting.words.get("free", ())}
    values = inputs.numbers("--value", fitting.value)
    inputs.check()
    return psa.fmu_model(path, free=(free or None) if fitted else {}, values=values)


def from_python(path: Path) -> "psa.Model | None":
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
    except Exception as error:  # the user's code may raise anything
        raise InputError(
            f"--model: {file} cannot make a model ({type(error).__name__}: {error}); correct it."
        ) from error
    if callable(made) and not isinstance(model, psa.Model):
        raise InputError(f"--model: {name} of {file} returns no psa.Model; let it return one.")
    if not isinstance(model, psa.Model):
        functions = [n for n, v in held.items() if getattr(v, "__module__", "") == file.stem]
        near = [*difflib.get_close_matches(name, functions, 1), *functions[::-1], "make"][0]
        known = f"; it has {quoted(functions)}" if functions else ""
        lacks = f"{file} has no function '{name}' that returns a model{known}. Name one that does"
        if not name:
            lacks = f"say which function of {file} returns the model{known}"
        raise InputError(f"--model: {lacks}, as {file}:{near}.")
    return model
