"""What a command is given, checked as a whole before any long work starts."""

import difflib
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

from psa_casadi.cli.screen import tell
from psa_casadi.component import Component
from psa_casadi.errors import InputError
from psa_casadi.files import why_not_written
from psa_casadi.model.compose import Model
from psa_casadi.model.model_file import load_model
from psa_casadi.model.own_effects import known_effects, own_effects
from psa_casadi.model.parts import part_model
from psa_casadi.model.stacks import stack_model
from psa_casadi.records import Record, read_record, read_records
from psa_casadi.records.read.columns import ColumnMap, files_named, parse_columns
from psa_casadi.simulation.history import settled_at
from psa_casadi.units import parse_unit, to_si, units_of

T = TypeVar("T")


class Given:
    """Collects the problems of everything that a command is given, to tell them all at once."""

    def __init__(self, modules: Sequence[str] | None = None, *, quiet: bool = False) -> None:
        """Begin with the effects of the `modules` that --effects names.

        Unless `quiet`, what the reader took a record's columns for is told.
        """
        self._quiet, self.fitted = quiet, 0
        self._problems: list[str] = []
        read = [self.attempt(partial(own_effects, module)) for module in modules or ()]
        self.effects = [c for found in read for c in (found or {}).values()]

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
        if self._problems:
            raise InputError(self._problems)

    def records(
        self,
        paths: Sequence[Path],
        *,
        held_out: Sequence[Path] = (),
        columns: str | None = None,
        sample_time: float | None = None,
    ) -> list[Record]:
        """Read records to fit, `fitted` of them, then those held out; none may be given twice.

        A record to fit must have a voltage that changes, all must have a displacement. `columns` is
        what --columns says. Nothing is read where that is not understood. `sample_time` [s] gives
        the time, whatever the files say of it.
        """
        wanted = self.columns(columns, [*paths, *held_out])
        if wanted is None:
            return []
        found: list[Record] = []
        for files, fitted in ((paths, True), (held_out, False)):
            read = partial(
                read_records, files, need_excitation=fitted, columns=wanted, sample_time=sample_time
            )
            for record in (self.attempt(read) if files else None) or ():
                twin = next((r for r in found if r.sha256 == record.sha256), None)
                if twin is not None:
                    self.add(
                        f"{record.source}: holds the same data as {twin.source}; a record counts"
                        " once, and one that is held out cannot be fitted too: remove one of the"
                        " two."
                    )
                found.append(record)
                self.fitted += fitted
                for note in () if self._quiet else record.notes:
                    tell(f"Note: {note}")
        return found

    def voltage(
        self, path: Path, *, columns: str | None = None, sample_time: float | None = None
    ) -> Record | None:
        """Read a record whose voltage is to be applied; it need not have a displacement."""
        wanted = self.columns(columns, [path])
        if wanted is None:
            return None
        return self.attempt(
            lambda: read_record(
                path, need_displacement=False, columns=wanted, sample_time=sample_time
            )
        )

    def columns(self, text: str | None, paths: Sequence[Path] | None = None) -> ColumnMap | None:
        """Return what --columns says, nothing where it is left out; None where it is wrong.

        A file that it names must be one of the `paths`, where these are known.
        """
        found = self.attempt(lambda: parse_columns(text)) if text is not None else {}
        named = files_named(found or {}) if paths is not None else set()
        for name in sorted(named - {p.name for p in paths or ()}):
            self.add(f"--columns: '{name}' is none of the files; give its name without a folder.")
        return found

    def model(self, path: Path | None) -> Model | None:
        """Read a model that turns a voltage into a displacement; None where no file is named."""
        if path is None:
            return None
        model = self.attempt(lambda: load_model(path, self.effects))
        if model is None:
            return None
        if "voltage" not in model.input_names or "displacement" not in model.output_names:
            self.add(
                f"{path}: this model has no voltage input or no displacement output, so it is no"
                " stack; give a file that `psa identify` or `psa diagnose` wrote."
            )
            return None
        return model

    def searched(self, left_out: Sequence[str]) -> tuple[Component, ...]:
        """Return the effects to search, without those that --leave-out names."""
        known = known_effects(self.effects)
        for name in dict.fromkeys(left_out):
            if name not in known:
                self.add(
                    f"--leave-out: there is no effect '{name}'; {meant(name, known)}`psa effects`"
                    " lists them."
                )
        return tuple(c for n, c in known.items() if n not in left_out)

    def model_or_stack(
        self,
        path: Path | None,
        stack: str | None,
        *,
        part: str | None = None,
        any_model: bool = False,
        needed: bool = True,
    ) -> Model | None:
        """Read a model, or compose a named stack or part; one at most, and one where it is needed.

        With `any_model` the file need not hold a stack.
        """
        options = {"--model": path, "--stack": stack, "--part": part}
        given = [name for name, value in options.items() if value is not None]
        if len(given) > 1:
            all_of_them = "both" if len(given) == 2 else "all"
            self.add(f"{' and '.join(given)} are {all_of_them} given; leave one of them out.")
            return None
        if part is not None:
            return self.attempt(lambda: part_model(part))
        if stack is not None:
            return self.attempt(lambda: stack_model(stack))
        if path is None:
            if needed:
                self.add(
                    "No model is given; add --model MODEL.json, or --stack NAME (`psa stacks`)."
                )
            return None
        if any_model:
            return self.attempt(lambda: load_model(path, self.effects))
        return self.model(path)

    def numbers(self, text: str | None, option: str, what: str) -> tuple[float, ...]:
        """Return the numbers of a list with commas; none where it is not given."""
        try:
            return tuple(float(part) for part in text.split(",")) if text is not None else ()
        except ValueError:
            self.add(f"{option} is '{text}'; give {what} with commas between, such as 150,0.")
            return ()

    def priors(self, texts: Sequence[str]) -> tuple[dict[str, float], dict[str, float]]:
        """Return centres and widths of priors that are given as NAME=CENTRE:WIDTH."""
        centres: dict[str, float] = {}
        widths: dict[str, float] = {}
        for text in texts:
            name, _, figures = text.partition("=")
            centre, _, width = figures.partition(":")
            try:
                centres[name], widths[name] = float(centre), float(width)
            except ValueError:
                self.add(f"--prior is '{text}'; give NAME=CENTRE:WIDTH, such as k_L=7.3:0.1.")
        return centres, widths

    def fixed_step(self, text: str | None, *, wanted: bool) -> float | None:
        """Return the time [s] of a fixed step, where one is wanted."""
        if wanted != (text is not None):
            self.add("--solver fixed and --step belong together; give both or neither.")
        return self.attempt(lambda: step_seconds(text)) if text is not None and wanted else None

    def started(
        self, model: Model | None, voltage: float | None, history: str | None, **durations: float
    ) -> Model | None:
        """Return a model that starts settled at a voltage after a history; as it is without one."""
        turns = self.numbers(history, "--history", "voltages in V")
        if history is not None and voltage is None:
            self.add("--history needs --start-voltage, the voltage at which it ends.")
        if model is None or voltage is None or self._problems:
            return model
        return self.attempt(lambda: settled_at(model, voltage, turns, **durations))

    def published(self, model: Model | None, **said: str | None) -> Model | None:
        """Return a model that states what the options say, else what it stated before.

        `said` are fields of `Publication`; a text may not be empty or have line breaks.
        """
        for name, text in said.items():
            if text is not None and (not text.strip() or not text.isprintable()):
                self.add(f"--{name} is {text!r}; give a text of one line, or leave it out.")
        if model is None:
            return None
        given = {name: text for name, text in said.items() if text is not None}
        return replace(model, publication=replace(model.publication, **given))

    def stiffness(self, value: float | None) -> None:
        """Demand a positive stiffness, if one is given."""
        if value is not None and not 0.0 < value < float("inf"):
            self.add(
                f"--stiffness is {value:g} N/m; give the positive stiffness of the free stack from"
                " its data sheet, such as 5e7."
            )

    def outputs(self, named: Mapping[str, Path | None], inputs: Sequence[Path | None]) -> None:
        """Demand that every output can be written, and that no two are one file or an input."""
        sources = {p.resolve() for p in inputs if p is not None}
        taken: dict[Path, str] = {}
        for option, path in named.items():
            if path is None:
                continue
            where = path.resolve()
            if where in taken:
                self.add(
                    f"{path}: both {taken[where]} and {option} name it; give each its own file."
                )
            elif where in sources:
                self.add(f"{path}: {option} would overwrite an input; give another name.")
            taken[where] = option
            self._writable(path)

    def _writable(self, path: Path) -> None:
        reason = why_not_written(path)
        if reason:
            self.add(reason)
        elif not os.access(path.resolve().parent, os.W_OK):
            self.add(
                f"{path}: cannot write, {path.resolve().parent} may not be written to; choose"
                " another place."
            )


def meant(word: str, known: Iterable[str]) -> str:
    """Return the question whether the most similar of the known words is meant, or nothing."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"is '{near[0]}' meant? " if near else ""


def step_seconds(text: str) -> float:
    """Return the time [s] of a step that is given as a number with its unit; none is guessed.

    Raises InputError for anything else.
    """
    found = re.fullmatch(r"\s*(?P<number>[-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(?P<unit>\D*)", text)
    try:
        number = float(found["number"]) if found else 0.0
    except ValueError:
        found = None
    if found and not found["unit"].strip():
        meant = " or ".join(f"{found['number']}{unit}" for unit in ("s", "ms", "us"))
        raise InputError(f"--step is '{text}', without a unit; type --step {meant}.")
    unit = parse_unit(found["unit"], "time").name if found else ""
    if unit not in units_of("time"):
        raise InputError(f"--step is '{text}'; give a number with a unit of time, such as 10us.")
    return float(to_si(number, unit))
