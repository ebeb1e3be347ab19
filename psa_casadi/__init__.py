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
    from psa_casadi import datasets as datasets
    from psa_casadi import design as design
    from psa_casadi import online as online
    from psa_casadi import system as system
    from psa_casadi.any_model.diagnose import diagnose as diagnose
    from psa_casadi.any_model.diagnose import identify as identify
    from psa_casadi.any_model.identify import OdeIdentification as OdeIdentification
    from psa_casadi.any_model.result import OdeDiagnosis as OdeDiagnosis
    from psa_casadi.component import Component as Component
    from psa_casadi.component import Equations as Equations
    from psa_casadi.component import Symbols as Symbols
    from psa_casadi.components import BASE as BASE
    from psa_casadi.components import COMPONENTS as COMPONENTS
    from psa_casadi.components import SIMPLIFIED as SIMPLIFIED
    from psa_casadi.design.mechanism.mechanism import design_mechanism as design_mechanism
    from psa_casadi.design.mechanism.mechanism import mechanism_model as mechanism_model
    from psa_casadi.design.mechanism.mechanism import port_model as port_model
    from psa_casadi.design.online.observer import FeedForward as FeedForward
    from psa_casadi.design.online.observer import HysteresisObserver as HysteresisObserver
    from psa_casadi.design.online.observer import stack_values as stack_values
    from psa_casadi.design.online.part_for import part_for as part_for
    from psa_casadi.design.online.recursive_least_squares import (
        AdaptiveFeedForward as AdaptiveFeedForward,
    )
    from psa_casadi.design.online.recursive_least_squares import (
        OnlineIdentification as OnlineIdentification,
    )
    from psa_casadi.design.online.recursive_least_squares import identifier_for as identifier_for
    from psa_casadi.devices.batch import BatchRun as BatchRun
    from psa_casadi.devices.batch import batch as batch
    from psa_casadi.devices.jobs import Job as Job
    from psa_casadi.devices.task import Options as Options
    from psa_casadi.diagnosis.result import Diagnosis as Diagnosis
    from psa_casadi.diagnosis.verdict import patched_model as patched_model
    from psa_casadi.effects import EFFECTS as EFFECTS
    from psa_casadi.errors import InputError as InputError
    from psa_casadi.errors import MachineError as MachineError
    from psa_casadi.errors import PsaError as PsaError
    from psa_casadi.export.check.check import CheckReport as CheckReport
    from psa_casadi.export.check.check import check_fmu as check_fmu
    from psa_casadi.export.fixed_step.export import CodeExport as CodeExport
    from psa_casadi.export.fixed_step.export import export_c as export_c
    from psa_casadi.export.fmu.archive import export_fmu as export_fmu
    from psa_casadi.export.importer.fmu_model import fmu_model as fmu_model
    from psa_casadi.export.modelica.package import export_modelica as export_modelica
    from psa_casadi.export.ssp.archive import export_ssp as export_ssp
    from psa_casadi.identification.identify import Identification as Identification
    from psa_casadi.identification.start.two_clocks import two_clocks as two_clocks
    from psa_casadi.model.compose import Model as Model
    from psa_casadi.model.compose import compose as compose
    from psa_casadi.model.model_file import load_model as load_model
    from psa_casadi.model.model_file import save_model as save_model
    from psa_casadi.model.nanopositioner import controller_for as controller_for
    from psa_casadi.model.nanopositioner import margins_of as margins_of
    from psa_casadi.model.nanopositioner import nanopositioner as nanopositioner
    from psa_casadi.model.ode_model import ode_model as ode_model
    from psa_casadi.model.own_effects import own_effects as own_effects
    from psa_casadi.model.parts import PARTS as PARTS
    from psa_casadi.model.parts import compensator_for as compensator_for
    from psa_casadi.model.parts import part_model as part_model
    from psa_casadi.model.stacks import STACKS as STACKS
    from psa_casadi.model.stacks import stack_model as stack_model
    from psa_casadi.model.system import System as System
    from psa_casadi.model.system import connect as connect
    from psa_casadi.posterior.result import Posterior as Posterior
    from psa_casadi.posterior.sample import sample as sample
    from psa_casadi.records import Record as Record
    from psa_casadi.records import read_record as read_record
    from psa_casadi.records import read_records as read_records
    from psa_casadi.records import record_from as record_from
    from psa_casadi.records import write_record as write_record
    from psa_casadi.records.signals import Signals as Signals
    from psa_casadi.report.documents.findings import read_findings as read_findings
    from psa_casadi.report.documents.reading import load_diagnosis as load_diagnosis
    from psa_casadi.report.page.devices import write_comparison as write_comparison
    from psa_casadi.report.page.devices import write_population as write_population
    from psa_casadi.report.page.results import write_fit_report as write_fit_report
    from psa_casadi.report.page.results import write_report as write_report
    from psa_casadi.report.plots.figures import save_figure as save_figure
    from psa_casadi.report.shown import report as report
    from psa_casadi.report.words.text import story as story
    from psa_casadi.simulation.many import simulate_many as simulate_many
    from psa_casadi.simulation.simulate import Trajectory as Trajectory
    from psa_casadi.simulation.simulate import memory_after as memory_after
    from psa_casadi.simulation.simulate import settled_at as settled_at
    from psa_casadi.simulation.simulate import simulate as simulate
    from psa_casadi.simulation.simulate import simulate_record as simulate_record
    from psa_casadi.simulation.stepper import run as run
    from psa_casadi.simulation.timings import Timings as Timings
    from psa_casadi.simulation.timings import timed as timed
    from psa_casadi.variables import Input as Input
    from psa_casadi.variables import Output as Output
    from psa_casadi.variables import Parameter as Parameter
    from psa_casadi.variables import Publication as Publication
    from psa_casadi.variables import State as State

