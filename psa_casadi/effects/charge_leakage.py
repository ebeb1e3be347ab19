"""Charge leakage: a charge drive holds its charge only for a while.

A charge amplifier puts a charge proportional to its command on the stack. A resistor R across the
capacitance that sets the charge keeps its offset from drifting away, and makes it a high-pass of
time constant R C: q' = C G v' - q/(R C). So after a step the stack droops with exp(-t/leak_time),
and below 1/(2 pi leak_time) the gain falls to 1 - leak_gain: 0 for plain leakage, more where the
amplifier goes over to controlling the voltage. z is the part that leaks: 0 after a step, G v long
after it. A record may begin before it has settled, so z is a memory.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.scales import voltage_scale
from psa_casadi.variables import Parameter, State


def _charge_leakage(s: Symbols) -> Equations:
    """Charge leakage: a charge drive holds its charge only for a while.

    A charge amplifier puts a charge proportional to its command on the stack. A resistor R across
    the capacitance that sets the charge keeps its offset from drifting away, and makes it a
    high-pass of time constant R C: q' = C G v' - q/(R C). So after a step the stack droops with
    exp(-t/leak_time), and below 1/(2 pi leak_time) the gain falls to 1 - leak_gain: 0 for plain
    leakage, more where the amplifier goes over to controlling the voltage. z is the part that
    leaks: 0 after a step, G v long after it. A record may begin before it has settled, so z is a
    memory.
    """
    return Equations(
        der={"leak_voltage": (s.G * s.voltage - s.leak_voltage) / s.leak_time},
        add={"drive_voltage": -s.leak_gain * s.leak_voltage},
    )


CHARGE_LEAKAGE = Component(
    name="charge_leakage",
    description="a charge drive loses charge through its stabilising resistor",
    source=(
        "charge amplifier as a high-pass: Fleming and Moheimani, Rev. Sci. Instrum. 76 (2005)"
        " 073707"
    ),
    belongs_to="drive",
    gain="leak_gain",
    equation_text="drive voltage = G v - leak_gain z,  leak_time z' + z = G v",
    parameters=(
        Parameter(
            "leak_gain", 0.0, "1", (0.0, 1.0), "share of the charge that leaks away", scale=0.01
        ),
        Parameter("leak_time", 3.0, "s", (1e-3, 1e5), "time constant of the leakage", log=True),
    ),
    states=(State("leak_voltage", "V", "part that leaks away", voltage_scale, memory=True),),
    equations=_charge_leakage,
    finite_step=(1.0, 100.0),  # plain leakage takes the whole charge: far from a derivative at 0
    probe={"leak_time": (0.3, 3.0, 30.0)},
    remedy=Remedy("hold_charge", "hold"),
    looks_like="droop back after every step, exponential in time; less stroke at low frequencies",
)
