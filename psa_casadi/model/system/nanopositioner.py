"""A closed-loop nanopositioner: controller, compensator, amplifier, stack and flexure stage."""

from psa_casadi.model.compose import Model
from psa_casadi.model.parts import compensator_for, part_model
from psa_casadi.model.stacks import stack_model
from psa_casadi.model.system.system import System
from psa_casadi.model.system.tuning import controller_for

__all__ = ["nanopositioner", "positioner_plant"]

#: Command [V] at which the amplifier puts out the stack's rated voltage.
_FULL_COMMAND = 10.0
#: Lowest voltage of the amplifier over the rated voltage of the stack: PICMA stacks take -20 V.
_LOWEST = -1.0 / 6.0


def nanopositioner(
    stack: str | Model = "P-885.51",
    *,
    compensated: bool = True,
    compensator_stack: Model | None = None,
    sample_time: float = 5e-5,
    sensitivity: float = 1.6,
) -> System:
    """Return the closed loop around a stack, by name or as a model, as parts and wires.

    The input is `reference` [m]; the outputs are `stage_position` [m], `command` [V] of the
    controller, `voltage` [V] at the stack's input and `stack_displacement` [m]. Without
    `compensated` the controller drives the amplifier itself. The controller is tuned to the
    compensated plant either way: its slope is the steepest that the loop meets, so that both loops
    keep the margins. `compensator_stack` is what the compensator takes for the stack, by default
    the stack itself.

    Raises InputError, as `stack_model`, `compensator_for` and `controller_for` do.
    """
    plant = positioner_plant(stack).model()
    controller = controller_for(
        plant,
        position="stage_position",
        sample_time=sample_time,
        sensitivity=sensitivity,
        lowest_command=_LOWEST * _FULL_COMMAND,
        highest_command=_FULL_COMMAND,
    )
    open_loop = positioner_plant(
        stack, compensated=compensated, compensator_stack=compensator_stack
    )
    return System(
        name="nanopositioner",
        description=f"closed-loop nanopositioner around the stack {open_loop.parts['stack'].name}",
        parts={"controller": controller, **open_loop.parts},
        wires=(
            ("controller.command", open_loop.inputs["command"]),
            *open_loop.wires,
            ("flexure.stage_position", "controller.position"),
        ),
        inputs={"reference": "controller.reference"},
        outputs={**open_loop.outputs, "command": "controller.command"},
    )


def positioner_plant(
    stack: str | Model = "P-885.51",
    *,
    compensated: bool = True,
    compensator_stack: Model | None = None,
) -> System:
    """Return what the controller drives: compensator, amplifier, stack and flexure stage.

    The input is `command` [V]; the outputs are those of `nanopositioner` but for the command.
    """
    actuator = (stack_model(stack) if isinstance(stack, str) else stack).plant()
    rated = actuator.values["u_rated"]
    amplifier = part_model(
        "voltage_amplifier",
        gain=rated / _FULL_COMMAND,
        lowest_output=_LOWEST * rated,
        highest_output=rated,
        load_capacitance=actuator.values["C_p"],
    )
    parts = {"amplifier": amplifier, "stack": actuator, "flexure": part_model("flexure_stage")}
    wires: tuple[tuple[str, str], ...] = (
        ("amplifier.output_voltage", "stack.voltage"),
        ("stack.displacement", "flexure.tip_position"),
        ("stack.velocity", "flexure.tip_velocity"),
        ("flexure.reaction_force", "stack.load_force"),
    )
    command = "amplifier.command"
    if compensated:
        compensator = compensator_for(
            compensator_stack or actuator,
            amplifier_gain=amplifier.values["gain"],
            amplifier_bandwidth=amplifier.values["bandwidth"],
        )
        parts = {"compensator": compensator, **parts}
        wires = (("compensator.compensated_command", command), *wires)
        command = "compensator.command"
    return System(
        name="positioner_plant",
        description=f"amplifier, stack {actuator.name} and flexure stage",
        parts=parts,
        wires=wires,
        inputs={"command": command},
        outputs={
            "stage_position": "flexure.stage_position",
            "voltage": "amplifier.output_voltage",
            "stack_displacement": "stack.displacement",
        },
    )
