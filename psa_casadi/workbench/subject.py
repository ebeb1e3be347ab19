"""The model whose records the page diagnoses."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from psa_casadi.records.record import COLUMNS
from psa_casadi.units import parse_unit, units_of


@dataclass(frozen=True)
class Subject:
    """The model whose records are diagnosed; without inputs and outputs it is a stack's.

    `units` are those of its inputs and outputs. `arguments` name it to the command `psa diagnose`,
    `files` are those beside which the command runs.
    """

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()

    @property
    def columns(self) -> dict[str, list[str]]:
        """The columns of its records, each with the units that it may have, the model's first."""
        if not self.units:
            return {n: [u for q in c.quantities for u in units_of(q)] for n, c in COLUMNS.items()}
        units = {n: units_of(parse_unit(u).quantity) for n, u in self.units.items()}
        columns = {n: list(dict.fromkeys([u, *units[n]])) for n, u in self.units.items()}
        return {"time": list(units_of("time")), **columns}
