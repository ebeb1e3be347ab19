"""Temperature: the stack's length and its gain follow the record's temperature column.

A thermometer beside the stack leads it: stack and frame follow it through a lag, of milliseconds
where it sits on the ceramic, of minutes where it hangs in the room.

Sizes: a stack of length L moves 1.0e-3 to 1.3e-3 L at rated voltage. Poled multilayer ceramic
expands by -3.5e-6 L per kelvin along its length (co-fired) or +11e-6 L (glued high-voltage discs),
a steel frame by 11e-6 L: some -0.4 to +1.4 % of the stroke per kelvin. The piezoelectric
coefficient of soft PZT grows by one or a few tenths of a percent per kelvin. A kelvin is an
ordinary change in a laboratory and 0.1 % of the stroke is noticeable: 1e-3 per kelvin is ordinary.
"""

from psa_casadi.component import Component, Equations, Remedy, Symbols
from psa_casadi.effects.sizes import stroke
from psa_casadi.variables import Input, Parameter, State

_ROOM = 293.15


def _temperature(s: Symbols) -> Equations:
    """Temperature: the stack's length and its gain follow the record's temperature column.

    A thermometer beside the stack leads it: stack and frame follow it through a lag, of
    milliseconds where it sits on the ceramic, of minutes where it hangs in the room.

    Sizes: a stack of length L moves 1.0e-3 to 1.3e-3 L at rated voltage. Poled multilayer ceramic
    expands by -3.5e-6 L per kelvin along its length (co-fired) or +11e-6 L (glued high-voltage
    discs), a steel frame by 11e-6 L: some -0.4 to +1.4 % of the stroke per kelvin. The
    piezoelectric coefficient of soft PZT grows by one or a few tenths of a percent per kelvin. A
    kelvin is an ordinary change in a laboratory and 0.1 % of the stroke is noticeable: 1e-3 per
    kelvin is ordinary.
    """
    warmer = s.temperature - s.temperature_reference
    expansion = s.expansion_gain * s.stack_warmer
    return Equations(
        der={"stack_warmer": (warmer - s.stack_warmer) / s.temperature_lag},
        add={
            "measured_displacement": expansion * stroke(s),
            "free_force": expansion * s.temperature_gain_ratio * s.k_L * s.u,
        },
    )


TEMPERATURE = Component(
    name="temperature",
    description="length and gain of the stack follow its temperature",
    source="Physik Instrumente, piezo tutorial, Temperature Effects: expansion and piezo gain",
    belongs_to="environment",
    gain="expansion_gain",
    equation_text=(
        "x_m gains expansion_gain w stroke,  f_L gains temperature_gain_ratio expansion_gain w"
        " k_L u,  temperature_lag w' + w = T - temperature_reference"
    ),
    parameters=(
        Parameter("expansion_gain", 0.0, "1/K", (-0.1, 0.1), "expansion over stroke", scale=1e-3),
        Parameter(
            "temperature_gain_ratio",
            0.0,
            "1",
            (-100.0, 100.0),
            "relative change of the gain over the expansion over stroke",
            scale=1.0,
        ),
        Parameter(
            "temperature_lag",
            0.01,
            "s",
            (1e-4, 1e5),
            "time constant from the thermometer to the stack",
            log=True,
            limit=True,
        ),
        Parameter(
            "temperature_reference",
            _ROOM,
            "K",
            (0.0, 1000.0),
            "temperature at which nothing changes",
            scale=1.0,
            fitted=False,
        ),
    ),
    inputs=(Input("temperature", "K", "temperature of the stack", start=_ROOM, nominal=300.0),),
    states=(State("stack_warmer", "K", "temperature of the stack above the reference", 1.0),),
    equations=_temperature,
    probe={"temperature_gain_ratio": (-1.0, 0.0, 1.0), "temperature_lag": (0.01, 1.0)},
    remedy=Remedy("steady_surroundings", "record"),
    looks_like="the residual follows the temperature, by an offset and in proportion to the stroke",
)
