"""What a piece of physics must declare, and the balances it may add to.

A component never edits another one: it adds terms to balances, named sums with a unit and a
meaning. `psa_casadi.model.structure` adds the terms up, puts the sums in the order of their
dependence and refuses a loop.
"""

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from importlib import import_module
from typing import Any, Literal

import casadi as ca

from psa_casadi.model.variables import Input, Output, Parameter, State

# casadi ships no type information; a symbolic expression is Any to the type checker.
Expression = Any

#: Where the components of this package are, by module and name of a table.
_TABLES = (
    ("psa_casadi.model.components", "COMPONENTS"),
    ("psa_casadi.model.effects", "EFFECTS"),
    ("psa_casadi.model.effects.mechanics", "MODAL_SERIES"),
    ("psa_casadi.model.effects.patches", "PATCHES"),
)

#: What effects do, whatever their place.
Kind = Literal[
    "", "curve", "gain", "hysteresis", "relaxation", "resonance", "lag", "damping", "time",
    "changing gain",
]  # fmt: skip

#: Probe value: the frequencies where the residual's spectrum peaks, in Hz.
SPECTRAL_PEAKS = "spectral_peaks"
#: The same for the periods with which the residual repeats over the displacement, in m.
DISPLACEMENT_PEAKS = "displacement_peaks"
#: The same for the places at which the residual jumps over the displacement, in m.
DISPLACEMENT_STEPS = "displacement_steps"
#: Probe value: the duration of the longest record, in s.
RECORD_DURATION = "record_duration"
#: Those that are read off a residual.
READ_OFF = (SPECTRAL_PEAKS, DISPLACEMENT_PEAKS, DISPLACEMENT_STEPS)


@dataclass(frozen=True)
class Balance:
    """A named sum: its unit and what the sum means."""

    name: str
    unit: str
    description: str


BALANCES: dict[str, Balance] = {
    b.name: b
    for b in (
        Balance("drive_voltage", "V", "open-circuit voltage of the amplifier"),
        Balance("drive_current", "A", "current through the amplifier's output resistance"),
        Balance("stack_current", "A", "current into the stack's capacitance"),
        Balance("stack_charge", "C", "charge on the stack's electrodes"),
        Balance("voltage_rate", "V/s", "rate of the voltage at the stack's electrodes"),
        Balance("hysteresis_rate", "N/s", "rate of the hysteresis force"),
        Balance("free_force", "N", "force the wafers generate before the creep lag"),
        Balance("wafer_force", "N", "force that accelerates and strains the wafers"),
        Balance("transmitted_force", "N", "force the wafers pass on to the output mass"),
        Balance("tip_force", "N", "force on the output mass from outside the stack"),
        Balance("tip_displacement", "m", "displacement of the output mass"),
        Balance("displacement", "m", "output displacement, with creep and further modes"),
        Balance("blocked_force", "N", "force that would hold the output at zero displacement"),
        Balance("measured_displacement", "m", "what the displacement sensor shows"),
    )
}


@dataclass(frozen=True)
class Equations:
    """What a component contributes: state derivatives, terms of balances, outputs.

    `switches` names expressions at whose zeros its equations have a kink or a jump; the solver ends
    a step there. Components that kink at the same expression give it the same name.
    `next` gives the value of each sampled state after a sample instant; in it, symbols of sampled
    states, and balances that depend on them, have their values before the instant.
    """

    der: Mapping[str, Expression] = field(default_factory=dict)
    add: Mapping[str, Expression] = field(default_factory=dict)
    out: Mapping[str, Expression] = field(default_factory=dict)
    switches: Mapping[str, Expression] = field(default_factory=dict)
    next: Mapping[str, Expression] = field(default_factory=dict)


@dataclass(frozen=True)
class Remedy:
    """What to do about an effect, as a code, and the test that shows how large the effect is.

    The words of a code are in `report.words.remedy_words`, the tests in `diagnosis.remedy`.
    """

    code: str
    test: str


#: The remedies of effects that declare none, by what they belong to.
_PLACES = {
    "plant": Remedy("extended_model", "record"),
    "drive": Remedy("better_drive", "record"),
    "sensor": Remedy("calibrate_sensor", "record"),
    "environment": Remedy("steady_surroundings", "record"),
}


class Symbols:
    """Read access to every symbol of a model by attribute: `s.k_L`, `s.f_H`, `s.displacement`.

    Parameters, states, sampled states, inputs, `time` and balances share one name space.
    """

    def __init__(self, table: Mapping[str, Expression]) -> None:
        self._table = dict(table)

    def __getattr__(self, name: str) -> Expression:
        try:
            return self._table[name]
        except KeyError:
            raise AttributeError(f"no symbol named '{name}' in this model") from None


