"""What results show of themselves; the reports, in layers above, make it and load when used."""

import os
from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Modules of functions that make texts, which need no pictures; all others are in `report.shown`.
_TEXTS = {
    "note_text": "psa_casadi.report.words.notes",
    "diagnosis_text": "psa_casadi.report.words.text",
    "sentence_of": "psa_casadi.report.words.notes",
    "identification_file": "psa_casadi.documents.files",
}


def made(what: str, *inputs: Any, **options: Any) -> Any:
    """Return what a function of the reports makes, by its name: "line", "plot", "note_text", ..."""
    module = import_module(_TEXTS.get(what, "psa_casadi.report.shown"))
    return getattr(module, what)(*inputs, **options)


class Worded:
    """A result with a sentence in words."""

    @property
    def sentence(self) -> str:
        """The result in words."""
        return str(made("sentence_of", self))


class Celled:
    """What shows itself as a cell of a notebook."""

    def _repr_html_(self) -> str:
        """Return what a notebook shows: words, and a table or a picture."""
        return str(made("cell", self))


class Plotted(Celled):
    """What can show a picture of itself."""

    def plot(self, ax: "Axes | None" = None, output: str | None = None) -> "Figure":
        """Return the picture as a matplotlib figure; a notebook shows it by itself.

        With `ax` or `output` it is one quantity over time, on these axes or on new ones: an output
        or state by name, "residual" of a fit or diagnosis, a parameter of a posterior.

        Raises:
            InputError: there is no such output.
        """
        return cast("Figure", made("plot", self, ax, output))


class Lined(Celled):
    """What shows itself in one line and as a cell."""

    def __repr__(self) -> str:
        """Return the result in one line."""
        return str(made("line", self))


class Reported(Plotted, Lined):
    """What a result with a report page can show of itself."""

    def report(self, path: str | os.PathLike[str], *, still: bool = False) -> None:
        """Write the page, one HTML file below 3 MB that needs no network.

        The model of a stack runs in the page unless it is to be `still`.

        Raises:
            InputError: `path` cannot be written to.
        """
        made("report", self, path, still=still)


def with_units(columns: Mapping[str, Any], units: Mapping[str, str]) -> dict[str, Any]:
    """Return columns whose names carry their units, as in `time [s]`; none where it is unknown."""
    return {f"{n} [{units[n]}]" if units.get(n) else n: values for n, values in columns.items()}


def frame(columns: dict[str, Any]) -> Any:
    """Return a pandas DataFrame of columns by name. Raises ImportError that states what to do."""
    try:
        pandas = import_module("pandas")
    except ImportError as error:
        raise ImportError(
            "A data frame needs pandas: run `pip install 'psa-casadi[pandas]'`."
        ) from error
    return pandas.DataFrame(columns)
