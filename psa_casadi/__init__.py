"""psa_casadi: what a piezoelectric stack actuator's simulation gets wrong, found in measured data.

The public names, in the order of the workflow:

    import psa_casadi as psa

    record = psa.read_record("record.csv")
    fitted = psa.identify([record])                 # parameters with intervals
    result = psa.diagnose([record])                 # what is missing, the cause, the gain
    psa.write_report(result, "report.html")
    psa.save_model(result.model, "extended.json")
    psa.export_fmu(result.model, "extended.fmu")
    psa.check_fmu("extended.fmu", result.model).passed
    psa.export_modelica(result.model, "PiezoStack.mo")

`psa.design` holds designed experiments, inputs and mechanisms, `psa.system` what surrounds a
stack, `psa.online` observers and feed-forward for use in a loop. `__init__.pyi` lists all names and
their modules. Each name is loaded when it is first used, so that importing the package is quick.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

_LISTED = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
#: The modules of the public names.
_HOMES = {name: home for home, name in re.findall(r"^from (\S+) import (\w+) as", _LISTED, re.M)}
__all__ = list(_HOMES)


def __getattr__(name: str) -> Any:
    """Load a public name from its module; packages that are public are loaded as such."""
    if name not in _HOMES:
        raise AttributeError(f"module 'psa_casadi' has no attribute '{name}'")
    if _HOMES[name] == "psa_casadi" or name == "report":  # a package that is called, too
        return import_module(f"psa_casadi.{name}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted(__all__)
