"""Named stacks: a value for every parameter of the base model (cascade), and where it is from.

The paper lists three stacks with rated voltage, stroke and capacitance; its Table 1 is not legible
in the text at hand. What neither the paper nor a data sheet gives is marked as assumed. How the
assumed values hang together:

* Ceramic of density 7.8 g/cm^3 and modulus near 40 GPa in the stack's outline gives mass and
  stiffness; blocking force = stiffness x stroke.
* In the paper's one-way cascade a load meets the bonding layers only: the stiffness that a data
  sheet measures is k_B, and blocked force = k_B x free stroke. k_P is 4 or 5 times as stiff.
* The hysteresis lowers the stroke, so k_L (1/k_P + 1/k_B) is the stroke over 0..u_rated divided
  by the rated voltage and by 0.86, the share that the loop leaves.
* A/k_L = -0.25 and beta > gamma make x lag u by 12.5 % of the stroke; without delta f_H is bounded:
  |f_H| <= h_ref (|A| / (beta - gamma))^(1/n). The layering does not change the loops (paper, 4.2).
* delta/k_L = -0.02 1/s widens the loop from 12.5 to 12.6 % of the stroke at 1 Hz, 15 % at 0.1 Hz.

Two more stacks are identified from bundled or public records by `psa identify`. Voltage and
displacement do not determine forces: their k_L, A, beta, gamma and delta are right in proportion to
the stiffness assumed for them.
"""

import difflib
import re
from dataclasses import dataclass

from psa_casadi.common.errors import InputError
from psa_casadi.model.components import BASE
from psa_casadi.model.compose import Model, compose
from psa_casadi.model.variables import Provenance

PAPER = "Yang and Zhu 2015"


@dataclass(frozen=True)
class Figure:
    """One value in SI units, its source, and whether it is assumed rather than published."""

    value: float
    source: str
    assumed: bool


@dataclass(frozen=True)
class Stack:
    """A stack by name, with a figure for every parameter of the base components (cascade)."""

    name: str
    description: str
    values: dict[str, Figure]

    @property
    def assumed(self) -> tuple[str, ...]:
        """Names of the parameters whose figures are assumed."""
        return tuple(name for name, figure in self.values.items() if figure.assumed)


def _sourced(value: float, source: str) -> Figure:
    return Figure(value, source, assumed=False)


def _assumed(value: float, reason: str) -> Figure:
    return Figure(value, reason, assumed=True)


def _hysteresis(k_L: float, u_rated: float) -> dict[str, Figure]:
    """Return the Bouc-Wen figures of a loop 12 % of the stroke wide, for any k_L and u_rated."""
    loop = "A loop 12 % of the stroke wide, in the range of the paper's figure 6."
    return {
        "A": _assumed(-0.25 * k_L, loop),
        "beta": _assumed(0.285 * k_L, loop),
        "gamma": _assumed(0.039 * k_L, loop),
        "delta": _assumed(-0.02 * k_L, "Negative as in the paper; visible, not dominant, at 1 Hz."),
        "n": _assumed(1.5, "A bend between sharp (2) and gradual (1)."),
        "h_ref": _assumed(0.075 * k_L * u_rated, "About the peak of |f_H| at rated voltage."),
        "hold_rate": _assumed(1e-3 * u_rated, "A rated span in 1000 s, far below any test rate."),
    }


def _identified(
    run: str, values: dict[str, float], undetermined: dict[str, float]
) -> dict[str, Figure]:
    """Return the figures from a fit; those that the record leaves open count as assumed."""
    forces = ("k_L", "A", "beta", "gamma", "delta")
    scale = "; in proportion to the assumed k_P and k_B"
    table = {n: _sourced(v, run + (scale if n in forces else "")) for n, v in values.items()}
    left = f"{run}, which leaves it open: near where the fit started"
    return table | {n: _assumed(v, left) for n, v in undetermined.items()}


def _not_in_the_record(top: float, h_ref: float, hold_rate: float) -> dict[str, Figure]:
    """Return the figures that `psa identify` does not search; all but the voltages are assumed."""
    slow = "Too fast to show in the record: the ordinary mass of the base model."
    soft = "Of the order of a stack's, since none is known: forces are right in proportion only."
    return {
        "G": _sourced(1.0, "definition: the voltage is the one that the record holds"),
        "C_p": _assumed(1.6e-6, "As the paper's stacks; the record shows R_s C_p only."),
        "u_rated": _sourced(top, "the largest voltage of the record"),
        "h_ref": _assumed(h_ref, "A tenth of the linear force over the span; beta and gamma fit."),
        "hold_rate": _assumed(hold_rate, "A span in 1000 s, far below the record's rates."),
        "m_P": _assumed(5e-3, slow),
        "k_P": _assumed(2.5e8, soft),
        "m_B": _assumed(5e-3, slow),
        "k_B": _assumed(5e7, soft),
    }


PTBS200 = Stack(
    name="PTBS200",
    description=(
        "glued stack, 200 V, 18 um, 1.6 uF, underdamped (the paper prints PTBS2 where its text"
        " has lost the zeros); outline assumed 8 x 8 x 20 mm"
    ),
    values={
        "G": _sourced(1.0, "definition: the voltage is the one that the amplifier puts out"),
        "R_s": _assumed(8.0, "R_s C_p = 13 us gives the paper's voltage rise of under 30 us."),
        "C_p": _sourced(1.6e-6, f"{PAPER}, section 4.2: 1.6 uF"),
        "u_rated": _sourced(200.0, f"{PAPER}, section 4.2: 200 V"),
        "k_L": _assumed(10.1, "The paper's 18 um at 200 V through the assumed stiffness."),
        **_hysteresis(10.1, 200.0),
        "tau": _assumed(2e-5, "Short, since the measured step rings."),
        "m_P": _assumed(4e-3, "0.4 of the 10 g of ceramic moves with the free end."),
        "c_P": _assumed(280.0, "Damping ratio 0.1 of the wafers, lossier than the soft glue."),
        "k_P": _assumed(4.8e8, "Four times k_B, so that the bonding layers set the stiffness."),
        "m_B": _assumed(7e-3, "The other share of the ceramic and an end piece of about 1 g."),
        "c_B": _assumed(
            55.0, "Damping ratio 0.03 at 21 kHz: the ringing ends after a millisecond."
        ),
        "k_B": _assumed(1.2e8, "8 x 8 x 20 mm at 38 GPa; blocking force 2.2 kN."),
    },
)

