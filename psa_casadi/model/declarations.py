"""What is checked of components before their equations are put together."""

from psa_casadi.component import BALANCES, Component, Equations
from psa_casadi.errors import Problems


def symbol_names(component: Component) -> list[str]:
    """Return the names of the symbols that a component declares."""
    names = [p.name for p in component.parameters]
    names += [s.name for s in (*component.states, *component.sampled)]
    return names + [i.name for i in component.inputs]


def refuse_duplicates(components: tuple[Component, ...]) -> None:
    """Symbols share one name space with the balances and time, outputs have one of their own."""
    symbols = [n for c in components for n in symbol_names(c)]
    outputs = [o.name for c in components for o in c.outputs]
    problems = Problems()
    for names in (symbols, outputs):
        for name in sorted({n for n in names if names.count(n) > 1}):
            problems.add(f"Two components declare '{name}'; rename one or leave one out.")
    own = [b.name for c in components for b in c.balances]
    for name in sorted({n for n in own if n in BALANCES or own.count(n) > 1}):
        problems.add(f"The balance '{name}' is declared more than once; rename one.")
    for name in sorted({*BALANCES, *own, "time"}.intersection(symbols)):
        problems.add(f"A component declares '{name}', the name of a balance or of time; rename it.")
    problems.raise_if_any()


def sample_period(components: tuple[Component, ...]) -> str | None:
    """Return the parameter that is the period of all sampled components; None without any."""
    parameters = {p.name: p for c in components for p in c.parameters}
    problems, users = Problems(), [c for c in components if c.sampled or c.sample_period]
    for c in users:
        if not c.sampled or c.sample_period is None:
            problems.add(
                f"Component '{c.name}' declares only one of sampled states and a sample period;"
                " declare both or none."
            )
        elif c.sample_period not in parameters:
            problems.add(
                f"The sample period '{c.sample_period}' of component '{c.name}' is no parameter of"
                " the model; declare it, or add the component that does."
            )
        elif not parameters[c.sample_period].bounds[0] > 0.0:
            problems.add(
                f"The sample period '{c.sample_period}' may be 0 by its bounds"
                f" {parameters[c.sample_period].bounds}; give it a lower bound above 0."
            )
    periods = sorted({c.sample_period for c in users if c.sample_period})
    if len(periods) > 1:
        problems.add(
            f"The sampled components have different periods ({', '.join(periods)}), but a model has"
            " one clock; let all of them name the same parameter."
        )
    problems.raise_if_any()
    return periods[0] if periods else None


def check_declarations(component: Component, equations: Equations) -> None:
    """A component gives what it declares and nothing else; velocity follows from displacement."""
    outputs = {o.name for o in component.outputs} - {"velocity"}
    problems = Problems()
    for kind, declared, given in (
        ("derivative of the state", {s.name for s in component.states}, set(equations.der)),
        ("equation of the output", outputs, set(equations.out)),
        ("next value of the sampled state", {s.name for s in component.sampled}, {*equations.next}),
    ):
        for name in sorted(declared - given):
            problems.add(f"Component '{component.name}' lacks the {kind} '{name}'; declare it.")
        for name in sorted(given - declared):
            problems.add(
                f"Component '{component.name}' has the {kind} '{name}', which it does not declare;"
                " add a term to a balance instead, or declare it."
            )
    problems.raise_if_any()
