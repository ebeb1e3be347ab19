"""A command is a function: its docstring describes its arguments, under `Options:`.

What to type, under `Example:`, is the end of its help.

Arguments before the star are words of the command line, those behind it options. One whose type is
a dataclass means the options that are its fields. The usual text of options that several commands
have:

Options:
    records: Records of one device: CSV, Excel, MATLAB and other files.
    model: MODEL.json, as `psa identify`, `psa diagnose` and `psa design` write it.
    stack: Named stack in place of a model; `psa stacks` lists them.
    part: Part to export, tuned to the stack of --stack or --model if specified:
        position_controller, hysteresis_compensator, hysteresis_observer, feed_forward,
        adaptive_feed_forward, online_identification. Others have their default values:
        flexure_stage, voltage_amplifier, charge_amplifier, prestress_mechanism.
    platforms: host, all, or names such as x86_64-linux,x86_64-windows.
    include_sensor: Keep effects of sensor and environment.
    stiffness: Stiffness of the free stack [N/m]; fixes the force scale.
    hysteresis: Form of the base's hysteresis; best is the one that the records prefer. By default
        Bouc-Wen, or as the model has it.
    origin: What the report calls the records.
    still: Page without the model that runs in it: nothing is compiled for it.
    junit: JUnit XML to write, which CI servers show as tests.
    columns: Which array of the file is which column, if the names differ:
        time=t:ms,voltage=log.u,displacement=m.2:um. A number states what 1 in the file is:
        displacement=CH2:10um. FILE@NAME applies to one file: b.csv@time=t:ms; table=2 takes one of
        several tables in a file, table=all each as a record.
    effects: Module that holds your effects, as in mypackage.effects; repeat the option for
        several.
    quiet: No progress and no summary; errors still show.
"""

import inspect
import re
import sys
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, is_dataclass
from importlib import import_module
from typing import Annotated, Any, Literal, get_args

import typer
from typer.models import ParameterInfo

from psa_casadi.cli.failures import guarded

_ENTRY = re.compile(r"^    (\w+): (.*(?:\n {8,}.*)*)", re.MULTILINE)


def command(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function as typer takes it, with its errors as sentences."""
    about, own_helps = _described(function)
    helps = {**_SHARED, **own_helps}
    parameters: list[inspect.Parameter] = []
    groups: dict[str, tuple[Any, tuple[str, ...]]] = {}
    for p in inspect.signature(function).parameters.values():
        if is_dataclass(p.annotation):
            group: Any = p.annotation
            fields = inspect.signature(group).parameters
            groups[p.name] = group, tuple(fields)
            table = {**_SHARED, **_described(group)[1], **own_helps}
            parameters += [_declared(q, table) for q in fields.values()]
        else:
            parameters.append(_declared(p, helps))

    def run(**options: Any) -> None:
        for name, (group, fields) in groups.items():
            options[name] = group(**{q: options.pop(q) for q in fields})
        function(**options)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__doc__, run.__name__ = about, function.__name__
    return guarded(run)


def _described(described: object) -> tuple[str, dict[str, str]]:
    """Return a docstring without its section of options, and the text of each."""
    doc, _, _ = (inspect.getdoc(described) or "").partition("\n\nExample:\n")
    about, _, section = doc.partition("\n\nOptions:\n")
    return about, {name: " ".join(text.split()) for name, text in _ENTRY.findall(section)}


_SHARED = _described(sys.modules[__name__])[1]


def _declared(p: inspect.Parameter, helps: dict[str, str]) -> inspect.Parameter:
    """Return a parameter with what typer is to know of it; a flag that is off has no opposite."""
    if p.annotation is typer.Context:
        return p.replace(kind=inspect.Parameter.KEYWORD_ONLY)
    option = p.kind is inspect.Parameter.KEYWORD_ONLY
    settings = getattr(p.annotation, "__metadata__", ())
    plain = typer.Option() if option else typer.Argument(show_default=False)
    known: ParameterInfo = copy(settings[0] if settings else plain)
    if option and known.default is ...:
        name = p.name.strip("_").replace("_", "-")
        off = f"/--no-{name}" if p.default is True else ""
        short = [f"-{name[0]}"] if name in ("output", "quiet") else []
        known.param_decls = [*short, f"--{name}{off}"]
    known.help = known.help or helps.get(p.name)  # there are none with `python -OO`
    kind = get_args(p.annotation)[0] if settings else p.annotation
    return p.replace(annotation=Annotated[kind, known], kind=inspect.Parameter.KEYWORD_ONLY)


#: Where the names of each kind are; a module loads when it is needed.
_KNOWN = {
    "stacks": ("psa_casadi.model.stacks", "STACKS"),
    "effects": ("psa_casadi.model.effects", "EFFECTS"),
    "parts": ("psa_casadi.model.parts", "PARTS"),
    "datasets": ("psa_casadi.datasets", "DATASETS"),
    "examples": ("psa_casadi.examples.index", "examples"),
    "verdicts": ("psa_casadi.report.words.verdict_words", "VERDICTS"),
}


def names(kind: str) -> Callable[[str], list[str]]:
    """Return what completes the names of a kind for a shell, those behind a comma too."""

    def complete(incomplete: str) -> list[str]:
        module, name = _KNOWN[kind]
        known = getattr(import_module(module), name)
        before, comma, word = incomplete.rpartition(",")
        started = (k for k in (known() if callable(known) else known) if k.startswith(word))
        return [f"{before}{comma}{k}" for k in started]

    return complete


StackName = Annotated[str | None, typer.Option(autocompletion=names("stacks"))]
PartName = Annotated[str | None, typer.Option(autocompletion=names("parts"))]
Hysteresis = Literal["bouc-wen", "spectrum", "best"] | None
Origin = Literal["measured", "synthetic"]


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How the columns of records are read.

    Options:
        sample_time: Time from sample to sample [s]; it goes before a file's.
    """

    columns: str | None = None
    sample_time: float | None = None


@dataclass(frozen=True, kw_only=True)
class Start:
    """The start of a run.

    Options:
        start_voltage: Voltage [V] that holds the stack when it starts, settled, with the memory
            that --history leaves; by default it starts relaxed at 0 V.
        history: Earlier voltages [V], swept in turn from a relaxed 0 V, such as 120,0,120.
        sweep: Duration of each sweep of the history [s]; it matters to delta and creep.
        rest: Rest after the history [s].
    """

    start_voltage: float | None = None
    history: str | None = None
    sweep: float = 1.0
    rest: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Published:
    """What an export states of a model: fields of `Publication`.

    Options:
        author: Author to state; by default the model file's.
        version: Version of the model to state; by default the model file's.
        copyright: Copyright of the model; by default the model file's.
        license: Licence of the model; by default the model file's. The C code stays BSD 3-Clause.
    """

    author: str | None = None
    version: str | None = None
    copyright: str | None = None
    license: str | None = None
