"""The class with pins and a flange: which signals of a model they stand for.

A flange is a two-port: what the stack does to its load, the load does to the stack. The paper's
one-way cascade is none, since its bonding layers do not push back on the wafers. The class has the
reaction, `reciprocal_coupling` at a gain of 1, and says so.
"""

from psa_casadi.effects.mechanics import RECIPROCAL_COUPLING
from psa_casadi.export.modelica.annotations import about, documentation, equations_table
from psa_casadi.export.modelica.class_text import Ports, class_lines
from psa_casadi.model.compose import Model

_PIN = "Modelica.Electrical.Analog.Interfaces"
_FLANGE = "Modelica.Mechanics.Translational.Interfaces"
#: Names of the connectors.
IDENTIFIERS = ("pin_p", "pin_n", "flange_a", "flange_b")

_WIRING = (
    "The pins are the terminals behind the amplifier's gain G: between them is G times the voltage"
    " command, and the current is what flows into the stack. The motion does not act back on the"
    " charge. The flange is the stack's output, its position the displacement from rest, with the"
    " other end clamped."
)


def has_ports(model: Model) -> bool:
    """Whether some signals of the model can be a pair of pins or a flange."""
    return bool(_electrical(model) or _output(model) or _tip(model))


def reciprocal(model: Model) -> Model:
    """Return the model with action and reaction between its two masses, if it has two."""
    if "cascade_mechanics" not in (c.name for c in model.components):
        return model
    return model.with_effect(RECIPROCAL_COUPLING).with_values({"reciprocal_gain": 1.0})


def acausal_lines(model: Model) -> list[str]:
    """Return the lines of the class `Acausal`."""
    connected = reciprocal(model)
    texts = [*about(connected), _WIRING if _output(connected) else "", _cascade_note(connected)]
    return class_lines(
        connected,
        "Acausal",
        "the model with connectors of the Modelica Standard Library 4",
        documentation(texts, equations_table(connected)),
        _ports(connected),
    )


def _ports(model: Model) -> Ports:
    declarations: list[str] = []
    equations = ["  // connectors"]
    inputs: set[str] = set()
    for given, own in (
        (_electrical(model), "voltage"),
        (_output(model), "load_force"),
        (_tip(model), "tip_position tip_velocity"),
    ):
        declarations += given[0] if given else ()
        equations += given[1] if given else ()
        inputs |= set(own.split()) if given else set()
    fixed = {"reciprocal_gain"} & set(model.parameter_names)
    return Ports(
        IDENTIFIERS, tuple(declarations), tuple(equations), frozenset(inputs), frozenset(fixed)
    )


Tied = tuple[tuple[str, ...], tuple[str, ...]]


def _has(model: Model, *names: str) -> bool:
    return {*names} <= {*model.input_names, *model.output_names}


def _electrical(model: Model) -> Tied | None:
    if not _has(model, "voltage", "current"):
        return None
    gain = "G*" if "G" in model.parameter_names else ""
    return (
        (_connector(f"{_PIN}.PositivePin pin_p", "positive terminal of the stack", -100, 50),
         _connector(f"{_PIN}.NegativePin pin_n", "negative terminal of the stack", -100, -50)),
        (f"  pin_p.v - pin_n.v = {gain}voltage;",
         "  pin_p.i = current;",
         "  pin_p.i + pin_n.i = 0;"),
    )  # fmt: skip


def _output(model: Model) -> Tied | None:
    if not _has(model, "displacement", "load_force"):
        return None
    flange = _connector(f"{_FLANGE}.Flange_b flange_b", "output of the stack", 100, 0)
    return (flange,), ("  flange_b.s = displacement;", "  flange_b.f = load_force;")


def _tip(model: Model) -> Tied | None:
    if not _has(model, "tip_position", "tip_velocity", "reaction_force"):
        return None
    flange = _connector(f"{_FLANGE}.Flange_a flange_a", "what the stack pushes on", -100, 0)
    return (
        (flange,),
        ("  tip_position = flange_a.s;",
         "  tip_velocity = der(flange_a.s);",
         "  flange_a.f = -reaction_force;"),
    )  # fmt: skip


def _connector(declaration: str, description: str, x: int, y: int) -> str:
    extent = f"{{{{{x - 10}, {y - 10}}}, {{{x + 10}, {y + 10}}}}}"
    return (
        f'  {declaration} "{description}"\n'
        f"    annotation(Placement(transformation(extent={extent})));"
    )


def _cascade_note(model: Model) -> str:
    """Return what the reaction changes; empty for a single mass."""
    if "cascade_mechanics" not in (c.name for c in model.components):
        return ""
    k_P, k_B = model.values["k_P"], model.values["k_B"]
    share = k_B / (k_P + k_B)
    return (
        "The paper's one-way cascade has no reaction of the bonding layers on the wafers, so that"
        " it cannot be a two-port. This class has it: reciprocal_gain = 1, action and reaction."
        f" With the same parameters the static stroke per force is k_B/(k_P + k_B) = {share:.4g}"
        " times that of the cascade at reciprocal_gain = 0, and the output's stiffness is that of"
        " wafers and bonding layers in series,"
        f" k_P k_B/(k_P + k_B) = {k_P * share:.4g} N/m in place of k_B = {k_B:.4g} N/m."
        " Where the parameters were found with the cascade, find them again"
        " with reciprocal_coupling at 1, or scale the forces (k_L, A, beta, gamma, delta, h_ref) by"
        " (k_P + k_B)/k_B for the same free stroke."
    )