#: Where each public name lives, in the order of the workflow.
_HOMES = {
    "psa_casadi.records": ("Record", "read_record", "read_records", "record_from", "write_record"),
    "psa_casadi.records.signals": ("Signals",),
    "psa_casadi.identification.start.two_clocks": ("two_clocks",),
    "psa_casadi.components": ("BASE", "SIMPLIFIED", "COMPONENTS"),
    "psa_casadi.effects": ("EFFECTS",),
    "psa_casadi.component": ("Component", "Equations", "Symbols"),
    "psa_casadi.model.own_effects": ("own_effects",),
    "psa_casadi.diagnosis.verdict": ("patched_model",),
    "psa_casadi.model.stacks": ("STACKS", "stack_model"),
    "psa_casadi.model.compose": ("Model", "compose"),
    "psa_casadi.model.parts": ("PARTS", "part_model", "compensator_for"),
    "psa_casadi.model.nanopositioner": ("controller_for", "margins_of", "nanopositioner"),
    "psa_casadi.model.system": ("System", "connect"),
    "psa_casadi.model.ode_model": ("ode_model",),
    "psa_casadi.export.importer.fmu_model": ("fmu_model",),
    "psa_casadi.variables": ("Input", "Output", "Parameter", "Publication", "State"),
    "psa_casadi.model.model_file": ("load_model", "save_model"),
    "psa_casadi.simulation.simulate": (
        "Trajectory",
        "simulate",
        "simulate_record",
        "memory_after",
        "settled_at",
    ),
    "psa_casadi.simulation.many": ("simulate_many",),
    "psa_casadi.simulation.stepper": ("run",),
    "psa_casadi.identification.identify": ("Identification",),
    "psa_casadi.any_model.identify": ("OdeIdentification",),
    "psa_casadi.any_model.diagnose": ("identify", "diagnose"),
    "psa_casadi.posterior.sample": ("sample",),
    "psa_casadi.posterior.result": ("Posterior",),
    "psa_casadi.diagnosis.result": ("Diagnosis",),
    "psa_casadi.any_model.result": ("OdeDiagnosis",),
    "psa_casadi.report.documents.reading": ("load_diagnosis",),
    "psa_casadi.simulation.timings": ("timed", "Timings"),
    "psa_casadi.report.words.text": ("story",),
    "psa_casadi.report.plots.figures": ("save_figure",),
    "psa_casadi.report.page.results": ("write_report", "write_fit_report"),
    "psa_casadi.devices.batch": ("batch", "BatchRun"),
    "psa_casadi.devices.jobs": ("Job",),
    "psa_casadi.devices.task": ("Options",),
    "psa_casadi.report.documents.findings": ("read_findings",),
    "psa_casadi.report.page.devices": ("write_comparison", "write_population"),
    "psa_casadi.design.online.observer": ("HysteresisObserver", "FeedForward", "stack_values"),
    "psa_casadi.design.online.recursive_least_squares": (
        "OnlineIdentification",
        "AdaptiveFeedForward",
        "identifier_for",
    ),
    "psa_casadi.design.online.part_for": ("part_for",),
    "psa_casadi.design.mechanism.mechanism": ("design_mechanism", "mechanism_model", "port_model"),
    "psa_casadi.export.fmu.archive": ("export_fmu",),
    "psa_casadi.export.fixed_step.export": ("CodeExport", "export_c"),
    "psa_casadi.export.modelica.package": ("export_modelica",),
    "psa_casadi.export.ssp.archive": ("export_ssp",),
    "psa_casadi.export.check.check": ("CheckReport", "check_fmu"),
    "psa_casadi.errors": ("InputError", "MachineError", "PsaError"),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}
#: Packages and modules that are public as such; `report` is called too.
_SPACES = ("datasets", "design", "online", "report", "system")
__all__ = [*_HOME_OF, *_SPACES, "__version__"]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    """Load a public name from where it lives."""
    if name in _SPACES:
        return import_module(f"psa_casadi.{name}")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'psa_casadi' has no attribute '{name}'")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def _show(what: str, *given: Any, **options: Any) -> Any:
    """Make what a result shows of itself."""
    return getattr(import_module("psa_casadi.report.shown"), what)(*given, **options)


psa_casadi.shown.register(_show)


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted(__all__)
