"""What results show of themselves: how is made by the reports, which stand above them."""

import os
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_make: Callable[..., Any]


def register(make: Callable[..., Any]) -> None:
    """Register what makes a text, a picture or a page of a result, by the name of its function."""
    global _make  # noqa: PLW0603 - one function for all results
    _make = make


def made(what: str, *inputs: Any, **options: Any) -> Any:
    """Return what the registered function makes: "line", "plot", "note_text", ..."""
    return _make(what, *inputs, **options)


class Worded:
    """What says itself in a sentence."""

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

        With `ax` or `output` it is one quantity over time, on these axes or on its own: an output
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


class Shown(Plotted, Lined):
    """What a result can show of itself: a line, a notebook's cell, a picture."""


class Reported(Shown):
    """What a result can show of itself that has a page of its own."""

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
    """Return a pandas DataFrame of columns by name. Raises ImportError that says what to do."""
    try:
        pandas = import_module("pandas")
    except ImportError as error:
        raise ImportError(
            "A data frame needs pandas: run `pip install 'psa-casadi[pandas]'`."
        ) from error
    return pandas.DataFrame(columns)
