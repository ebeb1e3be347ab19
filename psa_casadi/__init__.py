"""psa_casadi: what a piezoelectric stack actuator's simulation gets wrong, found in measured data.

The public names, in the order of the workflow:

    import psa_casadi as psa

    record = psa.read_record("record.csv")
    found = psa.identify([record])                  # parameters with intervals
    result = psa.diagnose([record])                 # what is missing, the cause, the gain
    psa.write_report(result, "report.html")
    psa.save_model(result.model, "extended.json")
    psa.export_fmu(result.model, "extended.fmu")
    psa.check_fmu("extended.fmu", result.model).passed
    psa.export_modelica(result.model, "PiezoStack.mo")

`psa.design` holds designed experiments, inputs and mechanisms, `psa.system` what stands around a
stack, `psa.online` observers and feed-forward for use in a loop. Each name is loaded when it is
first used, so that importing the package is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import psa_casadi.shown  # where the reports are registered
from psa_casadi.version import __version__

if TYPE_CHECKING:
    from psa_casadi import datasets, design, online, system
    from psa_casadi.component import Component, Equations, Symbols
    from psa_casadi.components import BASE, COMPONENTS, SIMPLIFIED
    from psa_casadi.design.linear import Linear, linearize, margins, observer
    from psa_casadi.design.mechanism.mechanism import (
        design_mechanism,
        mechanism_model,
        port_model,
    )
    from psa_casadi.devices.batch import BatchRun, batch
    from psa_casadi.devices.jobs import Job, Options
    from psa_casadi.diagnosis.result import Diagnosis, StackDiagnosis
    from psa_casadi.diagnosis.verdict import patched_model
    from psa_casadi.effects import EFFECTS
    from psa_casadi.errors import InputError, MachineError, PsaError
    from psa_casadi.export.check.check import CheckReport, check_fmu
    from psa_casadi.export.extended import export_extended
    from psa_casadi.export.fixed_step.export import CodeExport, export_c
    from psa_casadi.export.fmu.archive import export_fmu
    from psa_casadi.export.importer.fmu_model import fmu_model, load_model
    from psa_casadi.export.importer.start_values import save_start_values
    from psa_casadi.export.modelica.package import export_modelica
    from psa_casadi.export.ssp import export_ssp
    from psa_casadi.faces import diagnose, identify
    from psa_casadi.identification.identify import StackIdentification
    from psa_casadi.identification.result import Identification
    from psa_casadi.identification.start.two_clocks import two_clocks
    from psa_casadi.model.compose import Model, compose
    from psa_casadi.model.model_file import save_model
    from psa_casadi.model.nanopositioner import controller_for, margins_of, nanopositioner
    from psa_casadi.model.ode_model import ode_model
    from psa_casadi.model.own_effects import own_effects
    from psa_casadi.model.parts import PARTS, compensator_for, part_model
    from psa_casadi.model.stacks import STACKS, stack_model
    from psa_casadi.model.system import System, connect
    from psa_casadi.model.table import table
    from psa_casadi.online import (
        AdaptiveFeedForward,
        FeedForward,
        HysteresisObserver,
        OnlineIdentification,
        identifier_for,
        part_for,
        stack_values,
    )
    from psa_casadi.posterior.sample import Posterior, sample
    from psa_casadi.records import (
        Record,
        read_record,
        read_records,
        read_signals,
        record_from,
        write_record,
    )
    from psa_casadi.records.signals import Signals
    from psa_casadi.report.documents.files import load_diagnosis
    from psa_casadi.report.documents.findings import read_findings
    from psa_casadi.report.page.devices import (
        Comparison,
        compare,
        write_comparison,
        write_population,
    )
    from psa_casadi.report.page.results import write_fit_report, write_report
    from psa_casadi.report.plots.figures import save_figure
    from psa_casadi.report.shown import report
    from psa_casadi.report.words.text import story
    from psa_casadi.simulation.many import simulate_many
    from psa_casadi.simulation.simulate import (
        Trajectory,
        memory_after,
        settled_at,
        simulate,
        simulate_record,
    )
    from psa_casadi.simulation.stepper import run
    from psa_casadi.simulation.timings import Timings, timed
    from psa_casadi.variables import Input, Output, Parameter, Publication, State

#: Where the public names live, by the modules of this package.
_HOMES = {
    "records": "Record read_record read_records read_signals record_from write_record",
    "records.signals": "Signals",
    "components": "BASE SIMPLIFIED COMPONENTS",
    "effects": "EFFECTS",
    "component": "Component Equations Symbols",
    "identification.start.two_clocks": "two_clocks",
    "identification.result": "Identification",
    "identification.identify": "StackIdentification",
    "model.own_effects": "own_effects",
    "model.stacks": "STACKS stack_model",
    "model.compose": "Model compose",
    "model.parts": "PARTS part_model compensator_for",
    "model.system": "System connect",
    "model.nanopositioner": "controller_for margins_of nanopositioner",
    "model.ode_model": "ode_model",
    "model.table": "table",
    "model.model_file": "save_model",
    "design.linear": "Linear linearize margins observer",
    "design.mechanism.mechanism": "design_mechanism mechanism_model port_model",
    "online": "HysteresisObserver FeedForward stack_values part_for OnlineIdentification"
    " AdaptiveFeedForward identifier_for",
    "variables": "Input Output Parameter Publication State",
    "simulation.many": "simulate_many",
    "simulation.stepper": "run",
    "simulation.timings": "Timings timed",
    "simulation.simulate": "Trajectory memory_after settled_at simulate simulate_record",
    "faces": "identify diagnose",
    "posterior.sample": "Posterior sample",
    "diagnosis.verdict": "patched_model",
    "diagnosis.result": "Diagnosis StackDiagnosis",
    "report.words.text": "story",
    "report.plots.figures": "save_figure",
    "report.page.results": "write_report write_fit_report",
    "report.page.devices": "Comparison compare write_comparison write_population",
    "report.documents.findings": "read_findings",
    "report.documents.files": "load_diagnosis",
    "devices.batch": "BatchRun batch",
    "devices.jobs": "Job Options",
    "export.fixed_step.export": "CodeExport export_c",
    "export.fmu.archive": "export_fmu",
    "export.modelica.package": "export_modelica",
    "export.ssp": "export_ssp",
    "export.importer.fmu_model": "fmu_model load_model",
    "export.importer.start_values": "save_start_values",
    "export.extended": "export_extended",
    "export.check.check": "CheckReport check_fmu",
    "errors": "InputError MachineError PsaError",
}
_HOME_OF = {n: f"psa_casadi.{home}" for home, names in _HOMES.items() for n in names.split()}

__all__ = [
    "Record", "Signals", "read_record", "read_records", "read_signals", "record_from",
    "write_record",
    "two_clocks", "BASE", "SIMPLIFIED", "COMPONENTS", "EFFECTS", "Component", "Equations",
    "Symbols", "own_effects", "patched_model", "STACKS", "stack_model", "Model", "compose",
    "PARTS", "part_model", "compensator_for", "controller_for", "margins_of", "System", "connect",
    "nanopositioner", "ode_model", "table", "fmu_model",
    "save_start_values", "export_extended", "Input", "Output", "Parameter",
    "Publication", "State", "load_model", "save_model", "Trajectory", "simulate", "simulate_record",
    "simulate_many", "memory_after", "settled_at", "run", "Identification",
    "identify", "sample", "Posterior", "diagnose", "Diagnosis", "StackDiagnosis",
    "StackIdentification", "load_diagnosis",
    "timed", "Timings", "story", "report", "save_figure", "write_report", "write_fit_report",
    "batch", "BatchRun", "Job", "Options", "read_findings", "compare", "Comparison",
    "write_comparison",
    "write_population", "HysteresisObserver", "FeedForward", "stack_values",
    "OnlineIdentification", "AdaptiveFeedForward", "identifier_for", "part_for",
    "design_mechanism", "mechanism_model", "port_model", "export_fmu", "CodeExport", "export_c",
    "Linear", "linearize", "margins", "observer",
    "export_modelica", "export_ssp", "CheckReport", "check_fmu", "InputError", "MachineError",
    "PsaError", "datasets", "design", "online", "system", "__version__",
]  # fmt: skip
#: Packages and modules that are public as such; `report` is called too.
_SPACES = ("datasets", "design", "online", "report", "system")


def __getattr__(name: str) -> Any:
    """Load a public name from where it lives."""
    if name in _SPACES:
        return import_module(f"psa_casadi.{name}")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'psa_casadi' has no attribute '{name}'")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


#: Where texts are made, which need no pictures; all else that a result shows is in `report.shown`.
_TEXTS = {
    "note_text": "psa_casadi.report.words.notes",
    "told": "psa_casadi.report.words.text",
    "sentence_of": "psa_casadi.report.words.advice_words",
    "identification_file": "psa_casadi.report.documents.files",
}


def _show(what: str, *inputs: Any, **options: Any) -> Any:
    """Make what a result shows of itself."""
    module = import_module(_TEXTS.get(what, "psa_casadi.report.shown"))
    return getattr(module, what)(*inputs, **options)


psa_casadi.shown.register(_show)


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted(__all__)
