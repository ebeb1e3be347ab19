"""A closed-loop nanopositioner: controller, compensator, amplifier, stack and flexure stage."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy

from psa_casadi.common.errors import InputError, Problems, quoted
from psa_casadi.common.units import ComplexArray, FloatArray
from psa_casadi.model.compose import Model
from psa_casadi.model.parts import compensator_for, part_model
from psa_casadi.model.stacks import stack_model
from psa_casadi.model.system import System

#: A mode that is better damped needs no notch.
_DAMPED = 0.5


@dataclass(frozen=True)
class PlantResponse:
    """The response of a plant with held command on a grid, also on the unit circle; its modes."""

    period: float
    frequencies: FloatArray
    z: ComplexArray
    response: ComplexArray
    modes: tuple[tuple[float, float], ...]

    def resonance(self) -> tuple[float, float] | None:
        """Return frequency and damping of the light mode with the largest response, or None."""
        weak = [m for m in self.modes if m[1] < _DAMPED]
        if not weak:
            return None
        size = np.abs(self.response)
        return max(weak, key=lambda m: float(np.interp(m[0], self.frequencies, size)))


def plant_response(plant: Model, position: str | None, period: float, lag: float) -> PlantResponse:
    """Return the exactly discretised response of the plant, linearised, behind a lag [s]."""
    row = plant.output_names.index(position) if position else 0
    A, B, C, _ = (np.array(m, dtype=float) for m in plant.structure.slopes(*plant.at_start()))
    size, n = plant.state_nominals(), len(A) + 1
    A, B, C = A * size / size[:, None], B / size[:, None], C[[row]] * size
    # the output behind a lag of first order
    A = np.block([[A, np.zeros((n - 1, 1))], [C / lag, np.array([[-1.0 / lag]])]])
    B, C = np.vstack([B, np.zeros((1, 1))]), np.append(np.zeros(n - 1), 1.0)[None, :]
    poles = np.linalg.eigvals(A)
    if np.max(poles.real) > 1e-6 / period:
        raise InputError(
            f"The plant '{plant.name}' is unstable at its start; a controller is tuned for stable"
            " plants: check its parameters."
        )
    step = scipy.linalg.expm(period * np.block([[A, B], [np.zeros((1, n + 1))]]))
    modes = tuple(
        (float(abs(v) / (2.0 * np.pi)), float(-v.real / abs(v)))
        for v in poles
        if v.imag > 0.0 and 1e-6 < abs(v) * period < 0.9 * np.pi
    )
    nyquist = 0.5 / period
    near = [f * np.linspace(0.7, 1.3, 601) for f, damping in modes if damping < _DAMPED]
    grid = np.unique(np.concatenate([np.geomspace(1e-5 * nyquist, nyquist, 3000), *near]))
    grid = grid[grid <= nyquist]
    values, vectors = np.linalg.eig(step[:n, :n])
    left, right = C @ vectors, np.linalg.solve(vectors, step[:n, n:])
    z = np.exp(2j * np.pi * grid * period)
    response = (left * right.ravel() / (z[:, None] - values)).sum(axis=1)
    if not abs(response[0]) > 0.0:
        raise InputError(
            f"The output of '{plant.name}' does not follow its input; check the wires."
        )
    return PlantResponse(period, grid, z, response, modes)


def notch_response(z: ComplexArray, period: float, frequency: float, floor: float, width: float
) -> ComplexArray:  # fmt: skip
    """Return the notch that `position_controller` has, on the unit circle."""
    t = np.tan(min(np.pi * frequency * period, 1.5))
    w = (z - 1.0) / (z + 1.0) / t
    ratio: ComplexArray = (w * w + 2.0 * floor * w + 1.0) / (w * w + 2.0 * width * w + 1.0)
    return np.where(np.abs(z + 1.0) < 1e-12, 1.0, ratio)


_WIDTHS = (0.2, 0.35, 0.5, 0.7, 1.0)
_FLOORS = (0.02, 0.05, 0.1, 0.2, 0.35)
#: Trial ratios of proportional to integral gain, in periods.
_RATIOS = np.concatenate([[0.0], np.geomspace(0.1, 300.0, 50)])


@dataclass(frozen=True)
class Margins:
    """How far a sampled loop is from instability, and how fast it is.

    `sensitivity` is the largest |1/(1 + L)|, `modulus` its inverse; `gain` is the factor on the
    loop gain that makes it unstable, `phase` [rad] the lag that does; `crossover` [Hz] is where |L|
    last falls below 1, `bandwidth` [Hz] where the response to a load disturbance, |1/(1 + L)|,
    first reaches 1/sqrt(2); `resonance` [Hz] is the mode that the notch is for, 0 without one.
    """

    sensitivity: float
    modulus: float
    gain: float
    phase: float
    crossover: float
    bandwidth: float
    resonance: float


def controller_for(
    plant: Model,
    *,
    position: str | None = None,
    sample_time: float = 5e-5,
    sensitivity: float = 1.6,
    resonance_tolerance: float = 0.1,
    lowest_command: float = -2.0,
    highest_command: float = 12.0,
    feed_forward: bool = True,
) -> Model:
    """Return a position controller for a plant from one command [V] to a position [m].

    `position` is the output that is fed back, by default the plant's only one.
    `sensitivity` is the largest |1/(1 + L)| allowed, also with the resonance off by the share
    `resonance_tolerance`. The corner of the anti-aliasing filter is the Nyquist frequency. With
    `feed_forward` the reference over the plant's gain at rest is part of the command. The margins
    are in the model's notes; `margins_of` gives them as numbers.

    Raises InputError for a plant with more than one input, with sampled states or without that
    output, one that is unstable or has no gain, and values out of range.
    """
    _check(plant, position, sample_time, sensitivity, resonance_tolerance)
    lag = sample_time / np.pi
    response = plant_response(plant, position, sample_time, lag)
    rest = float(response.response[0].real)
    gains = _search(response, np.sign(rest), sensitivity, resonance_tolerance)
    model = part_model(
        "position_controller", **gains, sample_time=sample_time, filter_time=lag,
        feed_forward=1.0 / rest if feed_forward else 0.0, lowest_command=lowest_command,
        highest_command=highest_command,
    )  # fmt: skip
    margins = margins_of(plant, model, position)
    note = (
        f"Tuned to {plant.name}: largest sensitivity {margins.sensitivity:.3g}, gain margin"
        f" {margins.gain:.3g}, phase margin {np.degrees(margins.phase):.3g} deg, crossover"
        f" {margins.crossover:.4g} Hz."
    )
    return model.with_values({}, provenance=replace(model.provenance, notes=(note,)))


def margins_of(plant: Model, controller: Model, position: str | None = None) -> Margins:
    """Return the margins of a plant, linearised at its start, in the loop with a controller."""
    p = controller.values
    period = p["sample_time"]
    response = plant_response(plant, position, period, p["filter_time"])
    z = response.z
    notch = notch_response(z, period, p["notch_frequency"], p["notch_floor"], p["notch_width"])
    integral = 0.5 * p["integral_gain"] * period * (z + 1.0) / (z - 1.0)
    loop = response.response * (notch * (p["proportional_gain"] + integral))
    modulus = float(np.min(np.abs(1.0 + loop)))
    size, angle = np.abs(loop), np.unwrap(np.angle(loop))
    falling = np.flatnonzero((size[:-1] >= 1.0) & (size[1:] < 1.0))
    crossover = float(response.frequencies[falling[-1]]) if falling.size else 0.0
    slow = np.flatnonzero(np.abs(1.0 + loop) < np.sqrt(2.0))
    lag = np.min(np.pi + angle[falling]) if falling.size else np.inf
    mode = response.resonance()
    return Margins(
        sensitivity=1.0 / modulus,
        modulus=modulus,
        gain=_gain_margin(loop),
        phase=float(lag),
        crossover=crossover,
        bandwidth=float(response.frequencies[slow[0]]) if slow.size else np.inf,
        resonance=mode[0] if mode else 0.0,
    )


def _gain_margin(loop: ComplexArray) -> float:
    """Return the smallest factor above 1 on the loop gain that puts the curve through -1."""
    im = loop.imag
    at = np.flatnonzero(im[:-1] * im[1:] <= 0.0)
    share = im[at] / np.where(im[at] == im[at + 1], 1.0, im[at] - im[at + 1])
    real = loop.real[at] + share * (loop.real[at + 1] - loop.real[at])
    crossings = -real[(real < 0.0) & (real > -1.0)]
    return float(1.0 / np.max(crossings)) if crossings.size else np.inf


def _check(
    plant: Model, position: str | None, period: float, sensitivity: float, tolerance: float
) -> None:
    problems = Problems()
    if len(plant.input_names) != 1 or plant.structure.sampled:
        problems.add(
            f"The plant '{plant.name}' has the inputs {quoted(plant.input_names)} and the sampled"
            f" states {quoted(plant.sampled_names) or 'none'}; give one with one input, the"
            " command, and none sampled."
        )
    if position not in plant.output_names and (position or len(plant.output_names) != 1):
        problems.add(
            f"The position is '{position}' but the outputs of '{plant.name}' are"
            f" {quoted(plant.output_names)}; name one of them."
        )
    if not 0.0 < period < 10.0:
        problems.add(f"sample_time is {period:g} s; give a positive period such as 5e-5.")
    if not 1.0 < sensitivity <= 4.0:
        problems.add(f"sensitivity is {sensitivity:g}; choose from 1.2 to 2, at most 4.")
    if not 0.0 <= tolerance < 0.5:
        problems.add(f"resonance_tolerance is {tolerance:g}; give a share from 0 to 0.5.")
    problems.raise_if_any()


def _search(
    plant: PlantResponse, sign: float, sensitivity: float, tolerance: float
) -> dict[str, float]:
    """Return the values of the controller with the largest integral gain."""
    z, period = plant.z, plant.period
    mode = plant.resonance()
    frequency = mode[0] if mode else 0.25 / period
    shapes = [(0.5, 0.5)]
    if mode:
        shapes += [(f, w) for f, w in product(_FLOORS, _WIDTHS) if f < w]
    best, tuned = 0.0, (0.5, 0.5, 0.0)
    for floor, width in shapes:
        others = (1.0 - tolerance, 1.0, 1.0 + tolerance) if floor != width else (1.0,)
        notches = np.array([notch_response(z, period, frequency * b, floor, width) for b in others])
        base = sign * plant.response * notches
        for ratio in _RATIOS * period:
            loop = base * (ratio + 0.5 * period * (z + 1.0) / (z - 1.0))
            gain = _largest_gain(loop, 1.0 / sensitivity)
            if gain > best:
                best, tuned = gain, (floor, width, ratio)
    floor, width, ratio = tuned
    return {
        "notch_frequency": frequency,
        "notch_floor": floor,
        "notch_width": width,
        "integral_gain": sign * best,
        "proportional_gain": sign * best * ratio,
    }


def _largest_gain(loop: ComplexArray, distance: float) -> float:
    """Return the largest K up to which |1 + K L| >= distance everywhere, 0 if there is no limit.

    The smallest root of |L|^2 K^2 + 2 Re(L) K + 1 - distance^2 = 0 where it has positive ones.
    """
    square, rest = np.abs(loop) ** 2, 1.0 - distance**2
    inside = loop.real**2 - square * rest
    met = (loop.real < 0.0) & (inside >= 0.0)
    if not met.any():
        return 0.0
    # the smaller root in the form that does not cancel
    return float(np.min(rest / (np.sqrt(inside[met]) - loop.real[met])))


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
        plant, position="stage_position", sample_time=sample_time, sensitivity=sensitivity,
        lowest_command=_LOWEST * _FULL_COMMAND, highest_command=_FULL_COMMAND,
    )  # fmt: skip
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
        "voltage_amplifier", gain=rated / _FULL_COMMAND, lowest_output=_LOWEST * rated,
        highest_output=rated, load_capacitance=actuator.values["C_p"],
    )  # fmt: skip
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
