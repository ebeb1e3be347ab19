"""Field-dependent capacitance: the stack takes more charge per volt at high voltage.

dq/du = C_p (1 + capacitance_gain |u|/u_rated), Rayleigh's law of the polarisation. The displacement
shows no more of it than a drive whose lag grows with the voltage, so that it is looked for where a
charge or a current was measured.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.smooth import smooth_magnitude
from psa_casadi.variables import Parameter

#: Width of the smooth magnitude, over rated voltage.
_WIDTH = 1e-3


def _field_dependent_capacitance(s: Symbols) -> Equations:
    """Field-dependent capacitance: the stack takes more charge per volt at high voltage.

    dq/du = C_p (1 + capacitance_gain |u|/u_rated), Rayleigh's law of the polarisation. The
    displacement shows no more of it than a drive whose lag grows with the voltage, so that it is
    looked for where a charge or a current was measured.
    """
    share = smooth_magnitude(s.u, _WIDTH * s.u_rated) / s.u_rated
    grown = s.capacitance_gain * share
    return Equations(
        add={
            "voltage_rate": -s.stack_current / s.C_p * grown / (1 + grown),
            "stack_charge": 0.5 * s.C_p * s.u * grown,
        }
    )


FIELD_DEPENDENT_CAPACITANCE = Component(
    name="field_dependent_capacitance",
    description="the capacitance of the stack grows with the voltage",
    source=(
        "Rayleigh's law of the permittivity: Hall, J. Mater. Sci. 36 (2001) 4575; large-signal"
        " capacitance in data sheets of stacks"
    ),
    gain="capacitance_gain",
    equation_text="C_p u' = i/(1 + capacitance_gain |u|/u_rated)",
    parameters=(
        Parameter(
            "capacitance_gain",
            0.0,
            "1",
            (0.0, 3.0),
            "growth of the capacitance at rated voltage",
            scale=0.1,
        ),
    ),
    equations=_field_dependent_capacitance,
    needs_column=("charge", "current"),
    remedy=Remedy("control_charge", "slew"),
    looks_like="charge per volt grows with the amplitude; the drive's lag grows with the voltage",
)
