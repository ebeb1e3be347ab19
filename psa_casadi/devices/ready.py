"""The models of a batch compiled once, on all cores, before its processes begin to need them."""

from contextlib import suppress

from psa_casadi.devices.jobs import Job, Options
from psa_casadi.errors import MachineError, PsaError
from psa_casadi.identification.start.ordinary import starting_model
from psa_casadi.model.own_effects import known_effects, own_effects
from psa_casadi.records import read_records
from psa_casadi.simulation.ahead import compiled


def make_ready(job: Job, options: Options) -> None:
    """Compile what the first device will need; what fails is told by the device's own work.

    They lie in the cache of the user, where every process on this machine finds them.
    """
    with suppress(PsaError, MachineError):
        records = read_records(job.files, columns=options.columns, sample_time=options.sample_time)
        start = starting_model(records, options.stiffness)
        models = [start]
        if options.work == "diagnose":
            own = [c for module in options.modules for c in own_effects(module).values()]
            table = known_effects(own).values()
            models += [start.with_effect(e) for e in table if not e.needs_column]
        compiled(models)