class OnDemand(Symbols):
    """Symbols of any name, made when they are first read; `made` are those so far."""

    def __init__(self) -> None:
        super().__init__({})
        self.made = self._table

    def __getattr__(self, name: str) -> Expression:
        return self._table.setdefault(name, ca.SX.sym(name))


@dataclass(frozen=True)
class FmuUsed:
    """An imported FMU by the name of its file and the SHA-256 of that.

    `parameters` are the names in there of those that the component declares, `values` numbers of
    further ones. `interface` is that by which it is run as a whole, "" if its equations are used.
    """

    file: str
    sha256: str
    parameters: tuple[str, ...] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    interface: Literal["", "model exchange", "co-simulation"] = ""


@dataclass(frozen=True, eq=False)
class Foreign:
    """A compiled function `name` that equations call, and its derivative: an imported FMU.

    It has no formula, so that nothing is printed of it. `place` is its file, `addresses` returns
    where the two are in this process; what is compiled of a model calls them there. `fmu` is what
    they are of. One that is run as a whole (`Component.played`) has no function.
    """

    name: str
    addresses: Callable[[], tuple[int, int]]
    fmu: FmuUsed
    place: str = ""


@dataclass(frozen=True, eq=False)
class Component:
    """One piece of physics, declared once and symbolically.

    `gain` names the parameter that removes the component exactly at 0 (None for base physics).
    `linear` names parameters of which it is a factor: a fit holds the gain at 1 and moves them, and
    the effect is looked for with all of them at once. `probe` holds trial values of parameters that
    have no influence while the gain is 0; `finite_step` is the size of the gain, as a share of its
    scale, at which the effect is looked for when its derivative vanishes at 0. `looks_like` is the
    signature an engineer sees. `kind` is what an effect does, whatever its place: the effects of
    one kind and place are a family. `tone` names a parameter that is the frequency of a tone: among
    harmonics of a periodic drive it is indistinguishable from distortion. `belongs_to` is plant,
    drive, sensor or environment; the last two stay out of exported plants. `needs` names components
    without which this one means nothing. `remedy` is what can be done about it, if it differs from
    that of its place. `trial_starts` are starts of its memory states at which it is looked for,
    where it does nothing at their ordinary start. `curve` names the quantity over which an effect
    bends a static curve: effects with the same one differ, below the resonances, only by the form
    of the bend. `measured_by` names the input whose measured column holds what
    it adds: with such a column it is no cause. `needs_column` names columns of which a record must
    have one for the effect to be looked for, as it hardly shows otherwise. `more_of` names the
    effect of which this one is several, `count` of them.

    `sampled` are states that change at sample instants only: at every time that is a multiple of
    the parameter `sample_period` [s], whoever declares it, each takes the value in
    `Equations.next` and keeps it up to the next instant. All components of a model share one
    period.

    `home` is the module of a component that is not of this package (`load_effects`). `balances` are
    further sums that others may add to. `foreign` is what its
    equations call that is no formula; `played` is what is run as a whole in their place.
    """

    name: str
    description: str
    source: str
    equations: Callable[[Symbols], Equations]
    parameters: tuple[Parameter, ...] = ()
    states: tuple[State, ...] = ()
    inputs: tuple[Input, ...] = ()
    outputs: tuple[Output, ...] = ()
    gain: str | None = None
    linear: tuple[str, ...] = ()
    probe: Mapping[str, tuple[float, ...] | str] = field(default_factory=dict)
    finite_step: tuple[float, ...] = ()
    tone: str | None = None
    looks_like: str = ""
    equation_text: str = ""
    kind: Kind = ""
    belongs_to: str = "plant"
    remedy: Remedy | None = None
    needs: tuple[str, ...] = ()
    trial_starts: tuple[Mapping[str, float], ...] = ()
    curve: str | None = None
    measured_by: str | None = None
    needs_column: tuple[str, ...] = ()
    more_of: str | None = None
    count: int = 1
    sampled: tuple[State, ...] = ()
    sample_period: str | None = None
    home: str = ""
    balances: tuple[Balance, ...] = ()
    foreign: Foreign | None = None
    played: Any = None

    @property
    def from_residual(self) -> bool:
        """Whether trial values are read off a residual, so that another one has other ones."""
        return any(grid in READ_OFF for grid in self.probe.values())

    @property
    def what_now(self) -> Remedy:
        """The declared remedy, else the one of its place."""
        return self.remedy or _PLACES[self.belongs_to]

    @property
    def in_plant(self) -> bool:
        """Whether an exported plant holds it: sensor and environment stay outside."""
        return self.belongs_to not in ("sensor", "environment")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by reference where a table or a user's module has it, else with its equations.

        Equations that are no function of a module, such as those of `ode_model`, are kept as a
        function of CasADi.
        """
        if self.home:
            return _found, ("psa_casadi.model.user_effects", "load_effects", self.home, self.name)
        for module, table in _TABLES:
            for key, component in getattr(import_module(module), table).items():
                if component is self:
                    return _found, (module, table, None, key)
        declared = {f.name: getattr(self, f.name) for f in fields(self)}
        try:
            pickle.dumps(self.equations)
        except (pickle.PicklingError, AttributeError, TypeError):
            declared["equations"] = KeptEquations.of(self)
        return partial(Component, **declared), ()

    def at_gain(self, gain: float, values: Mapping[str, float]) -> dict[str, float]:
        """Return `values` with a gain, as a fit has them: the `linear` ones times it, and 1."""
        if not self.linear:
            return {**values, self.gain or "": gain}
        declared = {p.name: p.value for p in self.parameters}
        scaled = {n: gain * values.get(n, declared[n]) for n in self.linear}
        return {**values, **scaled, self.gain or "": 1.0}

    @property
    def fitted(self) -> tuple[str, ...]:
        """Names of the parameters that records can determine."""
        return tuple(p.name for p in self.parameters if p.fitted)

    def is_inside_ranges(self, values: Mapping[str, float]) -> bool:
        """Whether no fitted parameter but the gain lies at an end of its range.

        A parameter whose lower bound is a limit of the law may lie there.
        """
        for p in self.parameters:
            if not p.fitted or p.name == self.gain:
                continue
            low, high = (0.0, p.bounds[1]) if p.limit else p.bounds
            value, margin = values[p.name], 1e-3 * (high - low)
            if p.log and (value < 1.01 * low or value > high / 1.01):
                return False
            if not p.log and (value <= low + margin or value >= high - margin):
                return False
        return True


_Written = Callable[[Symbols], Equations]
#: What a component declares of each kind of variable.
_VARIABLES: dict[str, type] = {
    "parameters": Parameter, "states": State, "inputs": Input, "outputs": Output,
}  # fmt: skip


def component(
    *variables: Parameter | State | Input | Output, **declared: Any
) -> Callable[[_Written], Component]:
    """Return a decorator that makes a component of the function of its equations.

        @component(Parameter("k_L", ...), description="...", source="...")
        def linear_force(s: Symbols) -> Equations:
            return Equations(add={"free_force": s.k_L * s.u})

    The component has the name of the function, which stays at `equations`, where pickles find it.
    Its variables are in the order of `variables`; `declared` are fields of `Component`.
    """
    for kind, form in _VARIABLES.items():
        declared[kind] = tuple(v for v in variables if isinstance(v, form))

    def made(equations: _Written) -> Component:
        name = equations.__name__
        equations.__qualname__ = f"{name}.equations"
        return Component(name=name, equations=equations, **declared)

    return made


def effect(
    gain: Parameter, *variables: Parameter | State | Input, **declared: Any
) -> Callable[[_Written], Component]:
    """Return the decorator of an effect that its first parameter, the gain, removes at 0."""
    return component(gain, *variables, gain=gain.name, **declared)


@dataclass(frozen=True, eq=False)
class KeptEquations:
    """Equations of a component that can be pickled: a function of the symbols of some names.

    `places` are the field of `Equations` and the name of each of its results.
    """

    function: ca.Function
    symbols: tuple[str, ...]
    places: tuple[tuple[str, str], ...]

    @classmethod
    def of(cls, component: Component) -> "KeptEquations":
        """Return the equations of a component as a function."""
        symbols = OnDemand()
        written = component.equations(symbols)
        parts = [f.name for f in fields(Equations)]
        results = {(part, n): e for part in parts for n, e in getattr(written, part).items()}
        made = symbols.made
        function = ca.Function("equations", list(made.values()), [*map(ca.SX, results.values())])
        return cls(function, tuple(made), tuple(results))

    def __call__(self, s: Symbols) -> Equations:
        """Return the equations in these symbols."""
        results = self.function.call([getattr(s, name) for name in self.symbols])
        parts: dict[str, dict[str, Expression]] = {}
        for (part, name), expression in zip(self.places, results, strict=True):
            parts.setdefault(part, {})[name] = expression
        return Equations(**parts)


def _found(module: str, name: str, text: str | None, key: Any) -> Any:
    """Return a component of a table, or of the table that a function returns for `text`."""
    table = getattr(import_module(module), name)
    return (table if text is None else table(text))[key]