WYDS0808020 = Stack(
    name="WYDS0808020",
    description=(
        "stack sintered layer by layer, 200 V, 18 um, 1.6 uF, overdamped (the name is partly lost:"
        " the text has WYDS882 without its zeros, most likely 08 x 08 x 020 mm)"
    ),
    values={
        **PTBS200.values,
        "tau": _assumed(2e-4, "The slowest pole: the step takes about a millisecond."),
        "c_P": _assumed(5500.0, "Damping ratio 2: the paper calls the stack overdamped."),
        "c_B": _assumed(5500.0, "Damping ratio 3: the paper calls the stack overdamped."),
    },
)

P88551 = Stack(
    name="P-885.51",
    description=(
        "co-fired PICMA stack of Physik Instrumente, 120 V, 18 um, 1.5 uF, overdamped;"
        " 5 x 5 x 18 mm (the paper's type name is lost; the figures are those of the P-885.51)"
    ),
    values={
        "G": _sourced(1.0, "definition: the voltage is the one that the amplifier puts out"),
        "R_s": _assumed(8.0, "R_s C_p = 12 us gives the paper's voltage rise of under 30 us."),
        "C_p": _sourced(1.5e-6, f"{PAPER}, section 4.2: 1.5 uF; so the data sheet of the P-885.51"),
        "u_rated": _sourced(120.0, f"{PAPER}, section 4.2: 120 V; so the data sheet"),
        "k_L": _sourced(7.3, "18 um at 120 V (paper, data sheet) through k_P and k_B"),
        **_hysteresis(7.3, 120.0),
        "tau": _assumed(1e-4, "The slowest pole; the paper's quickest stack to settle."),
        "m_P": _assumed(1.2e-3, "A third of the 3.5 g of ceramic."),
        "c_P": _assumed(1300.0, "Damping ratio 1.2: the paper calls the stack overdamped."),
        "k_P": _assumed(2.5e8, "Five times k_B, so that the data sheet's stiffness is k_B."),
        "m_B": _assumed(1.0e-3, "With k_B 35 kHz: clamped, half of the data sheet's free 70 kHz."),
        "c_B": _assumed(670.0, "Damping ratio 1.5: the paper calls the stack overdamped."),
        "k_B": _sourced(
            5e7, "Physik Instrumente data sheet P-885.51: 50 N/um, 900 N blocking force"
        ),
    },
)

DEMO = Stack(
    name="demo",
    description="the synthetic stack of the demonstration, which creeps; its base model only",
    values={
        **_not_in_the_record(top=65.554, h_ref=105.670, hold_rate=0.065554),
        **_identified(
            "identified by `psa identify psa_casadi/data/demo.csv` (synthetic record)",
            {"k_L": 21.6765, "A": -7.45580, "beta": 2.65995, "gamma": -0.316797, "n": 1.57145}
            | {"tau": 1.13557e-3},
            undetermined={"delta": -0.520552, "R_s": 68.1106, "c_P": 946.328, "c_B": 40.9041},
        ),
    },
)

MICROMANIPULATOR = Stack(
    name="micromanipulator",
    description=(
        "piezo micromanipulator of Y. N. Aye, 39 um from 0.2 to 3.4 V before its amplifier, so that"
        " forces per volt include the amplifier's gain; nested minor loops at 1 Hz"
    ),
    values={
        **_not_in_the_record(top=3.42367, h_ref=158.479, hold_rate=3.18734e-3),
        **_identified(
            "identified by `psa identify minor_loops.csv`, measured by Y. N. Aye (GitHub"
            " yan9a/DiscreteBacklashOperator, MIT licence)",
            {"k_L": 742.361, "A": -244.196, "beta": 41.5186, "gamma": -24.0704, "n": 1.0}
            | {"delta": -129.733},
            undetermined={"tau": 1.39302e-2, "R_s": 2828.02, "c_P": 63302.4, "c_B": 13321.9},
        ),
    },
)

STACKS: dict[str, Stack] = {
    stack.name: stack for stack in (PTBS200, WYDS0808020, P88551, DEMO, MICROMANIPULATOR)
}
"""The named stacks, as `psa stacks` lists them."""


def stack_model(name: str) -> Model:
    """Return a named stack as a model (cascade), its name made an identifier.

    Raises InputError for an unknown name.
    """
    if name not in STACKS:
        by_lower = {known.lower(): known for known in STACKS}
        near = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.5)
        meant = f"did you mean {by_lower[near[0]]}?" if near else f"there are {', '.join(STACKS)}."
        raise InputError(f"There is no stack named '{name}'; {meant}")
    stack = STACKS[name]
    note = (
        f"Named stack {name}: {len(stack.assumed)} of its {len(stack.values)} figures are assumed;"
        f" `psa stacks {name}` shows which."
    )
    return compose(
        BASE,
        {key: figure.value for key, figure in stack.values.items()},
        name=re.sub(r"\W", "_", name),
        description=stack.description,
    ).with_values({}, provenance=Provenance(notes=(note,)))
