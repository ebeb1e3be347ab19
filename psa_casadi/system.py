"""The surroundings of a stack: parts, controllers, whole systems, and any other model."""

from psa_casadi.design.mechanism.mechanism import mechanism_model, port_model
from psa_casadi.model.components import BASE, COMPONENTS, SIMPLIFIED
from psa_casadi.model.nanopositioner import controller_for, margins_of, nanopositioner
from psa_casadi.model.ode_model import ode_model
from psa_casadi.model.parts import PARTS, compensator_for, part_model
from psa_casadi.model.system import System, connect
from psa_casadi.model.variables import Input, Output, Parameter, Publication, State

__all__ = [
    "BASE",
    "COMPONENTS",
    "PARTS",
    "SIMPLIFIED",
    "Input",
    "Output",
    "Parameter",
    "Publication",
    "State",
    "System",
    "compensator_for",
    "connect",
    "controller_for",
    "margins_of",
    "mechanism_model",
    "nanopositioner",
    "ode_model",
    "part_model",
    "port_model",
]
