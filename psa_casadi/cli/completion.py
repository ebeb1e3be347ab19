"""What a shell offers for a word that is not yet whole: names that the package knows."""

from collections.abc import Callable
from importlib import import_module
from typing import Literal

#: Where the names of each kind are; a module loads when it is asked for.
_KNOWN = {
    "stacks": ("psa_casadi.model.stacks", "STACKS"),
    "effects": ("psa_casadi.effects", "EFFECTS"),
    "parts": ("psa_casadi.model.parts", "PARTS"),
    "datasets": ("psa_casadi.datasets", "DATASETS"),
    "examples": ("psa_casadi.examples.index", "examples"),
    "verdicts": ("psa_casadi.report.words.verdict_words", "VERDICTS"),
}


def names(
    kind: Literal["stacks", "effects", "parts", "datasets", "examples", "verdicts"],
) -> Callable[[str], list[str]]:
    """Return what completes the names of a kind, those behind a comma too."""

    def complete(incomplete: str) -> list[str]:
        module, name = _KNOWN[kind]
        known = getattr(import_module(module), name)
        before, comma, word = incomplete.rpartition(",")
        begun = (k for k in (known() if callable(known) else known) if k.startswith(word))
        return [f"{before}{comma}{k}" for k in begun]

    return complete
